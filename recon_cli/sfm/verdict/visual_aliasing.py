"""Visual aliasing: two places that look alike and were laid over each other (doppelgangers).

Two equal doors, seen by images that nothing else connects, can be merged without a single match
that disagrees. The missing matches reveal such a model (Zach, Irschara and Bischof 2008): the two
groups of cameras seem to stand in one place, but have only the door in common. Halves that are off
by a degree or by a fiftieth of the extent show as well.

The images are compared by the cells of a grid, not by points, most of which may lie on the very
thing that looks alike. How many of the cells are found again depends on the capture and on the
angle between the views: 0.98 to 0.67 around a plant, 1.00 to 0.98 in a room. So what two groups of
cameras find is compared with what the pairs within the groups find at the same angles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.faces import panorama_pixels
from recon_cli.sfm.features.sphere import is_panorama
from recon_cli.sfm.limits import MAX_OUTLIERS
from recon_cli.sfm.model_arrays import registered_images
from recon_cli.sfm.verdict import view_graph
from recon_cli.sfm.verdict.evidence import MatchEvidence
from recon_cli.workspace.json_record import JsonRecord

# A point is expected in an image that sees it as nearly as another does: SIFT finds it again, while
# at 20 degrees one in six is lost (Lowe 2004, fig. 9).
MAX_ANGLE_DEG = 10.0
MAX_RATIO = 1.3
# Cells along each side of an image, and points that a cell must expect to count. Of those 55 to 65%
# are found in good models: all six are missed by chance one time in two hundred.
GRID, MIN_CELL_POINTS = 6, 6
# Points sampled per image, evenly; 1000 are 28 a cell.
MAX_POINTS = 1000
# A pair counts where each expects this share of its cells in the other: one may see through walls.
MIN_CELL_SHARE = 0.25
MIN_CELLS = 100  # between two groups of images: a handful of pairs
# Of what pairs within two groups of images find of their cells, the pairs between them must find so
# much. See `tests/bench/bench_verdict.py`.
MIN_OVERLAP = 0.56
# Cells are told apart by the angle between the rays of the two images, in degrees.
BANDS_DEG = MAX_ANGLE_DEG * np.arange(1, 4) / 4
# A smaller share found within the groups is taken for this one: then they are wrong themselves.
MIN_RATE = 0.6
MARGIN = 0.03  # of the image at each side, where neighbourhoods of features are cut off


@dataclass(frozen=True)
class Overlap:
    """Cells in which two images should show the same points, by the angle between their rays.

    Symmetric, [B, N, N] over all images; the last of the B bands ends at MAX_ANGLE_DEG.
    """

    expected: NDArray[np.float64]
    confirmed: NDArray[np.float64]  # those of them with at least one point that both images see


@dataclass(frozen=True)
class VisualAliasing(JsonRecord):
    """The two groups of images that show least of what they should show in common."""

    # Of the cells that should look alike, those that do, over the same for pairs within the groups;
    # None where unknown.
    share: float | None
    reason: str  # why it is unknown; empty otherwise
    sides: tuple[tuple[str, ...], tuple[str, ...]]  # names of the images, the smaller group first
    cells: int  # that should look alike


@dataclass(frozen=True)
class _Samples:
    """A sample of S observations: image i sees point p."""

    image: NDArray[np.int64]  # [S]
    point: NDArray[np.int64]  # [S]
    cell: NDArray[np.int64]  # [S], counted through all images
    rays: NDArray[np.float64]  # [S, 3] from the camera to the point, not normalised


def measure_overlap(model: pycolmap.Reconstruction, evidence: MatchEvidence) -> Overlap:
    """Returns where images of a model should show the same; pairs never matched are zero."""
    count = len(evidence.names)
    row = {name: index for index, name in enumerate(evidence.names)}
    images = {row[image.name]: image for image in registered_images(model)}
    positions = evidence.positions
    samples = _sample(evidence, positions, images)
    everything = np.arange(len(samples.image))
    cells = _cells(samples, everything, count)
    expected, confirmed = np.zeros((2, len(BANDS_DEG) + 1, count, count))
    for other, image in images.items():
        likely, angles = _likely_angles(
            samples, positions, _project(image, positions), evidence.centers[other],
            evidence.tried[other])
        should = _cells(samples, likely, count)
        seen = likely[evidence.visible[other][samples.point[likely]]]
        does = should & _cells(samples, seen, count, 1)
        bands = _bands(samples, likely, angles, count)
        for band in range(len(expected)):
            expected[band, :, other] = (should & (bands == band)).sum(axis=1)
            confirmed[band, :, other] = (does & (bands == band)).sum(axis=1)
    share = expected.sum(axis=0) / np.maximum(cells.sum(axis=1), 1)[:, None]
    mutual = (np.minimum(share, share.T) >= MIN_CELL_SHARE) & evidence.tried
    return Overlap(
        np.where(mutual, expected + expected.transpose(0, 2, 1), 0.0),
        np.where(mutual, confirmed + confirmed.transpose(0, 2, 1), 0.0))


def find_aliasing(evidence: MatchEvidence, overlap: Overlap) -> VisualAliasing:
    """Returns the cut of the cameras across which least is found of what is within the sides."""
    rows = np.flatnonzero(evidence.registered)
    inner = np.ix_(rows, rows)
    expected, confirmed = (np.stack([band[inner] for band in bands])
                           for bands in (overlap.expected, overlap.confirmed))
    total, found = expected.sum(axis=0), confirmed.sum(axis=0)
    cut, share = None, np.inf
    head = np.arange(1, len(rows))
    # enough images on both sides
    even = np.minimum(head, len(rows) - head) > MAX_OUTLIERS * len(rows)
    for order in (
        *view_graph.disagreement_orders(found, total), *view_graph.loose_orders(total),
        *view_graph.loose_orders(evidence.shared[inner].astype(np.float64)),
    ):
        shares = np.where(
            (view_graph.sweep(total, order) >= MIN_CELLS) & even,
            _relative_shares(expected, confirmed, order), np.inf)
        if shares.min() < share:
            cut, share = order[:int(shares.argmin()) + 1], float(shares.min())
    if cut is None:
        reason = f"no two groups of cameras should share {MIN_CELLS} places"
        return VisualAliasing(None, reason, ((), ()), 0)
    side = np.zeros(len(rows), np.bool_)
    side[cut] = True
    first, second = sorted(
        (tuple(evidence.names[row] for row in rows[part]) for part in (side, ~side)), key=len)
    return VisualAliasing(share, "", (first, second), int(view_graph.across(total, side)))


def _relative_shares(
    expected: NDArray[np.float64],  # [B, N, N]
    confirmed: NDArray[np.float64],  # [B, N, N]
    order: view_graph.Order,
) -> NDArray[np.float64]:  # [N - 1]
    """Returns, for each cut of a sweep, what is found across over what is found within its sides.

    At most 1; the angles between the rays are those across.
    """
    usual, found = np.zeros((2, len(order) - 1))
    for should, does in zip(expected, confirmed, strict=True):
        across, seen = view_graph.sweep(should, order), view_graph.sweep(does, order)
        within = should.sum() / 2 - across
        rate = np.where(
            within >= MIN_CELLS, (does.sum() / 2 - seen) / np.maximum(within, 1.0), 1.0)
        usual += across * np.maximum(rate, MIN_RATE)
        found += seen
    return np.minimum(found / np.maximum(usual, 1e-9), 1.0)


def _project(image: pycolmap.Image, positions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns where points [M, 3] lie in an image, [M, 2], 0 to 1 across and down; NaN outside.

    Distortion is ignored, because its polynomial brings far points back into the image: the frame
    spans the undistorted middles of its edges.
    """
    camera = image.camera
    width, height = camera.width, camera.height
    if is_panorama(camera):
        local = np.asarray(image.cam_from_world() * positions).reshape(-1, 3)
        return np.asarray(panorama_pixels(local, width, height) / (width, height))
    left, right, top, bottom = np.asarray(camera.cam_from_img(np.array([
        [0, height / 2], [width, height / 2], [width / 2, 0], [width / 2, height]], np.float64)))
    low, high = np.array([left[0], top[1]]), np.array([right[0], bottom[1]])
    local = np.asarray(image.cam_from_world() * positions)
    front = np.where(local[:, 2] > 0, local[:, 2], np.nan)
    place = (local[:, :2] / front[:, None] - low) / (high - low)
    inside = ((place > MARGIN) & (place < 1 - MARGIN)).all(axis=1)
    return np.where(inside[:, None], place, np.nan)


