"""A triangle mesh of the surface that the training views show."""
