"""Synthetic cameras for a scene imported without views, and PSNR against its own renders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon_cli.context import StageContext
from recon_cli.errors import ReconstructionError
from recon_cli.render.contract import NEAR
from recon_cli.render.drawing import draw
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splat_arrays import EXTENT_SIGMAS, SplatArrays
from recon_cli.scene.statistics import FINE_SAMPLE
from recon_cli.splats.ply import MIN_OPACITY
from recon_cli.splats.values import lower_median, measure_extent

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

VIEW_SIZE = 600  # pixels, longest side of the renders that a file is checked on
CAMERAS_AROUND = 4  # cameras outside, and as many inside
_LEAST_RADIUS = NEAR  # else Gaussians in the middle are too near to be drawn
_DISTANCE = 2.5  # radii: the bulk and some space around it fill a field of view of 60 degrees
_HEIGHT = 0.6  # radii, of the cameras outside
_INSIDE = 0.6  # radii from the middle, within which the emptiest position is searched
_CANDIDATES = 1000
_BOUNDING = 1000  # Gaussians, at least, whose distances bound those of candidates
VISIBLE = 0.5 / 255  # coverage that changes an 8-bit image
_FOV_DEG = 60.0
_ASPECT = 1.5
# PSNR that a good scene reaches on photos. Against its own renders a scene is perfect, and any
# rounding would cost tens of dB that nobody sees.
ASSUMED_DB = 30.0


def synthetic_scene(
    splats: Splats | SplatArrays, *, up: NDArray[np.float64], max_size: int
) -> Scene:
    """Returns a scene whose training views are cameras without images; deterministic.

    The first four stand around the bulk of the opaque Gaussians and look at its middle, the other
    four stand where there is most space inside and look outward. `up` is a unit vector [3] along z
    or y; `max_size` is the longest side in pixels.
    """
    arrays = splats.as_arrays()
    opaque = arrays.opacities >= MIN_OPACITY
    used = opaque if opaque.any() else ~opaque
    means = arrays.means[used].astype(np.float64)
    middle, bulk = measure_extent(means)
    # centres alone may all be one
    size = float(lower_median(arrays.scales[used].max(axis=1).astype(np.float64)))
    radius = max(bulk, EXTENT_SIGMAS * size, _LEAST_RADIUS)
    x_axis = np.array([1.0, 0, 0])
    y_axis = np.cross(up, x_axis)
    angles = np.pi * (0.25 + np.arange(CAMERAS_AROUND) / 2)
    level = [np.cos(angle) * x_axis + np.sin(angle) * y_axis for angle in angles]
    width, height = max_size, max(16, round(max_size / _ASPECT))
    focal = height / 2 / float(np.tan(np.radians(_FOV_DEG) / 2))
    inside = _find_emptiest(means, middle, _INSIDE * radius)
    viewmats = [
        *(looking_at(middle + radius * (_DISTANCE * way + _HEIGHT * up), middle, up)
          for way in level),
        *(looking_at(inside, inside + radius * way, up) for way in level)]
    views = tuple(
        View(f"made-up-{at}", Camera(
            width, height, focal, focal, width / 2, height / 2, viewmat), Path(), Path())
        for at, viewmat in enumerate(viewmats))
    points = means[:: max(1, len(means) // FINE_SAMPLE)]
    return Scene(views, (), (), (), points, np.zeros((len(points), 3), np.uint8))


def _find_emptiest(
    means: NDArray[np.float64], middle: NDArray[np.float64], within: float
) -> NDArray[np.float64]:
    """Returns the position [3] near the middle that is farthest from all Gaussians."""
    rng = np.random.default_rng(0)
    ways = rng.standard_normal((_CANDIDATES, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    positions = middle + within * np.cbrt(rng.random((_CANDIDATES, 1))) * ways
    # No tree, whose package takes half a second: the distance to some bounds that to all, and few
    # positions are left that may be better than the best so far.
    bounds = np.full(len(positions), np.inf)
    for mean in means[:: max(1, len(means) // _BOUNDING)]:
        np.minimum(bounds, ((positions - mean) ** 2).sum(axis=1), out=bounds)
    best, place = -1.0, 0
    for at in np.argsort(-bounds, kind="stable"):
        if bounds[at] <= best:
            break
        clearance = float(((means - positions[at]) ** 2).sum(axis=1).min())
        if clearance > best:
            best, place = clearance, int(at)
    return np.asarray(positions[place])


@dataclass(frozen=True, eq=False)
class SelfPsnr:
    """PSNR of a changed scene against renders of the original, on the scale of photos.

    It is that of a scene that shows photos at ASSUMED_DB: the error there and the difference to the
    renders add up as variances do. Only pixels that show something count.
    """

    # cameras, renders of the complete scene, [H, W, 3] in [0, 1], and where they show it, [H, W]
    views: tuple[tuple[Camera, NDArray[np.float32], NDArray[np.bool_]], ...]
    ctx: StageContext  # backend and device

    @staticmethod
    def from_renders(
        splats: Splats | SplatArrays, cameras: Sequence[Camera], ctx: StageContext
    ) -> SelfPsnr:
        """Renders `splats` at the cameras; ReconstructionError if none sees anything."""
        renders = [(camera, *_render(splats, camera, ctx)) for camera in cameras]
        views = tuple(view for view in renders if view[2].any())
        if not views:
            raise ReconstructionError(
                f"None of {len(renders)} synthetic cameras sees anything of the scene, so its "
                "files cannot be checked.",
                hint="Look at its bounds in a viewer; it may be damaged.")
        return SelfPsnr(views, ctx)

    def describe(self) -> str:
        """Returns the views as part of a sentence."""
        return (f"{len(self.views)} synthetic cameras, against renders of the scene itself, as if "
                f"it showed photos at {ASSUMED_DB:g} dB")

    def psnr_db(self, splats: Splats | SplatArrays) -> float:
        """Returns the mean over the cameras in dB, at most ASSUMED_DB."""
        values = []
        for camera, before, visible in self.views:
            image, _ = _render(splats, camera, self.ctx)
            difference = float(np.mean((image - before)[visible].astype(np.float64) ** 2))
            values.append(-10 * np.log10(10 ** (-ASSUMED_DB / 10) + difference))
        return float(np.mean(values))


def _render(
    splats: Splats | SplatArrays, camera: Camera, ctx: StageContext
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Returns an image [H, W, 3], and where it shows something [H, W]."""
    drawing = draw(splats, camera, splats.sh_degree, backend=ctx.backend, device=ctx.device)
    return drawing.rgb.clip(0, 1), drawing.alpha > np.float32(VISIBLE)
