"""The elements of a reconstruction: cameras, views, Gaussians; no files, no training."""
