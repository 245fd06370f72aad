"""Cameras and points from matches: the process, its ways of mapping, and which model is used."""
