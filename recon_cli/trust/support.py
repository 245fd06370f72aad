"""The support of each Gaussian: the training views that show it, from where, and how well.

One forward pass over training views; held-out and validation views take no part.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from recon_cli.errors import FormatError, Hint
from recon_cli.render import render
from recon_cli.render.contract import SHOWN_WEIGHT
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.workspace.atomic import parse_json, replacing
from recon_cli.workspace.paths import refuse_special

MAX_VIEWS = 300  # that are looked at, evenly spread; more show next to nothing new
_VERSION = 1
_BLUR = 3  # pixels across that a residual is read from: one alone is mostly noise
_MAX_NEARER = 3.0  # natural logarithm of how much nearer a camera may be than all training views


@dataclass(frozen=True, eq=False)
class ViewingGeometry:
    """How N Gaussians look from one place, compared with where training saw them from."""

    angle: Tensor  # [N] rad to the nearest ray of a training view that shows it; pi without any
    nearer: Tensor  # [N] log of the nearest of these views' distance over that of the place, >= 0


@dataclass(frozen=True, eq=False)
class _Rays:
    """The P rays from views to the Gaussians that they show, Gaussian by Gaussian."""

    means: Tensor  # [N, 3] that they lead to
    lengths: Tensor  # [N] int64, rays of each
    directions: Tensor  # [P, 3]
    nearest: Tensor  # [N] distance of the nearest view; infinite where none shows it

    @staticmethod
    def from_rows(
        rows: Sequence[Tensor], centers: NDArray[np.float64], count: Tensor, means: Tensor
    ) -> _Rays:
        """Returns the rays from views at `centers` to the Gaussians at `rows` of each."""
        every = [means.new_zeros(0, dtype=torch.int64), *rows]
        order = torch.argsort(torch.cat(every), stable=True)
        parts = [_directions(means[own], center) for own, center in zip(rows, centers, strict=True)]
        directions = torch.cat([means.new_zeros(0, 3), *(ray for ray, _ in parts)])[order]
        distances = torch.cat([means.new_zeros(0), *(apart for _, apart in parts)])[order]
        rays = _Rays(means, count, directions, count)
        return replace(rays, nearest=rays.reduce("min", distances))

    def reduce(self, how: str, values: Tensor) -> Tensor:
        """Returns sum, min or max of the values [P, ...] of each Gaussian's rays, [N, ...]."""
        initial = 0 if how == "sum" else None
        return torch.segment_reduce(values, how, lengths=self.lengths, unsafe=True, initial=initial)

    def cosines(self, directions: Tensor) -> Tensor:
        """Returns the cosines [P] of the rays to the direction of their Gaussian, of [N, 3]."""
        own = directions.repeat_interleave(self.lengths, dim=0)
        return torch.einsum("pi,pi->p", self.directions, own)


@dataclass(frozen=True, eq=False)
class ViewSupport:
    """The support of N Gaussians in the training views."""

    rows: tuple[Tensor, ...]  # by view the Gaussians that it shows, [K] int64
    centers: NDArray[np.float64]  # [V, 3] of these views, world units
    residual: Tensor  # [N] mean absolute error of its pixels, 0 to 1, by weight; mean where unseen
    count: Tensor  # [N] int64, number of views that show each
    digest: str = ""  # of the Gaussians
    _kept: dict[str, _Rays] = field(default_factory=dict, init=False, repr=False)

    @staticmethod
    def from_rows(
        rows: Sequence[Tensor], centers: NDArray[np.float64], residual: Tensor, digest: str = ""
    ) -> ViewSupport:
        """Returns the support by `rows`, with the views of each Gaussian counted."""
        count = torch.zeros(len(residual), dtype=torch.int64, device=residual.device)
        for shown in rows:
            count[shown] += 1
        return ViewSupport(tuple(rows), centers, residual, count, digest)

    def to(self, device: torch.device) -> ViewSupport:
        """Returns the same on a device."""
        return ViewSupport(tuple(rows.to(device) for rows in self.rows), self.centers,
                       self.residual.to(device), self.count.to(device), self.digest)

    def span(self, means: Tensor) -> Tensor:
        """Returns the angle [N] in rad that the rays to each of `means` [N, 3] span.

        Twice the greatest angle to their mean direction; 0 for fewer than two views.
        """
        rays = self._rays(means)
        middle = torch.nn.functional.normalize(rays.reduce("sum", rays.directions), dim=1)
        cosine = rays.reduce("min", rays.cosines(middle))
        return 2 * torch.arccos(cosine.clamp(-1, 1)) * (self.count > 1)

    def seen_from(self, means: Tensor, place: NDArray[np.float64]) -> ViewingGeometry:
        """Returns how Gaussians at `means` [N, 3] look from `place` [3]."""
        rays, (toward, distance) = self._rays(means), _directions(means, place)
        seen = self.count > 0
        cosine = rays.reduce("max", rays.cosines(toward)).clamp(-1, 1)
        nearer = torch.log(rays.nearest / distance).clamp(0, _MAX_NEARER)
        return ViewingGeometry(torch.arccos(torch.where(seen, cosine, -1.0)),
                     torch.where(seen, nearer, 0.0))

    def _rays(self, means: Tensor) -> _Rays:
        """Returns the rays to `means`; those to the last ones asked for are kept."""
        kept = self._kept.get("rays")
        if kept is None or kept.means is not means:
            kept = self._kept["rays"] = _Rays.from_rows(self.rows, self.centers, self.count, means)
        return kept

    def save(self, path: Path) -> None:
        """Writes the support as safetensors, atomically."""
        shown = np.zeros((len(self.rows), len(self.residual)), bool)
        for row, rows in zip(shown, self.rows, strict=True):
            row[rows.cpu().numpy()] = True
        head = {"version": _VERSION, "gaussians": len(self.residual), "digest": self.digest}
        with replacing(path) as temporary:
            save_file({"shown": torch.from_numpy(np.packbits(shown, axis=1)),
                       "centers": torch.from_numpy(self.centers),
                       "residual": self.residual.cpu().contiguous()},
                      temporary, metadata={"support": json.dumps(head)})

    @staticmethod
    def load(path: Path) -> ViewSupport:
        """Reads the file that `save` wrote; FormatError if it is missing, damaged or of another."""
        refuse_special(path)
        try:
            with safe_open(path, framework="pt") as file:
                head = parse_json((file.metadata() or {})["support"], dict)
                shown, centers, residual = (
                    file.get_tensor(name) for name in ("shown", "centers", "residual"))
            count = int(head["gaussians"])
            if head["version"] != _VERSION or len(residual) != count or len(shown) != len(centers):
                raise ValueError("its parts do not fit")
            bits = np.unpackbits(shown.numpy(), axis=1, count=count)
        except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
            raise FormatError(
                f"{path} cannot be read: {error}.", hint=Hint("eval", again=True)) from error
        rows = tuple(torch.from_numpy(np.nonzero(row)[0]) for row in bits)
        return ViewSupport.from_rows(rows, centers.numpy(), residual, str(head["digest"]))


