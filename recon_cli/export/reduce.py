"""Reduction of a scene before export: to a box, a lower degree or a file size."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from recon_cli.config.export import ExportConfig
from recon_cli.errors import ConfigError
from recon_cli.export.cleanup import drop_floaters, drop_islands
from recon_cli.io.images import fit_camera
from recon_cli.io.views import evenly_spread
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import SH_C0, Splats
from recon_cli.train.fit.importance import Importance, add_views
from recon_cli.workspace.export_formats import EXPORT_FORMATS
from recon_cli.workspace.summaries import ExportChange

if TYPE_CHECKING:  # the readers of views, which `recon convert` starts without
    from recon_cli.export.source import ExportSource

Box = tuple[float, float, float, float, float, float]  # x, y, z of the lowest corner, the highest

_COLOR_SIZE, _COLOR_VIEWS = 400, 100  # pixels and views, at most, that colours are fitted to
_SCORE = "loo"  # which Gaussians --max-mb keeps; docs/pruning.md
_RIDGE = 1e-3  # keeps coefficients small that no view can separate, such as of a wall seen head-on
_BLOCK = 1 << 16  # Gaussians that are solved for at once
_SHRINK = 0.99  # of the count at most, from one attempt to the next

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class ReducedScene:
    """A scene after the options that remove something."""

    bounded: Splats  # in files for viewers and engines
    trained: Splats  # in all others, with what lies outside the room where it was trained
    changes: tuple[ExportChange, ...]


def reduce_scene(
    splats: Splats, config: ExportConfig, source: ExportSource, size_of: Callable[[Splats], int]
) -> ReducedScene:
    """Returns the scene after the options that remove something, in order, and the changes.

    Floaters and islands come before --crop: it removes the background.
    `size_of` measures the file that --max-mb limits. Where that is bounded, so are all others.
    ConfigError if nothing would be left.
    """
    changes: list[ExportChange] = []

    def step(option: str, after: Splats) -> Splats:
        changes.append(measure_change(option, splats, after, source.psnr.psnr_db))
        return after

    def bound() -> Splats:
        bounded = source.bound(splats)
        return splats if bounded is splats else step("backdrop", bounded)

    if config.drop_floaters:
        splats = step("drop_floaters", drop_floaters(splats, source.load_training(), source.ctx))
    if config.drop_islands:
        views = source.load_training() if source.has_views else None
        splats = step("drop_islands", drop_islands(splats, source.room, views, source.ctx))
    if config.backdrop == "drop":
        splats = step("backdrop", replace(splats, backdrop=None))
    if config.crop is not None:
        splats = step("crop", crop(splats, config.crop))
    if config.sh_degree is not None and config.sh_degree < splats.sh_degree:
        splats = step("sh_degree", lower_degrees(splats, source).at(config.sh_degree))
    bounds = config.backdrop == "bounded"
    first = EXPORT_FORMATS[config.formats[0]].bounded
    if bounds and config.max_mb is not None and first:
        splats = bound()
    if config.max_mb is not None:
        splats = step("max_mb", fit_to_size(
            splats, int(1e6 * config.max_mb), size_of=size_of,
            fewer=_HighestScores(splats, source).take, at_degree=lower_degrees(splats, source).at,
            psnr_db=source.psnr.psnr_db))
    trained = splats
    if bounds and not (config.max_mb is not None and first):
        splats = bound()
    return ReducedScene(splats, trained, tuple(changes))


class _HighestScores:
    """The Gaussians of a scene that matter most to the training views."""

    def __init__(self, splats: Splats, source: ExportSource) -> None:
        self._splats, self._source = splats, source

    def take(self, scene: Splats, count: int) -> Splats:
        """Returns as many of the scene, which may be in another degree."""
        from recon_cli.train.prune.prune_loop import survivors  # imports the whole training

        return scene.select(survivors(self._score, count))

    @cached_property
    def _score(self) -> Tensor:
        """How much each Gaussian matters to the training views, [N]."""
        source = self._source
        splats = self._splats.map(lambda tensor: tensor.to(source.ctx.device))
        importance = Importance.of_score(_SCORE, len(splats), splats.means.device)
        add_views(importance, splats, source.load_training(),
                  sh_degree=splats.sh_degree, backend=source.ctx.backend)
        return importance.score(_SCORE, splats, beta=0.0, generator=torch.Generator()).cpu()


def measure_change(
    option: str, before: Splats, after: Splats, psnr_db: Callable[[Splats], float]
) -> ExportChange:
    """Returns and logs how many Gaussians and dB an option has removed."""
    change = ExportChange(
        option=option, gaussians=len(after.with_sphere()),
        gaussians_before=len(before.with_sphere()),
        degree=after.sh_degree, degree_before=before.sh_degree,
        psnr_change_db=round(psnr_db(after) - psnr_db(before), 4))
    word = "of" if change.gaussians <= change.gaussians_before else "for"  # a finer backdrop
    text = f"{option}: {change.gaussians:,} {word} {change.gaussians_before:,} Gaussians"
    if change.degree != change.degree_before:
        text += f", degree {change.degree_before} -> {change.degree}"
    logger.info("%s, %+.2f dB", text, change.psnr_change_db)
    return change


def crop(splats: Splats, box: Box) -> Splats:
    """Returns the Gaussians with their centres in a box or on it, alone; ConfigError if none is."""
    low, high = splats.means.new_tensor(box[:3]), splats.means.new_tensor(box[3:])
    inside = ((splats.means >= low) & (splats.means <= high)).all(dim=1)
    if not inside.any():
        least, most = (splats.means.quantile(share, dim=0).tolist() for share in (0.05, 0.95))
        raise ConfigError(
            f"No Gaussian has its centre in the box {' '.join(f'{side:g}' for side in box)}.",
            hint="Nine tenths of them are between "
            f"{' '.join(f'{value:.2f}' for value in least)} and "
            f"{' '.join(f'{value:.2f}' for value in most)}.")
    return replace(splats.select(inside), backdrop=None)


class LowerDegrees:
    """A scene in lower degrees of spherical harmonics, fitted to the colours that the views see.

    Cutting the higher coefficients off changes all colours: a Gaussian that is seen from one side
    only owes its colour there to all of them together. The lower ones y are instead the least
    squares of w |Y_low(d) y - Y(d) x|^2 over the views, with directions d to the Gaussian and its
    blend weights w in them. Gaussians that no view sees are cut.
    """

    def __init__(
        self, splats: Splats, cameras: Sequence[Camera], *, backend: str,
        device: str | torch.device = "cpu",
    ) -> None:
        self._splats, self._cameras, self._backend = splats, cameras, backend
        self._device = torch.device(device)

    def at(self, degree: int) -> Splats:
        """Returns the scene in a degree below its own; in its own it is unchanged."""
        if degree >= self._splats.sh_degree:
            return self._splats
        splats, weight, products = self._products
        low = (degree + 1) ** 2
        colored = len(splats.sh_rest)  # the others have a base colour only
        rest = torch.nn.functional.pad(splats.sh_rest, (0, 0, 0, 0, 0, len(splats) - colored))
        full = torch.cat([splats.sh_dc[:, None], rest], dim=1)  # [N, T, 3]
        result = full[:, :low].clone()
        ridge = _RIDGE * torch.eye(low, dtype=torch.float64, device=full.device)
        ridge[0, 0] = 0
        for rows in torch.split(torch.nonzero(weight)[:, 0], _BLOCK):
            mean = products[rows, :low].double() / weight[rows, None, None]
            solved = torch.linalg.solve(
                mean[..., :low] + ridge, mean @ full[rows].double())
            result[rows] = solved.to(result.dtype)
        home = self._splats.means.device
        return replace(self._splats, sh_dc=result[:, 0].contiguous().to(home),
                       sh_rest=result[:colored, 1:].contiguous().to(home))

    @cached_property
    def _products(self) -> tuple[Splats, Tensor, Tensor]:
        """The scene on the device, sums of w [N], and of w Y_low^T Y [N, low, terms]."""
        splats = self._splats.map(lambda tensor: tensor.to(self._device))
        terms, low = (splats.sh_degree + 1) ** 2, splats.sh_degree**2  # low serves all below
        total = torch.zeros(len(splats), device=self._device)
        products = torch.zeros(len(splats), low, terms, device=self._device)
        background = torch.zeros(3, dtype=splats.means.dtype, device=self._device)
        for camera in self._cameras:
            with torch.no_grad():
                weight = render(splats, camera, background, 0, backend=self._backend,
                                scores=True).statistics.blend_sum.float()
            seen = torch.nonzero(weight)[:, 0]
            center = torch.as_tensor(camera.center, dtype=torch.float32, device=self._device)
            away = torch.nn.functional.normalize(splats.means[seen].float() - center, dim=1)
            basis = torch.cat([
                torch.full((len(seen), 1), SH_C0, device=self._device),
                basis_rest(away, splats.sh_degree)], dim=1)
            weighted = weight[seen, None] * basis[:, :low]
            total.index_add_(0, seen, weight[seen])
            products.index_add_(0, seen, weighted[:, :, None] * basis[:, None])
        return splats, total, products


def lower_degrees(splats: Splats, source: ExportSource) -> LowerDegrees:
    """Returns a scene in lower degrees, as the training views see it."""
    cameras = [fit_camera(source.frame.similarity.camera(view.camera), _COLOR_SIZE)
               for view in evenly_spread(source.scene.train, _COLOR_VIEWS)]
    return LowerDegrees(
        splats, cameras, backend=source.ctx.backend, device=source.ctx.device)


def fit_to_size(
    splats: Splats, max_bytes: int, *, size_of: Callable[[Splats], int],
    fewer: Callable[[Splats, int], Splats], at_degree: Callable[[int], Splats],
    psnr_db: Callable[[Splats], float],
) -> Splats:
    """Returns the scene reduced to a file size, by the degree and count that look best together.

    For each degree as many Gaussians as fit; of these scenes the one with the highest PSNR.
    `fewer` returns a scene with at most so many Gaussians, `at_degree` the scene in a lower degree.
    ConfigError if not even one Gaussian fits.
    """
    if size_of(splats) <= max_bytes:
        return splats
    degrees = range(splats.sh_degree, -1, -1)
    candidates = (_fit_count(at_degree(degree), max_bytes, size_of, fewer) for degree in degrees)
    fitting = [scene for scene in candidates if scene is not None]
    if not fitting:
        raise ConfigError(
            f"Not even one Gaussian fits into {max_bytes / 1e6:g} MB.",
            hint="Allow more with --max-mb.")
    return max(fitting, key=psnr_db)


def _fit_count(
    splats: Splats, max_bytes: int, size_of: Callable[[Splats], int],
    fewer: Callable[[Splats, int], Splats],
) -> Splats | None:
    """Returns as many Gaussians as fit; None if not even one does."""
    count = len(splats)
    while count:
        best = splats if count == len(splats) else fewer(splats, count)
        size = size_of(best)
        if size <= max_bytes:
            return best
        count = min(int(_SHRINK * count), int(count * max_bytes / size))
    return None
