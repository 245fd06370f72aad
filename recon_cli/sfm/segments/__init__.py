"""A long walk in segments: each mapped alone, then joined, and its loops closed."""
