"""What the poses and the depth of a device say about the scale of a model.

Poses drift, so their motion from frame to frame is compared with that of the model, and not where
they are. Depth is compared at the points of the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from recon_cli.io.colmap_library import pycolmap
from recon_cli.io.depth_maps import (
    LEAST_POINTS,
    MOST_NOISE,
    find_visible,
    lens_camera,
    read_depth_list,
    read_sure_depth,
)
from recon_cli.room.scale_fusion import GIVEN_ERROR, ScaleSource
from recon_cli.scene.gravity import MAX_UP_SPREAD_DEG
from recon_cli.scene.statistics import robust_sigma
from recon_cli.sfm.job import PlaceJob
from recon_cli.sfm.model_arrays import ModelArrays, registered_images
from recon_cli.workspace.records import read_poses

Viewmats = Mapping[str, NDArray[np.float64]]  # [4, 4] world to camera by name

TRACKED, DEPTH = "the tracked poses", "sensor depth"  # sources
# Frames apart, of the motions that are compared: the drift of near frames is small, and of far
# ones the noise. The distance with the smallest error is taken.
LAGS = (1, 2, 4, 8, 16)
BLOCKS = (5, 12)  # least and most parts of a walk, one of which is left out at a time
FEWEST_FRAMES = 2 * BLOCKS[0]  # fewer fit any motion
DEPTH_ERROR = 0.005  # as GIVEN_ERROR, of depths
# Poses of another capture: turns from frame to frame differ by more than this (degrees, and as a
# share), or lengths by more than this share, in the median.
MAX_TURN_DEG, MAX_TURN_SHARE, MAX_LENGTH_SHARE = 2.0, 0.1, 0.2
MOST_DEPTH_MAPS = 40  # evenly spread
_UNFIT = ("Sensor depth gives neither scale nor points: few points of the model have some, or it "
          "differs from them.")


@dataclass(frozen=True)
class DeviceEvidence:
    """What the device or data set of a capture says about the world of a model."""

    metric: bool = False  # the model's unit is the metre, as the data set says
    axes_open: bool = True  # up is to be found; else the axes stay
    up: tuple[float, float, float] | None = None  # in the model, where it is known
    sources: tuple[ScaleSource, ...] = ()
    remark: str = ""  # a sentence, where depth is not used

    @property
    def depth_scale(self) -> float | None:
        """Metres of a unit of the model by its depth, which may differ from those by all."""
        return next((source.scale for source in self.sources if source.name == DEPTH), None)


def ask_device(
    job: PlaceJob, model: pycolmap.Reconstruction, viewmats: Viewmats
) -> DeviceEvidence:
    """Returns what the poses and the depth of a job say about its model of these cameras.

    Poses that were solved or rendered are what they say; those that were tracked are measured.
    """
    if job.poses is None:
        return DeviceEvidence()
    known, refuted = read_poses(job.poses), job.pose_use == "refuted"
    if known.accuracy != "tracked" and not refuted:
        return DeviceEvidence(known.metric, known.find_up or known.up is not None, known.up)
    sources = []
    if known.metric:
        sources = [source for source in (
            scale_from_poses(viewmats, known.viewmats),
            scale_from_depth(model, job.poses.parent)) if source is not None]
    fits = any(source.name == DEPTH for source in sources)
    remark = _UNFIT if known.metric and not fits and read_depth_list(job.poses.parent) else ""
    if refuted:
        return DeviceEvidence(sources=tuple(sources), remark=remark)
    up = None if known.up is None else up_from_poses(viewmats, known.viewmats, known.up)
    return DeviceEvidence(
        known.metric, known.find_up or known.up is not None, up, tuple(sources), remark)


def scale_from_poses(found: Viewmats, tracked: Viewmats) -> ScaleSource | None:
    """Returns the metres of a unit of the `found` cameras, by `tracked` ones in metres.

    None where too few frames have both, or their motions do not fit each other.
    """
    names = sorted(set(found) & set(tracked))
    if len(names) < FEWEST_FRAMES:
        return None
    ours, theirs = (np.array([views[name] for name in names]) for views in (found, tracked))
    if not _same_motion(ours, theirs):
        return None
    estimates = [_compare_lengths(ours, theirs, lag) for lag in LAGS
                 if lag == 1 or len(names) >= FEWEST_FRAMES * lag]
    scale, error = min(estimates, key=lambda estimate: estimate[1])
    return ScaleSource(TRACKED, scale, float(np.hypot(error, GIVEN_ERROR)))


def _same_motion(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> bool:
    """Returns whether cameras [N, 4, 4] turn and go alike, up to scale.

    Motions over a tenth of the walk: those of single steps are as small as their noise.
    """
    lag = max(1, min(LAGS[-1], len(ours) // FEWEST_FRAMES))
    (turns, lengths), (their_turns, their_lengths) = (
        _motions(views, lag) for views in (ours, theirs))
    allowed = np.maximum(MAX_TURN_DEG, MAX_TURN_SHARE * turns)
    if np.median(np.abs(their_turns - turns) / allowed) > 1:
        return False
    usual = float(np.median(their_lengths))
    scale = usual / max(float(np.median(lengths)), 1e-12)
    return bool(np.median(np.abs(their_lengths - scale * lengths)) <= MAX_LENGTH_SHARE * usual)


def _motions(
    views: NDArray[np.float64], lag: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns how far cameras [N, 4, 4] turn (degrees) and go, to those `lag` later, [N - lag]."""
    turns = Rotation.from_matrix(views[lag:, :3, :3] @ views[:-lag, :3, :3].transpose(0, 2, 1))
    centers = -np.einsum("nji,nj->ni", views[:, :3, :3], views[:, :3, 3])
    return (np.degrees(turns.magnitude()),
            np.asarray(np.linalg.norm(centers[lag:] - centers[:-lag], axis=1)))


