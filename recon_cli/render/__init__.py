"""Differentiable rasterization of Gaussians: one contract, interchangeable backends."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from recon_cli.render.contract import RenderOutput, Statistics
    from recon_cli.render.registry import available_backends, render, resolve

__all__ = ["RenderOutput", "Statistics", "available_backends", "render", "resolve"]


def __getattr__(name: str) -> Any:
    """Imports torch when it is first needed: kernels draw without it."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from recon_cli.render import contract, registry

    return getattr(contract if hasattr(contract, name) else registry, name)
