"""Differentiable rasterization of Gaussians: one contract, interchangeable backends."""

from recon_cli.render.contract import RenderOutput, Statistics
from recon_cli.render.registry import available_backends, render, resolve

__all__ = ["RenderOutput", "Statistics", "available_backends", "render", "resolve"]
