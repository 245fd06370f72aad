"""The views of a reconstruction, split by their permitted use."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.cells import Cell
from recon_cli.scene.faces import face_order, is_cube_face, middle_axes

_REACH = 20.0  # extents; a room reaches some
_LEAST_EXTENT = 0.05  # of the median distance of the points; a step aside in a room
_SAMPLES = 2000  # points looked at


@dataclass(frozen=True, eq=False)
class View:
    """One registered image."""

    name: str  # file name of its image: that of its frame, unless it is a face
    camera: Camera  # pinhole camera at the size of the undistorted image
    original: Path  # the undistorted image; scores are against these pixels
    denoised: Path  # the undistorted denoised twin; equal to `original` where nothing was denoised
    mask: Path | None = None  # undistorted, 255 where a pixel counts; None where all do
    face_of: str | None = None  # name of the frame of which it is one of several faces, if it is

    @property
    def frame(self) -> str:
        """The file name of its frame."""
        return self.face_of or self.name


@dataclass(frozen=True, eq=False)
class Scene:
    """Registered views and sparse points."""

    train: tuple[View, ...]  # views that gradients may come from
    validation: tuple[View, ...]  # views that steer decisions (progress, tuning), never trained on
    test: tuple[View, ...]  # held-out views that only scores may look at
    unregistered_test: tuple[str, ...]  # names of held-out frames that have no camera
    points: NDArray[np.float64]  # [P, 3] float64 sparse points in world units
    colors: NDArray[np.uint8]  # [P, 3] uint8 their RGB colours
    up: NDArray[np.float64] | None = None  # [3] unit vector; None where it is not known
    sparse: Path | None = None  # folder of the COLMAP model that all of it was read from
    depth: Path | None = None  # folder of ingest, where it has sensor depth
    cell: Cell | None = None  # the part that is modelled, of a block of a larger scene; None: all

    @property
    def extent(self) -> float:
        """1.1 times the greatest distance of a training camera from their mean (INRIA 3DGS).

        At least a twentieth of the median distance of the points from there: cameras in one place
        have no extent of their own, and rates that are multiplied by it would move nothing.
        """
        centers = np.stack([view.camera.center for view in self.train])
        middle = centers.mean(axis=0)
        path = 1.1 * np.linalg.norm(centers - middle, axis=1).max()
        reach = np.median(np.linalg.norm(self.points - middle, axis=1)) if len(self.points) else 0
        return float(max(path, _LEAST_EXTENT * reach))

    @property
    def center(self) -> NDArray[np.float64]:
        """Mean of the training cameras, [3] in world units."""
        return np.asarray(np.mean([view.camera.center for view in self.train], axis=0))

    @property
    def reach(self) -> float:
        """Distance from `center` within which the room lies, world units; windows show more."""
        return _REACH * self.extent

    @property
    def nearness(self) -> float:
        """Median distance of the points from the nearest training camera, world units."""
        centers = np.stack([view.camera.center for view in self.train])
        nearest = np.min(np.linalg.norm(
            self.points[:: max(1, len(self.points) // _SAMPLES), None] - centers, axis=2), axis=1)
        return float(np.median(nearest))


def views_ahead(views: Sequence[View]) -> tuple[View, ...]:
    """Returns the views that show the way of the camera: of several faces the one that looks ahead.

    That is the first in the order of `scene.faces` of those that are there. Faces of a wide lens
    lie around its axis: the first of them is turned to it.
    """
    by_frame: dict[str, list[View]] = {}
    for view in views:
        by_frame.setdefault(view.frame, []).append(view)
    ahead = {}
    for each in by_frame.values():
        first = min(each, key=lambda view: face_order(view.name)) if len(each) > 1 else each[0]
        aside = len(each) > 1 and not is_cube_face(first.name)
        ahead[first.name] = _turn_ahead(first, each) if aside else first
    return tuple(ahead[view.name] for view in views if view.name in ahead)


def _turn_ahead(first: View, views: Sequence[View]) -> View:
    """Returns a face of a wide lens, turned to the middle of all of them."""
    camera, viewmat = first.camera, np.eye(4)
    viewmat[:3, :3] = middle_axes([view.camera.viewmat[:3, :3] for view in views])
    viewmat[:3, 3] = -viewmat[:3, :3] @ camera.center
    return replace(first, camera=replace(
        camera, cx=camera.width / 2, cy=camera.height / 2, viewmat=viewmat))


def split_views(
    views: Sequence[View], held_out: frozenset[str], *, validation: float | frozenset[str]
) -> tuple[tuple[View, ...], tuple[View, ...], tuple[View, ...]]:
    """Returns (train, validation, test) views, each sorted by name.

    The test views are those of the frames named in `held_out`. Of the other frames a share of
    `validation`, evenly spread and at least one where the share is above 0 and four remain, is set
    apart with all of their views; or the views named in `validation`.
    """
    ordered = sorted(views, key=lambda view: view.name)
    test = tuple(view for view in ordered if view.frame in held_out)
    rest = [view for view in ordered if view.frame not in held_out]
    if isinstance(validation, frozenset):
        chosen = {i for i, view in enumerate(rest) if view.name in validation}
        return (tuple(view for i, view in enumerate(rest) if i not in chosen),
                tuple(rest[i] for i in sorted(chosen)), test)
    frames = list(dict.fromkeys(view.frame for view in rest))
    count = max(1, round(len(frames) * validation)) if validation > 0 and len(frames) >= 4 else 0
    apart = {frames[int((i + 0.5) * len(frames) / count)] for i in range(count)}
    return (tuple(view for view in rest if view.frame not in apart),
            tuple(view for view in rest if view.frame in apart), test)
