"""Scores of whole frames from those of their faces, each direction once, by its solid angle.

The frames are panoramas, or those of a wide lens.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.evaluation.metrics import both_ssim, corrected_psnr, to_decibels, weighted_error
from recon_cli.evaluation.scores import ViewScore
from recon_cli.io.images import to_uint8
from recon_cli.io.panoramas import panorama_axes, panorama_size, stitch_faces
from recon_cli.io.views import ReferenceView
from recon_cli.scene.faces import is_cube_face, shared_out_angles
from recon_cli.scene.train_view import without_border


@dataclass(frozen=True)
class FaceScore:
    """What one face adds to the score of its frame: sums over solid angles."""

    frame: str  # its name
    whole: float  # of all faces of the frame without masks, steradian
    angle: float  # of the pixels that count, steradian
    inner_angle: float  # of those off the border, where SSIM is known
    error: float  # squared
    error_8bit: float
    ssim: float
    ssim_padded: float
    corrected: float  # squared error after the best gain


@dataclass(frozen=True, eq=False)
class FaceWeights:
    """How much the pixels of a face count for the score of its frame."""

    pixels: NDArray[np.float64]  # [H, W], solid angles; zero if masked, or another face is nearer
    whole: float  # of all faces of its frame without masks, steradian; a panorama is the sphere


def face_weights(views: Sequence[ReferenceView]) -> dict[str, FaceWeights]:
    """Returns the weights of faces, by name; empty where no view is a face."""
    faces: dict[str, list[ReferenceView]] = {}
    for view in views:
        if view.face_of is not None:
            faces.setdefault(view.face_of, []).append(view)
    weights = {}
    for each in faces.values():
        angles = shared_out_angles([view.camera for view in each])
        whole = 4 * math.pi if is_cube_face(each[0].name) else float(sum(map(np.sum, angles)))
        for view, own in zip(each, angles, strict=True):
            weights[view.name] = FaceWeights(
                own if view.mask is None else own * view.mask, whole)
    return weights


def score_face(
    view: ReferenceView, image: NDArray[np.float32], own: FaceWeights
) -> FaceScore:
    """Returns what the render [H, W, 3] of a face adds to the score of its frame."""
    assert view.face_of is not None
    weights = own.pixels
    photo, counts = view.image, weights > 0
    inner = float(without_border(weights).sum())
    angle = float(weights.sum())
    similar = padded = corrected = 0.0
    if inner > 0:
        similar, padded = both_ssim(image, photo, counts, weights=weights)
        similar, padded = inner * similar, angle * padded
        corrected = angle * 10 ** (-corrected_psnr(image, photo, counts) / 10)
    return FaceScore(
        view.face_of, own.whole, angle, inner, weighted_error(image, photo, weights),
        weighted_error(to_uint8(image), photo, weights), similar, padded, corrected)


def join_faces(faces: Sequence[FaceScore]) -> list[tuple[ViewScore, float]]:
    """Returns the score of each frame, and its PSNR after the best gains, in order of names."""
    by_frame: dict[str, list[FaceScore]] = {}
    for face in faces:
        by_frame.setdefault(face.frame, []).append(face)
    return [_join(frame, each) for frame, each in sorted(by_frame.items())
            if sum(face.inner_angle for face in each) > 0]


def _join(frame: str, faces: Sequence[FaceScore]) -> tuple[ViewScore, float]:
    sums: Mapping[str, float] = {
        name: sum(getattr(face, name) for face in faces)
        for name in ("angle", "inner_angle", "error", "error_8bit", "ssim", "ssim_padded",
                     "corrected")}
    angle = sums["angle"]
    score = ViewScore(
        frame, to_decibels(sums["error"] / angle), to_decibels(sums["error_8bit"] / angle),
        sums["ssim"] / sums["inner_angle"], sums["ssim_padded"] / angle, None,
        min(1.0, angle / faces[0].whole))
    return score, to_decibels(sums["corrected"] / angle)


# A name, its render [H, W, 3], the photo and which pixels count; None for all.
Picture = tuple[str, NDArray[np.float32], NDArray[np.uint8], NDArray[np.bool_] | None]


class PanoramaPictures:
    """Puts pictures of faces together to those of panoramas, once all faces are there."""

    def __init__(self, views: Sequence[ReferenceView]) -> None:
        self._faces: dict[str, list[str]] = {}
        for view in views:
            if view.face_of is not None:
                self._faces.setdefault(view.face_of, []).append(view.name)
        self._taken: dict[str, dict[str, tuple[ReferenceView, NDArray[np.float32]]]] = {}
        self._lock = threading.Lock()

    def take(self, view: ReferenceView, image: NDArray[np.float32]) -> Iterator[Picture]:
        """Yields the picture of an ordinary view, or that of a whole frame with its last face.

        That of a wide lens is the part of a panorama around all that its faces show.
        """
        frame = view.face_of
        if frame is None:
            yield view.name, image, view.image, view.mask
            return
        with self._lock:
            taken = self._taken.setdefault(frame, {})
            taken[view.name] = view, image
            if len(taken) < len(self._faces[frame]):
                return
            del self._taken[frame]
        faces = [taken[name] for name in sorted(taken)]
        views = [view for view, _ in faces]
        cameras, size = [view.camera for view in views], panorama_size(view.camera)
        axes = panorama_axes([view.name for view in views], cameras)
        render = stitch_faces([image for _, image in faces], cameras, axes, *size)
        photo = stitch_faces(
            [view.image.astype(np.float32) for view in views], cameras, axes, *size)
        mask = stitch_faces([
            np.ones((*view.image.shape[:2], 1), np.float32) if view.mask is None
            else view.mask[..., None].astype(np.float32) for view in views], cameras, axes, *size)
        counts = mask[..., 0] > 0.5
        part = np.s_[:, :] if is_cube_face(view.name) else _around(counts)
        yield frame, render[part], np.rint(photo[part]).astype(np.uint8), counts[part]


def _around(counts: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Returns the rows and columns of the smallest part of a picture that holds all that counts."""
    rows, columns = np.flatnonzero(counts.any(axis=1)), np.flatnonzero(counts.any(axis=0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
