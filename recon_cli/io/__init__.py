"""File formats, and nothing but file formats."""
