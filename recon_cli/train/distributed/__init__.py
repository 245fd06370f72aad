"""Data-parallel training: several processes that torchrun started train one model."""
