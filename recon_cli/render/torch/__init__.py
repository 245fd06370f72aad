"""The torch backend: a vectorized tile rasterizer for any device, float32 or float64."""
