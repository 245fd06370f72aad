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
from recon_cli.sfm import checks, database
from recon_cli.sfm.job import MappingJob, Reporter
from recon_cli.sfm.results import FeaturesResult

# COLMAP's values but for the contrast, a difference of Gaussians times the number of layers: at its
# value of .02 OpenCV finds a tenth fewer, at STRONG as many. In dim frames the strongest USUAL are
# kept, down to CONTRAST.
LAYERS, EDGE_RATIO, SIGMA = 3, 10.0, 1.6
STRONG, CONTRAST, USUAL = 0.0133, 0.0067, 1000
# An image is reduced by powers of two, to this many pixels of the longer side or more, where that
# leaves this share of the features that are wanted at most: these are the coarsest, and found in a
# quarter of the time.
LEAST_SIZE, ENOUGH_FEATURES = 800, 0.5
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
        found = pool.map(lambda image: _find(job, image.name), rest)
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


def _find(job: MappingJob, name: str) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Returns the keypoints of a frame, [K, 6] as in the database, and descriptors, [K, 128]."""
    gray = cv2.cvtColor(read_png(job.frames / name), cv2.COLOR_RGB2GRAY)
    mask = np.full_like(gray, 255)
    if job.masks is not None and (job.masks / name).exists():
        mask = read_png(job.masks / name)[:, :, 0]
    sift = cv2.SIFT.create(
        0, LAYERS, CONTRAST, EDGE_RATIO, SIGMA, cv2.CV_32F, enable_precise_upscale=True)
    height, width = gray.shape
    halvings = max(0, int(np.log2(max(height, width) / LEAST_SIZE)))
    for level in range(halvings, -1, -1):
        size = width >> level, height >> level
        image = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        # a reduced pixel counts where all that it covers do
        counts = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) == 255
        points = _strongest(sift.detect(image, np.uint8(255) * counts))
        if len(points) >= ENOUGH_FEATURES * job.max_features:
            break
    points.sort(key=lambda point: -point.size)
    points, rows = sift.compute(image, points[:job.max_features])
    table = np.array([(*point.pt, point.size / 2, np.radians(point.angle)) for point in points])
    xy, (sizes, angles) = table.reshape(-1, 4)[:, :2], table.reshape(-1, 4)[:, 2:].T
    scale = np.array([width / size[0], height / size[1]])
    cos, sin = sizes * scale[0] * np.cos(angles), sizes * scale[0] * np.sin(angles)
    # The middle of the first pixel is (.5, .5) for COLMAP, (0, 0) for OpenCV.
    keypoints = np.column_stack([(xy + 0.5) * scale, cos, -sin, sin, cos]).astype(np.float32)
    # No keypoints: OpenCV gives None.
    lowe = np.zeros((0, 128), np.float32) if rows is None else rows
    root = np.sqrt(lowe / np.maximum(lowe.sum(axis=1, keepdims=True), 1))
    return keypoints, np.clip(np.rint(DESCRIPTOR_SCALE * root), 0, 255).astype(np.uint8)


def _strongest(points: Sequence[cv2.KeyPoint]) -> list[cv2.KeyPoint]:
    """Returns the keypoints of STRONG contrast, and at least the USUAL strongest."""
    response = np.array([point.response for point in points])
    bound = min(STRONG / LAYERS, np.sort(response)[-min(USUAL, len(points)):][:1].sum())
    return [point for point in points if point.response >= bound]
