"""The finished folders of ingest and sfm for a tiny scene of known truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch
from scenes import random_splats

from recon_cli.context import StageInputs
from recon_cli.io.images import write_png
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.workspace.atomic import write_json

WIDTH, HEIGHT, FOCAL = 48, 36, 40.0
VIEWS = 12


@dataclass(frozen=True)
class Shape:
    """Size and inner side of a camera, in pixels; the principal point in the middle and off it."""

    width: int
    height: int
    focal: float
    off_x: float = 0.0
    off_y: float = 0.0

    def at(self, viewmat: np.ndarray) -> Camera:
        return Camera(
            self.width, self.height, self.focal, self.focal, self.width / 2 + self.off_x,
            self.height / 2 + self.off_y, viewmat)


ONE = (Shape(WIDTH, HEIGHT, FOCAL),)
TWO = (Shape(48, 36, 40.0), Shape(30, 44, 34.0, 2.5, -3.0))  # landscape, portrait


@cache
def truth() -> Splats:
    """The 60 Gaussians that the views show."""
    splats = random_splats(60, seed=0, dtype=torch.float32)
    splats.means[:, 2] = 3 + 0.3 * splats.means[:, 2]  # none near a camera, no needles
    splats.log_scales.clamp_(min=-2.0, max=-1.5)
    return splats


def viewmat(i: int) -> np.ndarray:
    """World to camera of view `i`."""
    matrix = np.eye(4)
    matrix[:3, 3] = [0.4 * np.cos(i), 0.4 * np.sin(i), 0.1 * i]
    return matrix


@cache
def pixels_of(i: int, shape: Shape) -> np.ndarray:
    """View `i` of the truth, [H, W, 3] uint8."""
    with torch.no_grad():
        rgb = render(truth(), shape.at(viewmat(i)), torch.zeros(3), 0).rgb.clamp(0, 1)
    return (rgb.numpy() * 255 + 0.5).astype(np.uint8)


def make_inputs(
    folder: Path, shapes: tuple[Shape, ...] = ONE, views: int = VIEWS
) -> StageInputs:
    """Writes what ingest and sfm would have left of views of the truth.

    Each shape takes four views in a row, the first of which is held out.
    """
    model = pycolmap.Reconstruction()
    for i, shape in enumerate(shapes):
        inner = shape.at(np.eye(4))
        model.add_camera_with_trivial_rig(pycolmap.Camera(
            model="PINHOLE", width=shape.width, height=shape.height, camera_id=i + 1,
            params=[inner.fx, inner.fy, inner.cx, inner.cy]))
    images = folder / "place" / "undistorted" / "images"
    denoised = folder / "place" / "undistorted" / "denoised"
    sparse = folder / "place" / "undistorted" / "sparse"
    for path in (images, denoised, sparse, folder / "ingest"):
        path.mkdir(parents=True)
    frames = []
    for i in range(views):
        name = f"{i:06d}.png"
        group = i // 4 % len(shapes)
        pose = viewmat(i)
        pixels = pixels_of(i, shapes[group])
        write_png(images / name, pixels)
        write_png(denoised / name, pixels)
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=name, camera_id=group + 1, image_id=i + 1,
                           keypoints=np.zeros((0, 2))),
            pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3]))
        frames.append({"name": name, "time_seconds": i / 10, "source": "tiny.mp4",
                       "sharpness": 1.0, "held_out": i % 4 == 0, "group": group})
    for mean, color in zip(truth().means.numpy(), truth().sh_dc.numpy(), strict=True):
        value = ((0.282 * color + 0.5).clip(0, 1) * 255).astype(np.uint8)
        model.add_point3D(mean.astype(np.float64), pycolmap.Track(), value)
    model.write(sparse)
    write_json(folder / "ingest" / "frames.json", {
        "source": "video", "frames": frames, "groups": [{
            "name": "tiny.mp4", "width": shape.width, "height": shape.height, "focal_px": None,
            "lens": None} for shape in shapes]})
    return StageInputs({name: folder / name for name in ("ingest", "place")})


def write_masks(inputs: StageInputs, masks: dict[str, np.ndarray]) -> None:
    """Writes masks [H, W], True where a pixel counts, by the names of views."""
    folder = inputs.folders["place"] / "undistorted" / "masks"
    folder.mkdir(exist_ok=True)
    for name, mask in masks.items():
        cv2.imwrite(str(folder / name), mask.astype(np.uint8) * 255)
