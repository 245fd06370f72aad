"""Gaussians in the one-file formats of viewers, read and written; docs/formats.md compares them."""
