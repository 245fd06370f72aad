"""How far the cameras of a model are from others, once the best similarity is taken off."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.datasets.layouts import read_posed
from recon_cli.io.colmap import read_images

Poses = Mapping[str, NDArray[np.float64]]  # [4, 4] camera to world by name


@dataclass(frozen=True)
class PoseErrors:
    """Errors after the best similarity.

    Rotations are given as they are and without the part that is common to all, which a shift of the
    principal point brings and no picture shows.

    Attributes:
        cameras: how many were compared.
        rmse: of the centres, in units of the reference.
        median_share: of the centres' errors, as a share of the extent (diagonal of their box).
        max_share: the largest.
        rotation_deg: median.
        own_rotation_deg: median with the common part off.
        own_rotation_max_deg: the largest.
    """

    cameras: int
    rmse: float
    median_share: float
    max_share: float
    rotation_deg: float
    own_rotation_deg: float
    own_rotation_max_deg: float


def similarity(
    found: NDArray[np.float64], truth: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64]]:
    """Scale and [4, 4] motion with truth ~ motion (scale found); both [F, 3] (Umeyama 1991)."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = float(np.trace(np.diag(s) @ flip) / (a**2).sum())
    motion = np.eye(4)
    motion[:3, :3] = u @ flip @ vt
    motion[:3, 3] = truth.mean(axis=0) - scale * motion[:3, :3] @ found.mean(axis=0)
    return scale, motion


def compare(found: Poses, truth: Poses) -> PoseErrors:
    """Returns the errors of the cameras that both hold."""
    names = sorted(set(found) & set(truth))
    ours = np.stack([found[name] for name in names])
    true = np.stack([truth[name] for name in names])
    scale, motion = similarity(ours[:, :3, 3], true[:, :3, 3])
    rotation = motion[:3, :3]
    off = np.linalg.norm(
        scale * ours[:, :3, 3] @ rotation.T + motion[:3, 3] - true[:, :3, 3], axis=1)
    extent = float(np.linalg.norm(np.ptp(true[:, :3, 3], axis=0)))
    turns = Rotation.from_matrix(
        (rotation @ ours[:, :3, :3]).transpose(0, 2, 1) @ true[:, :3, :3])
    own = np.degrees((turns.mean().inv() * turns).magnitude())
    return PoseErrors(
        len(names), float(np.sqrt((off**2).mean())), float(np.median(off)) / extent,
        float(off.max()) / extent, float(np.degrees(np.median(turns.magnitude()))),
        float(np.median(own)), float(own.max()))


def model_poses(sparse: Path) -> dict[str, NDArray[np.float64]]:
    """Returns the cameras of a COLMAP model."""
    return {name: np.linalg.inv(viewmat)
            for name, _, viewmat in read_images(sparse / "images.bin")}


def reference_poses(path: Path) -> dict[str, NDArray[np.float64]]:
    """Returns the true cameras of the frames of a capture.

    Args:
        path: a traj.txt (one 4x4 camera-to-world pose a line, line k for frame k of a video), or a
            data set that `recon ingest` takes (its images give the names).
    """
    if path.suffix == ".txt":
        lines = np.loadtxt(path).reshape(-1, 4, 4)
        return {f"{index:06d}.png": pose for index, pose in enumerate(lines)}
    return {f"{Path(image.name).stem}.png": np.linalg.inv(image.viewmat)
            for image in read_posed(path).images}


def trident_poses(data: Path) -> dict[str, NDArray[np.float64]]:
    """Returns the cameras of trident that others found; file k + 1 is frame k, OpenGL's axes."""
    path = data / "walks" / "trident_desk" / "transforms_train.json"
    return {
        f"{int(''.join(filter(str.isdigit, Path(frame['file_path']).stem))) - 1:06d}.png":
            np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        for frame in json.loads(path.read_text(encoding="utf-8"))["frames"]}
