"""What the page of a scene shows by itself: a tour, the view that it opens with, and its picture.

Where the views of the capture saw nothing, a scene is smeared. So the tour follows the path of the
capture, and each of its places knows how much around its picture other views have seen: windows
of other proportions, such as a phone held upright, show no more than that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, minimum_filter1d

from recon_cli.context import StageContext
from recon_cli.evaluation.reference_views import render_view
from recon_cli.io.images import encode_image, to_uint8
from recon_cli.io.views import evenly_spread
from recon_cli.render.surface_depth import render_surface
from recon_cli.scene.camera import Camera
from recon_cli.scene.camera_paths import tour_path, tour_seconds
from recon_cli.scene.faces import pixel_rays
from recon_cli.scene.splats import Splats
from recon_cli.scene.statistics import LEAST_WITNESSES
from recon_cli.splats.format import Guide, Tour

_EVERY = 0.5  # seconds from one place of a tour to the next
_DRAFT = 120  # places along which its length is measured
_WITNESSES = 64  # cameras, at most, that are asked what they saw
_SIDE = 64  # pixels of the longest side of a picture that is compared
_MOST_MARGIN = 2.0  # times the picture's sides
_SHARE = 0.75  # of the points in a border that must have been seen
_BLUR = 1.5  # pixels, over which that share is taken
_SAME = 0.1  # relative difference of depths of one surface
_CENTER = 0.35  # of the sides: the strip along which a border is looked at
_STEADY = 4.0  # places: margins change slowly
_CELL = 0.1  # of the median depth: side of the cells that a view's surface is counted in
POSTER = (1200, 630)  # pixels, as previews of links are shown
_POSTER_QUALITY = 88


def make_guide(splats: Splats, cameras: Sequence[Camera], ctx: StageContext) -> Guide | None:
    """Returns tour and picture of a page; None of fewer than two cameras.

    `cameras` are those of the capture in order, in the world of the splats.
    """
    on_device = splats.map(lambda tensor: tensor.to(ctx.device))
    tour = plan_tour(on_device, cameras, ctx)
    return None if tour is None else Guide(tour, draw_poster(on_device, tour, ctx))


def plan_tour(splats: Splats, cameras: Sequence[Camera], ctx: StageContext) -> Tour | None:
    """Returns a tour along the cameras of a capture, in order; None of fewer than two.

    `splats` are on the device of `ctx`; cameras are in the world of the splats.
    """
    if len(cameras) < 2:
        return None
    lens = cameras[len(cameras) // 2]
    viewmats = np.stack([camera.viewmat for camera in cameras])
    witnesses = evenly_spread(cameras, _WITNESSES)
    depths = [_surface(splats, _small(camera), ctx) for camera in witnesses]
    known = np.concatenate([depth[depth > 0] for depth in depths])
    if not known.size:
        return None
    distance = float(np.median(known))
    seconds = tour_seconds(tour_path(viewmats, _DRAFT), distance)
    path = tour_path(viewmats, round(seconds / _EVERY) + 1)
    places = [replace(lens, viewmat=viewmat) for viewmat in path]
    margins, shown = [], []
    for place in places:
        wide = _widened(_small(place), _MOST_MARGIN)
        depth = _surface(splats, wide, ctx)
        points = _points(wide, depth)
        count = _count_views(points, [_small(camera) for camera in witnesses], depths)
        seen = count >= LEAST_WITNESSES
        margins.append(_find_margins(seen))
        shown.append(_count_cells(points[_inner(seen) & seen & (depth > 0)], _CELL * distance))
    steady = gaussian_filter1d(
        minimum_filter1d(np.array(margins), 3, axis=0), _STEADY, axis=0, mode="nearest")
    # what comes after the start is worth seeing too: a tour does not begin in the last quarter
    start = int(np.argmax(shown[:max(1, 3 * len(shown) // 4)]))
    return Tour(places, np.clip(steady, 1.0, _MOST_MARGIN), seconds, start)


def draw_poster(splats: Splats, tour: Tour, ctx: StageContext) -> bytes:
    """Returns the view that the page opens with as a .jpg, in the shape of a preview."""
    camera, margins = tour.cameras[tour.start], tour.margins[tour.start]
    width, height = POSTER
    across, down = camera.width / width, camera.height / height
    fit = min(np.sqrt(across * down), margins[:2].mean() * across, margins[2:].mean() * down)
    middle_x, middle_y = camera.cx - camera.width / 2, camera.cy - camera.height / 2
    view = Camera(width, height, camera.fx / fit, camera.fy / fit, width / 2 + middle_x / fit,
                  height / 2 + middle_y / fit, camera.viewmat)
    rgb = to_uint8(render_view(splats, view, splats.sh_degree, ctx.backend).rgb.cpu().numpy())
    return encode_image(rgb, "jpg", cv2.IMWRITE_JPEG_QUALITY, _POSTER_QUALITY)


def _small(camera: Camera) -> Camera:
    scale = _SIDE / max(camera.width, camera.height)
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))


def _widened(camera: Camera, factor: float) -> Camera:
    """Returns the camera with a larger picture around the same middle, in pixels of equal size."""
    width, height = round(factor * camera.width), round(factor * camera.height)
    return Camera(width, height, camera.fx, camera.fy, camera.cx + (width - camera.width) / 2,
                  camera.cy + (height - camera.height) / 2, camera.viewmat)


def _surface(splats: Splats, camera: Camera, ctx: StageContext) -> NDArray[np.float64]:
    """Returns the depth [H, W] of the surface in world units; 0 where there is none."""
    depth = render_surface(splats, camera, backend=ctx.backend).depth
    return np.asarray(depth.double().cpu().numpy())


def _points(camera: Camera, depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the points [H, W, 3] of a depth map in the world."""
    local = pixel_rays(camera) * depth[..., None]
    return np.asarray((local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3])


