"""The third result of `rasterization`: what densification reads of each camera and Gaussian."""

from __future__ import annotations

from collections import UserDict
from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor

from recon_cli.render.camera_batch import (
    BatchLayout,
    BatchOptions,
    Gaussians,
    compensations,
    ellipses,
    radii,
)
from recon_cli.render.contract import TILE
from recon_cli.render.view_gradient import TensorCamera


class LazyDict(UserDict[str, Any]):
    """A dictionary some of whose values are computed when they are first read."""

    def add_later(self, name: str, compute: Callable[[], Any]) -> None:
        """Adds a key whose value is what `compute` returns."""
        self.data[name] = _Later(compute)

    def __getitem__(self, name: str) -> Any:
        value = self.data[name]
        if isinstance(value, _Later):
            value = self.data[name] = value.compute()
        return value


class _Later:
    """A value that is not there yet."""

    def __init__(self, compute: Callable[[], Any]) -> None:
        self.compute = compute


def view_meta(
    layout: BatchLayout, inputs: Gaussians, options: BatchOptions
) -> tuple[LazyDict, Tensor]:
    """Returns all of meta but means2d, and the means2d, as arranged; see `rasterization`."""
    cameras = [
        TensorCamera(options.width, options.height, viewmat, K)
        for viewmat, K in zip(inputs.viewmats, inputs.Ks, strict=True)]
    seen = list(zip(cameras, layout.ids(), strict=True))
    projected = [camera.project(inputs.means[ids]) for camera, ids in seen]
    means2d = layout.arrange(torch.cat([pixels for pixels, _ in projected]))
    enabled = torch.is_grad_enabled()

    @cache
    def shapes() -> tuple[Tensor, Tensor]:
        """Covariances [nnz, 3] and their determinants [nnz], float64."""
        with torch.set_grad_enabled(enabled):
            found = [ellipses(inputs, camera, options.eps2d, ids) for camera, ids in seen]
        return torch.cat([cov2d for _, cov2d, _ in found]), torch.cat([det for _, _, det in found])

    @cache
    def opacities() -> Tensor:
        with torch.set_grad_enabled(enabled):
            return torch.cat([
                inputs.opacities[ids] * (
                    compensations(inputs, camera, options.eps2d, ids)
                    if options.antialiased else 1)
                for camera, ids in seen])

    def conics() -> Tensor:
        cov2d, det = shapes()
        with torch.set_grad_enabled(enabled):
            exact = cov2d[:, [2, 1, 0]] * cov2d.new_tensor([1, -1, 1]) / det[:, None]
            return exact.to(inputs.means.dtype)

    meta = LazyDict({
        "batch_ids": torch.zeros_like(layout.camera_ids) if layout.packed else None,
        "camera_ids": layout.camera_ids if layout.packed else None,
        "gaussian_ids": layout.gaussian_ids if layout.packed else None,
        "depths": layout.arrange(torch.cat([depths for _, depths in projected])),
        "width": options.width, "height": options.height, "tile_size": TILE,
        "tile_width": -(-options.width // TILE), "tile_height": -(-options.height // TILE),
        "n_cameras": len(cameras), "n_batches": 1})
    meta.add_later("radii", lambda: layout.arrange(radii(shapes()[0], opacities()).int()))
    meta.add_later("conics", lambda: layout.arrange(conics()))
    meta.add_later("opacities", lambda: layout.arrange(opacities()))
    return meta, means2d