def _directions(means: Tensor, place: NDArray[np.float64]) -> tuple[Tensor, Tensor]:
    """Returns unit vectors [K, 3] from a place to `means` [K, 3], and the distances [K]."""
    offsets = means - torch.as_tensor(place, dtype=means.dtype, device=means.device)
    distance = offsets.norm(dim=1).clamp_min(1e-9)
    return offsets / distance[:, None], distance


def measure_support(
    splats: Splats, views: Iterable[TrainView], *, sh_degree: int, backend: str,
    gains: bool = False, on_view: Callable[[], None] = lambda: None,
    digest: str = "",
) -> ViewSupport:
    """Returns the support of the Gaussians in the training views, by one forward pass over them.

    `gains` compares after the best gain per channel, as where exposures were trained.
    """
    device = splats.means.device
    weights = torch.zeros(len(splats), dtype=torch.float64, device=device)
    errors = weights.clone()
    shown: list[Tensor] = []
    centers: list[NDArray[np.float64]] = []
    for view in views:
        centers.append(view.camera.center)
        with torch.no_grad():
            output = render(
                splats, view.camera, splats.background, sh_degree, backend=backend, scores=True)
        statistics = output.statistics
        rows = torch.nonzero(statistics.blend_max >= SHOWN_WEIGHT)[:, 0]
        shown.append(rows)
        if len(rows):
            error, counts = error_image(output.rgb.cpu().numpy(), view, gains=gains)
            # the mean over the pixels around that count
            blurred = cv2.blur(error * counts, (_BLUR, _BLUR)) / np.maximum(
                cv2.blur(counts, (_BLUR, _BLUR)), 1e-6)
            v, u = _pixels(splats.means[rows], view)
            weight = statistics.blend_sum[rows].double() * torch.from_numpy(
                counts)[v, u].to(device)
            weights[rows] += weight
            errors[rows] += weight * torch.from_numpy(blurred)[v, u].to(device)
        on_view()
    mean = float(errors.sum() / weights.sum().clamp_min(1e-12))
    residual = torch.where(weights > 0, errors / weights.clamp_min(1e-12), mean)
    return ViewSupport.from_rows(
        shown, np.reshape(centers, (-1, 3)), residual.to(splats.means.dtype), digest)


def error_image(
    rgb: NDArray[np.float32], view: TrainView, *, gains: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Returns the mean absolute error of each pixel, [H, W] of 0 to 1, and 1 where it counts.

    `rgb` [H, W, 3] is the render; with `gains` it is compared after the best gain per channel.
    """
    truth = view.image.astype(np.float32) / 255
    counts = np.ones(truth.shape[:2], np.float32) if view.mask is None else (
        view.mask.astype(np.float32))
    if gains:
        weighted = rgb * counts[..., None]
        energy = (weighted * rgb).sum((0, 1))
        factor = (weighted * truth).sum((0, 1)) / np.maximum(energy, 1e-12)
        rgb = rgb * np.where(energy > 0, factor, 1).astype(np.float32)
    error = np.abs(rgb.clip(0, 1) - truth)
    total = error[..., 0] + error[..., 1] + error[..., 2]  # `mean` takes three times as long
    return np.asarray(total / 3, np.float32), counts


def _pixels(means: Tensor, view: TrainView) -> tuple[Tensor, Tensor]:
    """Returns line and column [K] of the pixels that centres [K, 3] fall on, on the CPU."""
    pixels, _ = view.camera.project(means.detach().cpu().double().numpy())
    last = view.camera.width - 1, view.camera.height - 1
    column, line = torch.from_numpy(np.nan_to_num(pixels).clip(0, last)).long().unbind(1)
    return line, column
