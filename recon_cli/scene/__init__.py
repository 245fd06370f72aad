"""What a reconstruction is made of: cameras, views, Gaussians. Knows no files, no training."""
