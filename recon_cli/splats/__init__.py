"""Gaussians in the formats of viewers, read and written; docs/formats.md compares them."""
