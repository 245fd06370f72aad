"""A large scene in blocks, each trained alone, then merged."""
