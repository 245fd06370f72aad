"""Poses that are known before, and the world frame of a model."""
