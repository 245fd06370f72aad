"""SIFT features (Lowe 2004) of all frames, found by OpenCV, in COLMAP's database.

pycolmap's own extraction on the CPU takes three to five times as long and gives the same cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.io.images import read_png
from recon_cli.scene.faces import panorama_pixels
from recon_cli.sfm import database
from recon_cli.sfm.features.face_images import cube_warps, cut_face
from recon_cli.sfm.job import MappingJob, Reporter
from recon_cli.sfm.mapping import checks
from recon_cli.sfm.results import FeaturesResult

# OpenCV's other values are COLMAP's. The contrast is a difference of Gaussians times the number of
# layers: at COLMAP's .02 OpenCV finds a tenth fewer, at STRONG as many. In dim frames the strongest
# USUAL are kept, down to CONTRAST.
STRONG, CONTRAST, USUAL = 0.0133, 0.0067, 1000
# An image is reduced by powers of two, to this many pixels of the longer side or more, where that
# leaves this share of the features that are wanted at most: these are the coarsest, and found in a
# quarter of the time.
LEAST_SIZE, ENOUGH_FEATURES = 800, 0.5
# Panoramas from which on each has as many keypoints as a photo; the pairs of fewer take no longer
# to match with more, up to so many times as many.
MANY_PANORAMAS, MOST_FEATURES = 30, 3.0
DESCRIPTOR_SCALE = 512.0  # of COLMAP's descriptors, which are the square roots of Lowe's (RootSIFT)


def extract_features(job: MappingJob, report: Reporter) -> FeaturesResult:
    """Fills the database with the features of all frames and returns how many there are.

    Images that an interrupted run has finished are kept. FormatError if a frame cannot be read,
    SfmError if too few hold any texture.
    """
    report.phase("features", len(job.names), done=database.progress(job.database, "features"))
    with pycolmap.Database.open(job.database) as opened, ThreadPoolExecutor(job.threads) as pool:
        images = opened.read_all_images()
        rest = [image for image in images if not opened.exists_descriptors(image.image_id)]
        panoramas = job.panoramas
        found = pool.map(lambda image: (
            find_on_faces if image.name in panoramas else _find)(job, image.name), rest)
        done = len(images) - len(rest)
        for image, (keypoints, descriptors) in zip(rest, found, strict=True):
            # Descriptors come last, and tell that an image is finished.
            write = (opened.update_keypoints if opened.exists_keypoints(image.image_id)
                     else opened.write_keypoints)
            write(image.image_id, keypoints)
            opened.write_descriptors(image.image_id, pycolmap.FeatureDescriptors(
                pycolmap.FeatureExtractorType.SIFT, descriptors))
            done += 1
            report.done(done)
    counts = database.keypoint_counts(job.database)
    checks.check_texture(counts)
    return FeaturesResult(rows=len(counts), keypoints=sum(counts.values()))


def _read(job: MappingJob, name: str) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Returns a frame in gray and its mask, [H, W] each."""
    gray = np.asarray(cv2.cvtColor(read_png(job.frames / name), cv2.COLOR_RGB2GRAY), np.uint8)
    mask = np.full_like(gray, 255)
    if job.masks is not None and (job.masks / name).exists():
        mask = read_png(job.masks / name)[:, :, 0]
    return gray, mask


def _make_sift() -> cv2.SIFT:
    return cv2.SIFT.create(
        contrastThreshold=CONTRAST, enable_precise_upscale=True)


