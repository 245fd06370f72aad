"""Packs Gaussians for the browser: covariances in half precision, colours of 8 bits.

Half-precision covariances overflow above a standard deviation of 255 and vanish below 0.0003. So
everything is sent in units in which the largest Gaussian fits, and the scene node is scaled back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import viser
from numpy.typing import NDArray

from recon_cli.render.torch.projection import colors_from_sh, rotation_matrices
from recon_cli.scene.splats import Splats

_LARGEST = 200.0  # standard deviation as sent; its square fits into half precision
# Limit of the largest Gaussian, in medians of the longest axes; in four scenes it was 450 to 3,000.
# A larger outlier would leave no precision for the room, so it is drawn smaller.
_OUTLIER = 5000.0
# Of the longest axis: a covariance is rounded by 2^-11 of its largest entry, so one with a thinner
# axis may not stay positive definite. Against recon's renders 0.02 dB better than without.
_THINNEST = 0.02


@dataclass(frozen=True, eq=False)
class PackedGaussians:
    """N Gaussians as they are sent."""

    splats: Splats  # on the CPU, finite
    scale: float  # of the scene node: world units per unit sent
    centers: NDArray[np.float32]  # [N, 3]
    covariances: NDArray[np.float16]  # [N, 3, 3]
    opacities: NDArray[np.uint8]  # [N, 1]

    def colors(self, position: Sequence[float] | None) -> NDArray[np.uint8]:
        """Returns the colours [N, 3] as seen from `position` [3]; None uses SH degree 0 alone."""
        splats = self.splats
        degree = 0 if position is None else splats.sh_degree
        offsets = splats.means - splats.means.new_tensor(position or (0.0, 0.0, 0.0))
        rgb = colors_from_sh(
            offsets, splats.sh_dc, splats.sh_rest, torch.arange(len(splats)), degree)
        return _eight_bit(rgb.numpy())


def pack_splats(splats: Splats) -> PackedGaussians:
    """Packs Gaussians of any device, without those that are not finite, which nothing renders."""
    splats = _drop_non_finite(splats.map(lambda tensor: tensor.detach().cpu()))
    scales = np.exp(splats.log_scales.numpy().astype(np.float64))
    longest = scales.max(axis=1, initial=0.0)
    largest = min(longest.max(initial=0.0), _OUTLIER * float(np.median(longest))) if len(
        longest) else 0.0
    scale = largest / _LARGEST or 1.0
    spread = np.clip(scales, _THINNEST * longest[:, None], None).clip(max=largest) / scale
    rotations = rotation_matrices(splats.quats.double()).numpy()
    factors = rotations * spread[:, None, :]
    return PackedGaussians(
        splats, scale, (splats.means.numpy() / scale).astype(np.float32),
        (factors @ factors.transpose(0, 2, 1)).astype(np.float16),
        _eight_bit(splats.opacities.numpy())[:, None])


def show_backdrop(scene: viser.SceneApi, splats: Splats) -> None:
    """Sets the colour behind all Gaussians in browsers; black without a backdrop."""
    pixel = _eight_bit(splats.background.detach().cpu().numpy())
    scene.set_background_image(pixel.reshape(1, 1, 3), format="png")


def _drop_non_finite(splats: Splats) -> Splats:
    good = finite_rows(splats)
    return splats if bool(good.all()) else splats.select(good)


def finite_rows(splats: Splats) -> torch.Tensor:
    """Returns which Gaussians are finite, and so are sent, [N] bool."""
    good = torch.ones(len(splats), dtype=torch.bool)
    for value in splats.parameters().values():
        finite = torch.isfinite(value)
        rows = finite[:, None] if value.ndim == 1 else finite.flatten(1)
        good[:len(value)] &= rows.all(dim=1)  # sh_rest may have fewer
    return good


def _eight_bit(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    return np.asarray(np.rint(255 * np.clip(values, 0, 1)), np.uint8)
