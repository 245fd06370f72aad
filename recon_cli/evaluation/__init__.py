"""Scores of rendered views against reference views, their intervals, and tables of them."""
