"""Training as a whole: one arm on one scene, its curve of quality over time, and `bench train`.

`recon study` runs its arms by the same modules.
"""
