"""The pictures of a frame: colour, 16-bit depth and its colours, alpha."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.flythrough.paths import visible_depths
from recon_cli.flythrough.request import ALPHA, DEPTH, RGB
from recon_cli.io.images import to_uint8, write_png
from recon_cli.render import RenderOutput
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats

DEPTH_COLOR = "depth_color"
VIDEO_FRAMES = {RGB: RGB, DEPTH: DEPTH_COLOR, ALPHA: ALPHA}  # the frames of its video
FOLDERS = {RGB: (RGB,), DEPTH: (DEPTH, DEPTH_COLOR), ALPHA: (ALPHA,)}
FARTHEST = 65_535  # steps; greater depths are clipped to it
_MIN_ALPHA = 0.5  # a pixel with less has no depth
# Depths that nearly all points lie between. Few points may cover much of a picture where a camera
# comes close, so the colours begin at half of the first.
_ENDS = (0.02, 0.98)
_BLUE = 0.08  # of the colour map; colours before that are nearly black


@dataclass(frozen=True)
class DepthScale:
    """The scale of depth pictures; lengths are in world units."""

    metres: bool  # a step is a millimetre; else it is a thousandth of the scene's extent
    step: float  # of a 16-bit depth
    near: float  # depth that is drawn red
    far: float  # depth that is drawn blue
    center: tuple[float, float, float]  # of the training cameras
    reach: float  # Gaussians farther than this from `center` count as no surface

    def to_json(self) -> dict[str, Any]:
        """Returns the scale for readers of the pictures."""
        return {
            "unit": "millimetre" if self.metres else "thousandth of the scene's extent",
            "world_units_per_step": self.step, "nothing": 0, "this_or_farther": FARTHEST,
            "colors": {"near_red_steps": self.near / self.step,
                       "far_blue_steps": self.far / self.step},
            "surfaces_within": {"center": list(self.center), "world_units": self.reach},
        }

    def select_surfaces(self, splats: Splats) -> Splats:
        """Returns the Gaussians of the room, without the distant ones outside its windows.

        Distant Gaussians are a hundred extents away: with a weight of a hundredth behind a wall,
        they would move the wall's mean depth by an extent.
        """
        inside = splats.within(self.center, self.reach)
        return splats if bool(inside.all()) else splats.select(inside)


def depth_scale(scene: Scene, *, metres: bool) -> DepthScale:
    """Returns the scale for a scene; colours span the depths that its training cameras see.

    The range is that of the scene, not of each frame, so that a video does not flicker.
    """
    depths = np.concatenate([visible_depths(view.camera, scene.points) for view in scene.train])
    near, far = np.quantile(depths, _ENDS) if len(depths) else (0.0, scene.extent)
    step = 1e-3 if metres else 1e-3 * scene.extent
    x, y, z = map(float, scene.center)
    return DepthScale(
        metres, step, float(near / 2), float(max(far, near + step)), (x, y, z), scene.reach)


def write_frame(
    folder: Path, name: str, output: RenderOutput, surfaces: RenderOutput, kinds: Sequence[str],
    scale: DepthScale,
) -> None:
    """Writes the pictures of one frame, each atomically; depth is that of `surfaces`."""
    file = f"{name}.png"
    for kind in kinds:
        if kind == RGB:
            write_png(folder / RGB / file, to_uint8(_array(output.rgb)))
        elif kind == ALPHA:
            write_png(folder / ALPHA / file, to_uint8(_array(output.alpha)))
        else:
            steps = depth_steps(_array(surfaces.depth), _array(surfaces.alpha), scale.step)
            write_png(folder / DEPTH / file, steps)
            write_png(folder / DEPTH_COLOR / file, depth_colors(steps, scale))


def _array(tensor: Tensor) -> NDArray[np.float32]:
    array: NDArray[np.float32] = tensor.cpu().numpy()
    return array


def depth_steps(
    depth: NDArray[np.float32], alpha: NDArray[np.float32], step: float
) -> NDArray[np.uint16]:
    """Returns z-depth [H, W] in whole steps, the mean weighted by alpha T.

    0 where alpha is below one half; otherwise clipped to 1 to 65535.

    Args:
        depth: [H, W] sum of alpha T z in world units.
        alpha: [H, W] accumulated opacity.
        step: in world units.
    """
    covered = alpha >= _MIN_ALPHA
    mean = depth.astype(np.float64) / np.where(covered, alpha, 1) / step
    return np.where(covered, np.clip(np.rint(mean), 1, FARTHEST), 0).astype(np.uint16)


def depth_colors(steps: NDArray[np.uint16], scale: DepthScale) -> NDArray[np.uint8]:
    """Returns RGB [H, W, 3]: red is near, blue is far, black is nothing."""
    nearness = np.clip((scale.far - steps * scale.step) / (scale.far - scale.near), 0, 1)
    level = (_BLUE + (1 - _BLUE) * nearness).astype(np.float32)
    colors = cv2.applyColorMap(to_uint8(level), cv2.COLORMAP_TURBO)
    rgb = np.asarray(colors[:, :, ::-1], np.uint8).copy()
    rgb[steps == 0] = 0
    return rgb
