"""Pruning: in rounds, and as a run on disk."""