def find_on_faces(
    job: MappingJob, name: str
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Does as `_find` for a panorama: features are found on faces, and placed in the panorama.

    There straight edges are straight and no seam or pole cuts them: of the matches between real
    panoramas some metres apart a half more are verified than with features of the panorama itself.
    Faces of half the size come first, in a sixth of the time, as the coarsest features are kept.
    """
    gray, mask = _read(job, name)
    wanted = _count_in_panorama(job)
    for level in (1, 0):
        table, lowe = _find_on_faces(gray, mask, level)
        if len(table) >= wanted:
            break
    coarsest = np.argsort(-table[:, 2], kind="stable")[:wanted]
    xy, sizes, angles = table[coarsest, :2], table[coarsest, 2], table[coarsest, 3]
    return _keypoints(xy, sizes * np.cos(angles), sizes * np.sin(angles)), _root_sift(
        lowe[coarsest])


def _find_on_faces(
    gray: NDArray[np.uint8], mask: NDArray[np.uint8], level: int  # [H, W], [H, W], halvings
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Returns place, size and angle in a panorama of its keypoints, [K, 4], and descriptors."""
    height, width = gray.shape
    size = width >> level, height >> level
    gray, mask = (np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
                  for picture in (gray, mask))
    sift = _make_sift()
    tables, descriptors = [np.zeros((0, 4))], [np.zeros((0, 128), np.float32)]
    for face, warp in cube_warps(*size):
        image, counts = cut_face(gray, warp), cut_face(mask, warp) == 255
        points, rows = sift.compute(
            image, _strongest(sift, sift.detect(image, np.uint8(255) * counts * warp.own)))
        if not len(points):
            continue
        pixels = np.array([point.pt for point in points]) + 0.5 - warp.side / 2
        rays = np.column_stack([pixels / warp.focal, np.ones(len(pixels))]) @ face.rotation
        shape = [(point.size / 2 * 2**level, np.radians(point.angle)) for point in points]
        tables.append(np.column_stack([panorama_pixels(rays, width, height), shape]))
        descriptors.append(rows)
    return np.concatenate(tables), np.concatenate(descriptors)


def _count_in_panorama(job: MappingJob) -> int:
    """Returns the most keypoints of a panorama: more where there are few, which stand far apart."""
    count = len(job.panoramas)
    share = MANY_PANORAMAS * (MANY_PANORAMAS - 1) / max(1, count * (count - 1))
    return round(job.max_features * min(max(1.0, share), MOST_FEATURES))


def _find(job: MappingJob, name: str) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Returns the keypoints of a frame, [K, 6] as in the database, and descriptors, [K, 128]."""
    gray, mask = _read(job, name)
    sift = _make_sift()
    height, width = gray.shape
    halvings = max(0, int(np.log2(max(height, width) / LEAST_SIZE)))
    for level in range(halvings, -1, -1):
        size = width >> level, height >> level
        image = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        # a reduced pixel counts where all that it covers do
        counts = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) == 255
        points = _strongest(sift, sift.detect(image, np.uint8(255) * counts))
        if len(points) >= ENOUGH_FEATURES * job.max_features:
            break
    points.sort(key=lambda point: -point.size)
    points, rows = sift.compute(image, points[:job.max_features])
    table = np.array([(*point.pt, point.size / 2, np.radians(point.angle)) for point in points])
    xy, (sizes, angles) = table.reshape(-1, 4)[:, :2], table.reshape(-1, 4)[:, 2:].T
    scale = np.array([width / size[0], height / size[1]])
    cos, sin = sizes * scale[0] * np.cos(angles), sizes * scale[0] * np.sin(angles)
    # The middle of the first pixel is (.5, .5) for COLMAP, (0, 0) for OpenCV.
    # No keypoints: OpenCV gives None.
    return _keypoints((xy + 0.5) * scale, cos, sin), _root_sift(
        np.zeros((0, 128), np.float32) if rows is None else rows)


def _keypoints(
    xy: NDArray[np.float64], cos: NDArray[np.float64], sin: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Returns keypoints [K, 6] as in the database, of places [K, 2], sizes and turns."""
    return np.column_stack([xy, cos, -sin, sin, cos]).astype(np.float32)


def _root_sift(lowe: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Returns COLMAP's descriptors [K, 128] of Lowe's."""
    root = np.sqrt(lowe / np.maximum(lowe.sum(axis=1, keepdims=True), 1))
    return np.asarray(np.clip(np.rint(DESCRIPTOR_SCALE * root), 0, 255), np.uint8)


def _strongest(sift: cv2.SIFT, points: Sequence[cv2.KeyPoint]) -> list[cv2.KeyPoint]:
    """Returns the keypoints of STRONG contrast, and at least the USUAL strongest."""
    response = np.array([point.response for point in points])
    usual = np.sort(response)[-min(USUAL, len(points)):][:1].sum()
    bound = min(STRONG / sift.getNOctaveLayers(), usual)
    return [point for point in points if point.response >= bound]
