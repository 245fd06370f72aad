"""`recon bench`: how fast each rasterizer is, and how far from the truth.

Computes results and the texts that show them; what captures, workspaces and stages cost is not
its business. docs/bench.md says how to read the figures.
"""
