"""Features of images, and the pairs that their matches make."""