def _compare_lengths(
    ours: NDArray[np.float64], theirs: NDArray[np.float64], lag: int
) -> tuple[float, float]:
    """Returns the ratio of the lengths of motions, and its relative standard error.

    Least squares, reweighted so that jumps of the tracking count little; the error is that of
    leaving out one stretch of the walk after another (block jackknife).
    """
    _, one = _motions(ours, lag)
    _, other = _motions(theirs, lag)
    weights, scale = np.ones(len(one)), 1.0
    for _ in range(10):
        scale = float((weights * one * other).sum() / max((weights * one**2).sum(), 1e-12))
        off = np.abs(other - scale * one)
        weights = 1 / (1 + (off / max(3 * float(np.median(off)), 1e-12))**2)
    blocks = np.clip(len(one) // (2 * lag), *BLOCKS)
    above, below = weights * one * other, weights * one**2
    ratios = np.array([
        (above.sum() - above[rows].sum()) / max(below.sum() - below[rows].sum(), 1e-12)
        for rows in np.array_split(np.arange(len(one)), blocks)])
    error = float(np.sqrt((blocks - 1) / blocks * ((ratios - ratios.mean())**2).sum()))
    return scale, error / scale


def up_from_poses(
    found: Viewmats, tracked: Viewmats, up: tuple[float, float, float]
) -> tuple[float, float, float] | None:
    """Returns up among the `found` cameras, which the device felt among `tracked` ones.

    None where single frames do not agree about it.
    """
    names = sorted(set(found) & set(tracked))
    if not names:
        return None
    single = np.array([
        found[name][:3, :3].T @ tracked[name][:3, :3] @ np.array(up) for name in names])
    mean = np.median(single, axis=0)
    length = float(np.linalg.norm(mean))
    if length == 0:
        return None
    mean /= length
    angles = np.degrees(np.arccos(np.clip(single @ mean, -1, 1)))
    if np.median(angles) > MAX_UP_SPREAD_DEG:
        return None
    return float(mean[0]), float(mean[1]), float(mean[2])


def scale_from_depth(model: pycolmap.Reconstruction, ingest: Path) -> ScaleSource | None:
    """Returns the metres of a unit of a model, by the depth maps of ingest, which are in metres.

    None without enough depth at points of the model, or if it does not fit them. FormatError if a
    map is damaged.
    """
    maps = read_depth_list(ingest)
    names = sorted(set(maps) & {image.name for image in registered_images(model)})
    count = min(len(names), MOST_DEPTH_MAPS)
    arrays = ModelArrays.from_model(
        model, [names[int((at + 0.5) * len(names) / count)] for at in range(count)])
    ratios, every = [], []
    for index, image in enumerate(arrays.images):
        one, ours = maps[image.name], arrays.depths(index)
        depth = read_sure_depth(ingest, image.name, one)
        pixels, ours = arrays.xy[arrays.observed(index)][ours > 0], ours[ours > 0]
        if not len(pixels):
            continue
        rays = np.asarray(image.camera.cam_from_img(pixels))
        rows, column, line = find_visible(
            lens_camera(one.lens), np.column_stack([rays, np.ones(len(rays))]))
        theirs = depth[line, column].astype(np.float64)
        known = theirs > 0
        if known.sum() >= LEAST_POINTS:
            every.append(theirs[known] / ours[rows][known])
            ratios.append(float(np.median(every[-1])))
    if len(ratios) < BLOCKS[0]:
        return None
    scale = float(np.median(ratios))
    noise = robust_sigma(np.concatenate(every) / scale - 1)
    if noise > MOST_NOISE:
        return None
    spread = robust_sigma(np.array(ratios) / scale - 1)
    # of a median: 1.25 times that of a mean
    error = 1.25 * spread / np.sqrt(len(ratios))
    return ScaleSource(DEPTH, scale, float(np.hypot(error, DEPTH_ERROR)))


