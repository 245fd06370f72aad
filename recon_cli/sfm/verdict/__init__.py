"""Whether a model can be trusted, and the evidence for it."""
