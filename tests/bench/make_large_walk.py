"""Photos of a walk that nobody filmed: `python tests/bench/make_large_walk.py WORKSPACE OUT`.

Renders a trained scene along a spline through its cameras, with a little sensor noise, so that
many large frames can be mapped where no such capture is at hand.
"""

from __future__ import annotations

from pathlib import Path

import click
import cv2
import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from recon_cli.io.colmap import read_cameras, read_images
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.splats.ply import read_ply

NOISE = 2.0  # 1/255, as a phone's frames by daylight
QUALITY = 92  # of JPEG


@click.command()
@click.argument("workspace", type=click.Path(exists=True, path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--frames", default=200, show_default=True)
@click.option("--width", default=1280, show_default=True)
@click.option("--height", default=720, show_default=True)
def main(workspace: Path, out: Path, frames: int, width: int, height: int) -> None:
    """Writes the photos."""
    splats = read_ply(workspace / "train" / "splats.ply")
    sparse = workspace / "sfm" / "undistorted" / "sparse"
    given = read_cameras(sparse / "cameras.bin")
    images = sorted(read_images(sparse / "images.bin"), key=lambda image: image[0])
    inner = given[images[0][1]]
    poses = np.linalg.inv(np.array([viewmat for _, _, viewmat in images]))
    places = np.arange(len(poses))
    turn = Slerp(places, Rotation.from_matrix(poses[:, :3, :3]))
    path = CubicSpline(places, poses[:, :3, 3])
    draws = np.random.default_rng(0)
    out.mkdir(parents=True, exist_ok=True)
    for index, place in enumerate(np.linspace(0, len(poses) - 1, frames)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn([place]).as_matrix()[0], path(place)
        focal = inner.fx * width / inner.width
        camera = Camera(
            width, height, focal, focal, width / 2, height / 2, np.linalg.inv(pose))
        with torch.no_grad():
            rgb = render(splats, camera, torch.zeros(3), 3, backend="numba").rgb.clamp(0, 1)
        seen = 255 * rgb.numpy() + draws.normal(0, NOISE, rgb.shape)
        bgr = np.clip(np.rint(seen), 0, 255).astype(np.uint8)[:, :, ::-1]
        cv2.imwrite(str(out / f"{index:04d}.jpg"), bgr, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
