"""Experiments: the rasterizer benchmark, and comparisons over variants, scenes and seeds."""
