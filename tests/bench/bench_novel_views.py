"""Scores a workspace on views off the camera's path, whose true poses are known.

`python tests/bench/bench_novel_views.py WORKSPACE ROOM`, with ROOM a folder in the Replica layout
of NICE-SLAM (traj.txt, results/, test/) whose video.mp4 the workspace was made from. The frame of
the reconstruction is aligned to the true one by a similarity over the camera centres (Umeyama
1991); the true test cameras are then carried into it. Prints the alignment error and, for each
model, PSNR and SSIM over the novel views at the size that was trained on.
"""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np
import torch
from numpy.typing import NDArray
from pose_errors import similarity

from recon_cli.evaluation.metrics import psnr, ssim
from recon_cli.io.colmap import read_scene
from recon_cli.io.images import fit_camera, read_image
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.splats.ply import read_ply
from recon_cli.train.train_data import read_config

FOCAL, WIDTH, HEIGHT = 300.0, 600, 340  # pixels, with the principal point at the centre


def load_poses(path: Path) -> NDArray[np.float64]:
    """Returns camera-to-world matrices [N, 4, 4]."""
    return np.loadtxt(path).reshape(-1, 4, 4)


@click.command()
@click.argument("workspace", type=click.Path(exists=True, path_type=Path))
@click.argument("room", type=click.Path(exists=True, path_type=Path))
def main(workspace: Path, room: Path) -> None:
    """Prints the scores of WORKSPACE on the novel views of ROOM."""
    config = read_config(workspace / "train")
    scene = read_scene(workspace / "sfm" / "undistorted", held_out=frozenset(), validation=0.0)
    poses = load_poses(room / "traj.txt")
    true = np.stack([poses[int(Path(view.name).stem)][:3, 3] for view in scene.train])
    ours = np.stack([view.camera.center for view in scene.train])
    scale, motion = similarity(true, ours)
    R, t = motion[:3, :3], motion[:3, 3]
    error = np.linalg.norm(ours - (scale * true @ R.T + t), axis=1) / scale
    click.echo(f"{len(ours)} cameras, centre RMSE {100 * np.sqrt((error**2).mean()):.2f} cm, "
               f"largest {100 * error.max():.2f} cm")
    images = sorted((room / "test" / "results").glob("frame*.jpg"))
    for stage in ("train", "prune"):
        path = workspace / stage / "splats.ply"
        if not path.exists():
            continue
        splats, values = read_ply(path), []
        for pose, image in zip(load_poses(room / "test" / "traj.txt"), images, strict=True):
            world = np.linalg.inv(pose)
            viewmat = np.eye(4)
            viewmat[:3, :3] = world[:3, :3] @ R.T
            viewmat[:3, 3] = scale * world[:3, 3] - viewmat[:3, :3] @ t
            camera = fit_camera(
                Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, viewmat),
                config.max_size)
            truth = read_image(image, camera.width, camera.height)
            with torch.no_grad():
                rgb = render(splats, camera, splats.background, config.sh_degree).rgb.numpy()
            values.append((psnr(rgb, truth), ssim(rgb, truth)))
        mean = np.mean(values, axis=0)
        click.echo(f"{stage}: {len(values)} novel views, {mean[0]:.2f} dB, SSIM {mean[1]:.4f}, "
                   f"{len(splats):,} Gaussians")


if __name__ == "__main__":
    main()
