"""Captures that come with poses: one file a layout, and one table of layouts."""
