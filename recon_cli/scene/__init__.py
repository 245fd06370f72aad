"""What a reconstruction is made of: cameras, views, Gaussians. Knows no files, no training.

Names are imported from the modules themselves: most of them do without torch, which takes a second
to load.
"""