def _sample(
    evidence: MatchEvidence, positions: NDArray[np.float64], images: Mapping[int, pycolmap.Image]
) -> _Samples:
    parts = [np.zeros((3, 0), np.int64)]
    for index, image in sorted(images.items()):
        seen = np.flatnonzero(evidence.visible[index])
        frame = _project(image, positions[seen])
        rows = np.flatnonzero(~np.isnan(frame[:, 0]))
        some = rows[np.linspace(0, len(rows) - 1, min(MAX_POINTS, len(rows))).astype(int)]
        column, line = (frame[some] * GRID).astype(np.int64).T
        cells = (index * GRID + line) * GRID + column
        parts.append(np.stack([np.full(len(some), index), seen[some], cells]))
    numbers, points, cells = np.concatenate(parts, axis=1)
    return _Samples(numbers, points, cells, positions[points] - evidence.centers[numbers])


def _likely_angles(
    samples: _Samples,
    positions: NDArray[np.float64],  # [M, 3]
    frame: NDArray[np.float64],  # [M, 2]
    center: NDArray[np.float64],  # [3]
    tried: NDArray[np.bool_],  # [N], images that were matched with it; the others do not count
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:  # [L], [L]
    """Returns the samples that another image should find, and at which angles in degrees."""
    rows = np.flatnonzero((~np.isnan(frame[:, 0]))[samples.point] & tried[samples.image])
    theirs = samples.rays[rows]
    ours = positions[samples.point[rows]] - center
    near, far = (np.sqrt(np.einsum("sk,sk->s", rays, rays)) for rays in (theirs, ours))
    cosines = np.einsum("sk,sk->s", ours, theirs) / np.maximum(near * far, 1e-300)
    likely = (
        (cosines > np.cos(np.radians(MAX_ANGLE_DEG)))
        & (near < MAX_RATIO * far)
        & (far < MAX_RATIO * near))
    return rows[likely], np.degrees(np.arccos(np.minimum(cosines[likely], 1.0)))


def _bands(
    samples: _Samples, likely: NDArray[np.int64], angles: NDArray[np.float64], count: int
) -> NDArray[np.int64]:  # [N, GRID * GRID]
    """Returns the band of the mean angle of the likely samples in each cell of `count` images."""
    size = count * GRID * GRID
    sums = np.bincount(samples.cell[likely], weights=angles, minlength=size)
    held = np.bincount(samples.cell[likely], minlength=size)
    return np.digitize(sums / np.maximum(held, 1), BANDS_DEG).reshape(count, -1)


def _cells(
    samples: _Samples, chosen: NDArray[np.int64], count: int, least: int = MIN_CELL_POINTS
) -> NDArray[np.bool_]:  # [N, GRID * GRID]
    """Returns the cells of `count` images that hold at least so many of the chosen samples."""
    held = np.bincount(samples.cell[chosen], minlength=count * GRID * GRID)
    return np.asarray(held.reshape(count, -1) >= least)