def _count_views(
    points: NDArray[np.float64], cameras: Sequence[Camera], depths: Sequence[NDArray[np.float64]]
) -> NDArray[np.int64]:
    """Returns in how many of the views, with their depth maps, each point [H, W, 3] is seen."""
    count = np.zeros(points.shape[:2], np.int64)
    for camera, depth in zip(cameras, depths, strict=True):
        rows, column, line, z = camera.find_visible(points.reshape(-1, 3))
        count.reshape(-1)[rows] += np.abs(depth[line, column] - z) <= _SAME * z
    return count


def _find_margins(seen: NDArray[np.bool_]) -> list[float]:
    """Returns how far left, right, up and down views have seen, from the middle of a picture.

    `seen` [H, W] is of the widened picture; the border of the picture itself is at 1.
    """
    return [_reach(lines) for lines in (
        _strip(seen.T)[::-1], _strip(seen.T), _strip(seen)[::-1], _strip(seen))]


def _strip(seen: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Returns the share of seen pixels of each row in the middle columns of the picture."""
    middle, half = seen.shape[1] / 2, _CENTER * seen.shape[1] / _MOST_MARGIN
    return np.asarray(seen[:, round(middle - half):round(middle + half)].mean(axis=1))


def _reach(lines: NDArray[np.float64]) -> float:
    """Returns how far from the middle towards the end lines are seen; between 1 and the most."""
    border = len(lines) / 2 / _MOST_MARGIN  # lines from the middle to that of the picture
    outer = lines[round(len(lines) / 2 + border):]
    unseen = np.flatnonzero(gaussian_filter1d(outer, _BLUR, mode="nearest") < _SHARE)
    return 1.0 + float(unseen[0] if len(unseen) else len(outer)) / border


def _inner(seen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Returns which pixels of a widened picture lie in the picture itself."""
    inner = np.zeros_like(seen)
    height, width = (size / _MOST_MARGIN for size in seen.shape)
    top, left = (seen.shape[0] - height) / 2, (seen.shape[1] - width) / 2
    inner[round(top):round(top + height), round(left):round(left + width)] = True
    return inner


def _count_cells(points: NDArray[np.float64], cell: float) -> int:
    """Returns how much surface points [P, 3] show, in cells."""
    return len(np.unique(np.floor(points / cell).astype(np.int64), axis=0))
