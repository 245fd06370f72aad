"""From what a rasterizer returns to pictures: colour, depth in whole steps, coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.errors import ConfigError
from recon_cli.flythrough.request import ALPHA, DEPTH, RGB, Request
from recon_cli.flythrough.smooth import depths_seen
from recon_cli.io.calibration import MAX_SIDE
from recon_cli.io.images import eight_bit, write_png
from recon_cli.machine import free_memory_bytes
from recon_cli.render import RenderOutput
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats

# Of a frame with all outputs, from 1200x680 to 3000x1700 pixels: 55 with numba, 93 with torch.
_BYTES_PER_PIXEL = 100


def frame_size(width: int, height: int, request: Request) -> tuple[int, int]:
    """Returns the (width, height) of frames whose own size is `width` x `height`.

    A side that is not given follows from the other; for a video it is even.

    Raises:
        ConfigError: a side that was given is odd, but is to be that of a video.
    """
    given = (request.width, request.height)
    if request.size:
        given = (request.size, None) if width >= height else (None, request.size)
    if request.video and any(side and side % 2 for side in given):
        raise ConfigError(
            f"A video of {_words(given)} cannot be: H.264 and AV1 store the colour of two by two "
            "pixels at once, so sides are even.", hint="Give even numbers.")
    factor = _factor(given, (width, height))
    step = 2 if request.video else 1
    sides = [side or max(step, step * round(own * factor / step))
             for side, own in zip(given, (width, height), strict=True)]
    return sides[0], sides[1]


def _factor(given: tuple[int | None, int | None], own: tuple[int, int]) -> float:
    return next((side / one for side, one in zip(given, own, strict=True) if side), 1.0)


def _words(given: tuple[int | None, int | None]) -> str:
    return " by ".join(str(side) for side in given if side) + " pixels"


def refuse_what_does_not_fit(width: int, height: int) -> None:
    """Raises ConfigError unless a frame of this size can be rendered in the memory that is free."""
    needed, free = width * height * _BYTES_PER_PIXEL, free_memory_bytes()
    if needed > free or max(width, height) > MAX_SIDE:
        raise ConfigError(
            f"A picture of {width}x{height} pixels takes about {needed / 1e6:,.0f} MB to render; "
            f"{free / 1e6:,.0f} MB are free, and {MAX_SIDE:,} pixels are the longest side.",
            hint="Lower --size, or --width and --height.")


DEPTH_COLOR = "depth_color"
SHOWN = {RGB: RGB, DEPTH: DEPTH_COLOR, ALPHA: ALPHA}  # the pictures that a video of it shows
FOLDERS = {RGB: (RGB,), DEPTH: (DEPTH, DEPTH_COLOR), ALPHA: (ALPHA,)}
FARTHEST = 65_535  # steps; what is farther has this depth too
_MOST = 0.5  # of the light: where less meets a surface, there is none to have a depth
# Depths that nearly all points lie between. Few points may cover much of a picture where a camera
# comes close, so the colours begin at half of the first.
_ENDS = (0.02, 0.98)
_BLUE = 0.08  # of the colour map; what comes before is nearly as black as nothing


@dataclass(frozen=True)
class DepthScale:
    """What depth pictures mean.

    Attributes:
        metres: a step is a millimetre; else it is a thousandth of the scene's extent.
        step: of a 16-bit depth in world units.
        near: depth in world units that is drawn red.
        far: depth in world units that is drawn blue.
        center: [3] of the training cameras, world units.
        reach: Gaussians farther than this from `center` are no surface, in world units.
    """

    metres: bool
    step: float
    near: float
    far: float
    center: tuple[float, float, float]
    reach: float

    def to_json(self) -> dict[str, Any]:
        """Returns what a reader of the pictures must know."""
        return {
            "unit": "millimetre" if self.metres else "thousandth of the scene's extent",
            "world_units_per_step": self.step, "nothing": 0, "this_or_farther": FARTHEST,
            "colors": {"near_red_steps": self.near / self.step,
                       "far_blue_steps": self.far / self.step},
            "surfaces_within": {"center": list(self.center), "world_units": self.reach},
        }

    def surfaces(self, splats: Splats) -> Splats:
        """Returns the Gaussians whose depth means something: those of the room, not of its views.

        What lies outside windows is a hundred extents away; a hundredth of its light that shines
        through a wall would move the wall's mean depth by an extent.
        """
        inside = splats.within(self.center, self.reach)
        return splats if bool(inside.all()) else splats.select(inside)


def depth_scale(scene: Scene, *, metres: bool) -> DepthScale:
    """Returns the scale for a scene; colours span what its training cameras see.

    The colours end where the scene does, not where a frame does, so that a video does not flicker.
    """
    seen = np.concatenate([depths_seen(view.camera, scene.points) for view in scene.train])
    near, far = np.quantile(seen, _ENDS) if len(seen) else (0.0, scene.extent)
    step = 1e-3 if metres else 1e-3 * scene.extent
    x, y, z = map(float, scene.center)
    return DepthScale(
        metres, step, float(near / 2), float(max(far, near + step)), (x, y, z), scene.reach)


def write_pictures(
    folder: Path, name: str, shown: RenderOutput, surfaces: RenderOutput, outputs: Sequence[str],
    scale: DepthScale,
) -> None:
    """Writes the pictures of one frame, each whole or not at all; depth is that of `surfaces`."""
    file = f"{name}.png"
    for output in outputs:
        if output == RGB:
            write_png(folder / RGB / file, eight_bit(_array(shown.rgb)))
        elif output == ALPHA:
            write_png(folder / ALPHA / file, eight_bit(_array(shown.alpha)))
        else:
            steps = depth_steps(
                _array(surfaces.depth), _array(surfaces.alpha), scale.step)
            write_png(folder / DEPTH / file, steps)
            write_png(folder / DEPTH_COLOR / file, depth_colors(steps, scale))


def _array(tensor: Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = tensor.cpu().numpy()
    return array


def depth_steps(
    depth: NDArray[np.float32], alpha: NDArray[np.float32], step: float
) -> NDArray[np.uint16]:
    """Returns z-depth [H, W] in whole steps: the mean of what covers a pixel, by alpha T.

    0 where less than half of the light meets a surface. What is nearer than half a step has 1, what
    is beyond 16 bits has 65535.

    Args:
        depth: [H, W] sum of alpha T z in world units.
        alpha: [H, W] coverage.
        step: in world units.
    """
    there = alpha >= _MOST
    mean = depth.astype(np.float64) / np.where(there, alpha, 1) / step
    return np.where(there, np.clip(np.rint(mean), 1, FARTHEST), 0).astype(np.uint16)


def depth_colors(steps: NDArray[np.uint16], scale: DepthScale) -> NDArray[np.uint8]:
    """Returns RGB [H, W, 3]: red is near, blue is far, black is nothing."""
    nearness = np.clip((scale.far - steps * scale.step) / (scale.far - scale.near), 0, 1)
    place = (_BLUE + (1 - _BLUE) * nearness).astype(np.float32)
    colors = cv2.applyColorMap(eight_bit(place), cv2.COLORMAP_TURBO)
    rgb = np.asarray(colors[:, :, ::-1], np.uint8).copy()
    rgb[steps == 0] = 0
    return rgb
