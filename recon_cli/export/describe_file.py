"""Facts about a splat file: what it holds, how it renders, and what is wrong with it."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.context import StageContext
from recon_cli.errors import FormatError
from recon_cli.export.synthetic_cameras import VIEW_SIZE, VISIBLE, synthetic_scene
from recon_cli.render.drawing import draw
from recon_cli.scene.splat_arrays import SplatArrays
from recon_cli.splats.axes import UP
from recon_cli.splats.foreign import FLAT
from recon_cli.splats.format import LoadedScene
from recon_cli.splats.registry import format_of, load_splats
from recon_cli.splats.values import HUGE, WIDE, find_bulk, lower_median, measure_distances

_TINY = 5e-4  # of the radius: half a pixel in an image 1000 pixels wide, taken from that far
_FAINT = 0.05  # opacity of nearly transparent ones
_FAR = 100.0  # radii from the origin
_MANY = 0.5  # share that is worth a word

logger = logging.getLogger("recon")
Corner = list[float]


@dataclass(frozen=True)
class FileFindings:
    """The facts that `recon info --json` prints under these names; lengths are in units."""

    file: str
    format: str
    bytes: int
    gaussians: int
    sh_degree: int
    up: str | None  # z, -y or y as the file says; None if it does not
    writer: str  # what the file says of its writer; empty if nothing
    antialiased: bool  # the file says that it was trained with antialiasing
    backdrop: bool  # one colour is behind all
    bounds: tuple[Corner, Corner]  # of all centres
    bulk_bounds: tuple[Corner, Corner]  # nine tenths of the centres along each axis
    median_size: float  # greatest standard deviation of the median Gaussian
    tiny: float  # shares of all Gaussians, 0 to 1
    huge: float
    nearly_transparent: float
    overdraw: float | None  # Gaussians a covered pixel, on the mean; None if no camera sees any
    problems: tuple[str, ...]

    def describe(self) -> str:
        """Returns the facts, one line each."""
        rows = {
            "": self.file,
            "format": f"{self.format}, {self.bytes / 1e6:.2f} MB",
            "Gaussians": f"{self.gaussians:,}, degree {self.sh_degree}"
            + (", the last of them the backdrop" if self.backdrop else ""),
            "up": self.up or "not stated",
            "writer": self.writer or "not stated",
            "bounds": _box(self.bounds),
            "nine tenths": _box(self.bulk_bounds),
            "size": f"{self.median_size:.3g} (median); {self.tiny:.1%} tiny, {self.huge:.1%} huge",
            "opacity": f"{self.nearly_transparent:.1%} nearly transparent",
            "overdraw": "unknown" if self.overdraw is None else (
                f"{self.overdraw:.1f} Gaussians a pixel"),
        }
        lines = [f"{name:<12} {text}".strip() for name, text in rows.items()]
        if self.antialiased:
            lines.append(f"{'rendering':<12} trained with antialiasing (Mip-Splatting)")
        return "\n".join(lines + [f"{'problem':<12} {text}" for text in self.problems])


def describe_file(path: Path, ctx: StageContext) -> FileFindings:
    """Returns the facts about a file; FormatError if it is damaged, empty or unknown."""
    with _collected_warnings() as problems:
        scene = load_splats(path)
    splats = scene.arrays
    if not len(splats):
        raise FormatError(f"{path} holds no Gaussians.", hint="Export it again.")
    means = splats.means.astype(np.float64)
    away, radius = measure_distances(means)
    size = splats.scales.max(axis=1)
    low, high = find_bulk(means)
    overdraw = _measure_overdraw(splats, np.array(UP[scene.up or "-y"]), ctx)
    shift = np.array(scene.origin.point if scene.origin else (0.0, 0.0, 0.0))
    problems += _find_problems(scene, radius, (low, high), overdraw)
    return FileFindings(
        file=str(path), format=format_of(path).name, bytes=path.stat().st_size,
        gaussians=len(splats.with_sphere()), sh_degree=splats.sh_degree, up=scene.up,
        writer=_printable(scene.writer), antialiased=scene.antialiased,
        backdrop=splats.backdrop is not None,
        bounds=_corners(means.min(axis=0) + shift, means.max(axis=0) + shift),
        bulk_bounds=_corners(low + shift, high + shift),
        median_size=float(lower_median(size)), tiny=_share(size < _TINY * radius),
        huge=_share(size > HUGE * np.maximum(away, radius)),
        nearly_transparent=_share(splats.opacities < _FAINT), overdraw=overdraw,
        problems=tuple(_printable(text) for text in problems))


@contextmanager
def _collected_warnings() -> Iterator[list[str]]:
    """Yields a list that takes the warnings of the block instead of the log."""
    texts: list[str] = []

    def take(record: logging.LogRecord) -> bool:
        if record.levelno < logging.WARNING:
            return True
        texts.append(record.getMessage())
        return False

    logger.addFilter(take)
    try:
        yield texts
    finally:
        logger.removeFilter(take)


def _find_problems(
    scene: LoadedScene, radius: float, bulk: tuple[NDArray[np.float64], ...], overdraw: float | None
) -> list[str]:
    """Returns one line about each thing that makes trouble in viewers, beside those on reading."""
    splats, found, count = scene.arrays, list[str](), f"{len(scene.arrays):,}"
    means = splats.means.astype(np.float64)
    flat = int((splats.log_scales <= FLAT + 1e-3).any(axis=1).sum())
    if flat:
        # readers put small values in place of a 0, and trained ones may be as small
        found.append(f"{flat:,} of {count} Gaussians are flat: a scale is at most "
                     f"{math.exp(FLAT):.0e} units")
    # other lengths than 1 are usual, and every viewer mends them
    none = int((~splats.quats.any(axis=1)).sum())
    if none:
        found.append(f"{none:,} of {count} rotations are 0 0 0 0, which some viewers do not draw")
    if scene.origin is not None:
        found.append(scene.origin.describe())
    middle = float(np.linalg.norm(lower_median(means)))
    if scene.origin is None and radius and middle > _FAR * radius:
        found.append(f"everything is far away: {middle:.4g} units from the origin, where the scene "
                     f"has a radius of {radius:.4g}; viewers that turn about the origin miss it")
    across = float(np.ptp(means, axis=0).max())
    if across > WIDE * float((bulk[1] - bulk[0]).max()) > 0:
        found.append(f"it is {across:.4g} units across, but nine tenths of the Gaussians lie in a "
                     "small part of that: viewers that fit all start far away")
    if _share(splats.opacities < _FAINT) > _MANY:
        found.append("most Gaussians are nearly transparent")
    if overdraw is None:
        found.append("no camera around the scene or in it sees anything")
    return found


def _measure_overdraw(
    splats: SplatArrays, up: NDArray[np.float64], ctx: StageContext
) -> float | None:
    """Returns how many Gaussians contribute to a covered pixel of synthetic views, on the mean."""
    hits = pixels = 0
    for view in synthetic_scene(splats, up=up, max_size=VIEW_SIZE).train:
        drawing = draw(splats, view.camera, 0, backend=ctx.backend, device=ctx.device,
                       count=True)
        hits += drawing.hits
        pixels += int((drawing.alpha > np.float32(VISIBLE)).sum())
    return hits / pixels if pixels else None


def _share(mask: NDArray[np.bool_]) -> float:
    return float(mask.mean())


def _corners(low: NDArray[np.float64], high: NDArray[np.float64]) -> tuple[Corner, Corner]:
    return low.tolist(), high.tolist()


def _box(corners: tuple[Corner, Corner]) -> str:
    low, high = (" ".join(f"{value:.4g}" for value in corner) for corner in corners)
    return f"{low} to {high}"


def _printable(text: str) -> str:
    """Returns a text of a file that a terminal can show."""
    return "".join(one if one.isprintable() else repr(one)[1:-1] for one in text)
