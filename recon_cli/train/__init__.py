"""Fitting Gaussians to views: initialisation, loss, optimizer, densification, pruning."""
