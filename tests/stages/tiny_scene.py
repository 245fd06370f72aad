"""The finished folders of ingest and sfm for a tiny scene of known truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import torch
from scenes import random_splats

from recon_cli.atomic import write_json
from recon_cli.io.images import write_png
from recon_cli.render import render
from recon_cli.scene import Camera
from recon_cli.stages.context import StageInputs

WIDTH, HEIGHT, FOCAL = 48, 36, 40.0
VIEWS = 12


def make_inputs(folder: Path) -> StageInputs:
    """Renders 12 views of 60 Gaussians and writes what ingest and sfm would have left."""
    truth = random_splats(60, seed=0, dtype=torch.float32)
    truth.means[:, 2] = 3 + 0.3 * truth.means[:, 2]  # none near a camera, no needles
    truth.log_scales.clamp_(min=-2.0, max=-1.5)
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(
        model="PINHOLE", width=WIDTH, height=HEIGHT, camera_id=1,
        params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]))
    images = folder / "sfm" / "undistorted" / "images"
    denoised = folder / "sfm" / "undistorted" / "denoised"
    sparse = folder / "sfm" / "undistorted" / "sparse"
    for path in (images, denoised, sparse, folder / "ingest"):
        path.mkdir(parents=True)
    frames = []
    for i in range(VIEWS):
        name = f"{i:06d}.png"
        viewmat = np.eye(4)
        viewmat[:3, 3] = [0.4 * np.cos(i), 0.4 * np.sin(i), 0.1 * i]
        camera = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, viewmat)
        with torch.no_grad():
            rgb = render(truth, camera, torch.zeros(3), 0).rgb.clamp(0, 1)
        pixels = (rgb.numpy() * 255 + 0.5).astype(np.uint8)
        write_png(images / name, pixels)
        write_png(denoised / name, pixels)
        model.add_image_with_trivial_frame(
            pycolmap.Image(name=name, camera_id=1, image_id=i + 1, keypoints=np.zeros((0, 2))),
            pycolmap.Rigid3d(pycolmap.Rotation3d(viewmat[:3, :3]), viewmat[:3, 3]))
        frames.append({"name": name, "time_seconds": i / 10, "source": "tiny.mp4",
                       "sharpness": 1.0, "held_out": i % 4 == 0})
    for mean, color in zip(truth.means.numpy(), truth.sh_dc.numpy(), strict=True):
        value = ((0.282 * color + 0.5).clip(0, 1) * 255).astype(np.uint8)
        model.add_point3D(mean.astype(np.float64), pycolmap.Track(), value)
    model.write(sparse)
    write_json(folder / "ingest" / "frames.json", {
        "source": "video", "frames": frames, "groups": [{
            "name": "tiny.mp4", "width": WIDTH, "height": HEIGHT, "focal_px": None, "lens": None}]})
    return StageInputs({name: folder / name for name in ("ingest", "sfm")})
