"""Which verified pairs of images agree with cameras, are off by a drift, or only look alike."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.features.matching import read_matched_pixels
from recon_cli.sfm.limits import (
    MAX_DRIFT,
    MAX_DRIFT_DEG,
    MAX_ERROR_PX,
    MAX_TRIALS,
    MIN_PAIR_EXPLAINED,
    NEAR_FRAMES,
)
from recon_cli.sfm.model_arrays import ModelArrays, Pair
from recon_cli.sfm.verdict.evidence import (
    explained_matches,
    inverse_depths,
    lift_rays,
    nearest_depth,
)


@dataclass(frozen=True)
class PairChecks:
    """Verified pairs of images, by what a skeleton says of them."""

    agreeing: frozenset[Pair]
    drifted: frozenset[Pair]  # off by what the cameras may drift between the two
    contradicting: frozenset[Pair]
    unplaced: frozenset[Pair]  # not both images have a camera in one model


def check_pairs(
    path: Path, views: Mapping[str, PlacedView],
    geometries: Mapping[Pair, pycolmap.TwoViewGeometry],
) -> PairChecks:
    """Returns which verified pairs of a database agree with the cameras of views, by name."""
    agreeing, drifted, contradicting, unplaced = set(), set(), set(), set()
    for pair, ours, theirs in read_matched_pixels(path, geometries):
        first, second = (views.get(name) for name in pair)
        if first is None or second is None or first.group != second.group:
            unplaced.add(pair)
            continue
        explained = explained_matches(
            first.image, ours, second.image, theirs, first.near, MAX_ERROR_PX)
        if explained.mean() >= MIN_PAIR_EXPLAINED:
            agreeing.add(pair)
        elif _is_drift(first, ours, second, theirs):
            drifted.add(pair)
        else:
            contradicting.add(pair)
    supported = _supported(drifted, agreeing)
    return PairChecks(
        frozenset(agreeing), frozenset(supported),
        frozenset(contradicting | (drifted - supported)), frozenset(unplaced))


@dataclass(frozen=True, eq=False)
class PlacedView:
    """An image with a camera."""

    group: int  # images of one group are in one frame
    image: pycolmap.Image
    near: float  # depth that no point is nearer than
    usual: float  # median depth of its points
    travelled: float  # length of the path of the camera up to here, in order of names

    @property
    def camera(self) -> pycolmap.Camera:
        """The camera of the image."""
        return self.image.camera


def list_models(models: Sequence[pycolmap.Reconstruction]) -> dict[str, PlacedView]:
    """Returns the images of models by name, each model in its own frame; the first one wins."""
    views: dict[str, PlacedView] = {}
    for index, model in reversed(list(enumerate(models))):
        views |= list_views([(model, None)], group=index)
    return views


def list_views(
    parts: Sequence[tuple[pycolmap.Reconstruction, Collection[str] | None]], *, group: int = 0
) -> dict[str, PlacedView]:
    """Returns images of models that lie in one frame, those named from each or all, by name."""
    found: list[tuple[pycolmap.Image, float, float]] = []
    for model, names in parts:
        arrays = ModelArrays.from_model(model)
        for row, image in enumerate(arrays.images):
            if names is None or image.name in names:
                depths = arrays.depths(row)
                usual = float(np.median(depths)) if len(depths) else 0.0
                found.append((image, nearest_depth(depths), usual))
    views: dict[str, PlacedView] = {}
    travelled, last = 0.0, None
    for image, near, usual in sorted(found, key=lambda entry: entry[0].name):
        center = image.projection_center()
        travelled += 0.0 if last is None else float(np.linalg.norm(center - last))
        last = center
        views[image.name] = PlacedView(group, image, near, usual, travelled)
    return views


def _is_drift(
    first: PlacedView, ours: NDArray[np.float64], second: PlacedView, theirs: NDArray[np.float64]
) -> bool:
    """Returns whether matches [M, 2] show a motion as near the skeleton's as drift leaves it.

    The length of the translation follows from the usual depth of the first image.
    """
    rows = np.repeat(np.arange(len(ours), dtype=np.uint32)[:, None], 2, axis=1)
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = 0
    options.ransac.max_num_trials = MAX_TRIALS
    own = pycolmap.estimate_calibrated_two_view_geometry(
        first.camera, ours, second.camera, theirs, rows, options).cam2_from_cam1
    if own is None:
        return False
    motion = second.image.cam_from_world() * first.image.cam_from_world().inverse()
    if np.degrees((own.rotation * motion.rotation.inverse()).angle()) > MAX_DRIFT_DEG:
        return False
    at_infinity = lift_rays(first.camera, ours) @ own.rotation.matrix().T
    target = np.asarray(second.camera.cam_from_img(theirs))
    inverse = inverse_depths(at_infinity, target, own.translation)
    length = first.usual * max(float(np.median(inverse)), 0.0)
    off = np.linalg.norm(own.translation * length - motion.translation)
    return bool(off <= MAX_DRIFT * abs(second.travelled - first.travelled))


def _supported(drifted: Collection[Pair], agreeing: Collection[Pair]) -> set[Pair]:
    """Returns the pairs beside which another pair of near frames shows drift as well."""
    names = sorted({name for pair in (*drifted, *agreeing) for name in pair})
    row = {name: index for index, name in enumerate(names)}
    places = np.array([[row[name] for name in pair] for pair in drifted]).reshape(-1, 2)
    return {
        pair for pair, place in zip(drifted, places, strict=True)
        if np.count_nonzero(np.abs(places - place).max(axis=1) <= NEAR_FRAMES) > 1}
