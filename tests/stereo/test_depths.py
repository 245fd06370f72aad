"""Dense stereo: costs and paths against plain float64, depth of walls that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from walls import AROUND, HEIGHT, UP, camera, errors, grain, shading, views_of, wall

from recon_cli.kernels.thread_pool import pool
from recon_cli.room.volume import pixel_rays
from recon_cli.scene.covisibility import observe_points
from recon_cli.scene.train_view import TrainView
from recon_cli.stereo import kernels
from recon_cli.stereo.depths import (
    Levels,
    StereoView,
    camera_row,
    find_depths,
    find_partners,
    unproject,
)

NEAR = 0.05


def partners_of(cameras, most=20):
    """Partners by points all over the wall."""
    y, z = np.meshgrid(np.linspace(-2, 2, 40), np.linspace(-1.5, 1.5, 30))
    points = np.stack([np.full_like(y, 3.0), y, z], axis=-1).reshape(-1, 3)
    seen = observe_points(points, cameras).matrix.toarray() > 0
    return find_partners(cameras, points, seen, most)


def depths_of(views, guess=3.0, gains=None):
    """Depth of the views where surfaces are said to be `guess` away."""
    gains = [1.0] * len(views) if gains is None else gains
    photos = [StereoView(view, guess, guess, gain) for view, gain in zip(views, gains, strict=True)]
    return find_depths(photos, partners_of([view.camera for view in views]), NEAR)


@pytest.mark.integration
@pytest.mark.parametrize("slant", [0.0, 0.4])
def test_a_wall_with_texture_is_found_to_a_quarter_of_a_percent(slant):
    error, share = errors(AROUND, depths_of(views_of(AROUND, grain, slant), 2.6), slant)
    assert share > 0.85
    assert np.median(error) < 0.0025
    assert np.quantile(error, 0.9) < 0.01


@pytest.mark.integration
def test_shading_alone_tells_the_depth_of_a_painted_wall():
    error, share = errors(AROUND, depths_of(views_of(AROUND, shading), 2.4))
    assert share > 0.6
    assert np.median(error) < 0.02


@pytest.mark.integration
def test_a_wall_of_one_colour_says_nothing_that_other_views_confirm():
    """All hypotheses cost the same: nothing is better than the first."""
    views = views_of(AROUND, lambda places: np.full(places.shape[:2], 130.0))
    assert not np.stack(depths_of(views, 2.6)).any()


def test_views_from_one_place_have_no_partners_and_no_depth():
    turned = [camera((0.0, 0.0, 0.0), (3.0, y, 0.0)) for y in (-0.2, 0.0, 0.2)]
    assert (partners_of(turned) == -1).all()
    assert not np.stack(depths_of(views_of(turned, grain))).any()


def test_partners_see_the_same_from_another_place():
    behind = camera((0.0, 0.0, 0.0), (-3.0, 0.0, 0.0))
    partners = partners_of([*AROUND, behind])
    assert (partners[-1] == -1).all()
    for own, row in enumerate(partners[:-1]):
        assert own not in row
        assert len(AROUND) not in row
    # ten degrees away before twenty, and the one right below, of eight, before both
    order = list(partners[0])
    assert order.index(1) < order.index(4) < order.index(8)


def test_a_wider_angle_than_the_best_is_preferred_to_one_as_far_below_it():
    """Depth from rays that are nearly parallel is uncertain."""
    target = np.array([3.0, 0.0, 0.0])
    turned = np.radians([0.0, 1.5, 9.0])
    eyes = target - 3 * np.column_stack([np.cos(turned), np.sin(turned), np.zeros(3)])
    partners = partners_of([camera(tuple(eye), tuple(target)) for eye in eyes])
    assert list(partners[0][:2]) == [2, 1]


@pytest.mark.integration
def test_any_number_of_threads_gives_the_same_bytes(monkeypatch):
    views = views_of(AROUND[:4], grain)
    results = []
    for threads in (1, 3):
        monkeypatch.setattr(pool, "threads", threads)
        results.append(np.stack(depths_of(views, 2.6)).tobytes())
    assert results[0] == results[1]


@pytest.mark.integration
def test_images_of_different_sizes_are_compared():
    cameras = [*AROUND[:5], *(camera(view.center, width=96, height=128) for view in AROUND[5:])]
    found = depths_of(views_of(cameras, grain), 2.6)
    assert [depth.shape for depth in found[4:6]] == [(120, 160), (128, 96)]
    for depth, view in zip(found, cameras, strict=True):
        truth, there = wall(view, 0.0)[0], depth > 0
        assert there.mean() > 0.6
        assert np.median(np.abs(depth[there] / truth[there] - 1)) < 0.003


@pytest.mark.integration
def test_masked_pixels_have_no_depth():
    mask = np.ones((HEIGHT, AROUND[0].width), bool)
    mask[:, :60] = False
    found = np.stack(depths_of([
        TrainView(view.camera, view.image, mask) for view in views_of(AROUND, grain)]))
    assert not found[:, :, :60].any()
    assert (found[:, :, 60:] > 0).mean() > 0.7


@pytest.mark.integration
def test_views_of_other_exposures_are_compared_at_the_mean_one():
    """A painted wall: without their gains no grey levels agree."""
    gains = np.exp(np.linspace(-0.15, 0.15, len(AROUND)))
    views = [TrainView(view.camera, np.clip(np.rint(view.image * gain), 0, 255).astype(np.uint8))
             for view, gain in zip(views_of(AROUND, shading), gains, strict=True)]
    error, share = errors(AROUND, depths_of(views, 2.4, gains))
    _, without = errors(AROUND, depths_of(views, 2.4))
    assert share > 0.6
    assert np.median(error) < 0.02
    assert without < 0.8 * share


def test_places_of_pixels_are_where_their_rays_end():
    view = AROUND[3]
    depth, expected = wall(view, 0.3)
    pixels = np.array([0, 77, depth.size - 1])
    np.testing.assert_allclose(
        unproject(view, depth, pixels), expected.reshape(-1, 3)[pixels], atol=1e-6)


# --- level planes -------------------------------------------------------------------------------

CEILING = 1.2  # above the cameras
BELOW = [camera((0.2 * x, y, 0.0), (0.2 * x + 2.0, 0.5 * y, 1.4))
         for y in (-0.5, -0.25, 0.0, 0.25, 0.5) for x in (-1, 1)]


def ceiling_views(noise=1.0):
    """Views of a white ceiling, lit from one corner, and its depth in each."""
    generator = np.random.default_rng(0)
    views, truths = [], []
    for view in BELOW:
        rays = pixel_rays(view) @ view.viewmat[:3, :3]
        depth = (CEILING - view.center[2]) / rays[..., 2]
        places = view.center + rays * depth[..., None]
        grey = 215 - 5 * np.sqrt((places[..., 0] + 1) ** 2 + (places[..., 1] - 1) ** 2)
        image = np.rint(grey + noise * generator.normal(size=grey.shape)).astype(np.uint8)
        views.append(TrainView(view, np.repeat(image[..., None], 3, axis=2)))
        truths.append(depth)
    return views, np.stack(truths)


def ceiling_depths(views, truths, levels=None, on_photo=lambda: None):
    photos = [StereoView(view, truth.min(), truth.max())
              for view, truth in zip(views, truths, strict=True)]
    x, y = np.meshgrid(np.linspace(0, 5, 40), np.linspace(-2, 2, 30))
    points = np.stack([x, y, np.full_like(x, CEILING)], axis=-1).reshape(-1, 3)
    cameras = [view.camera for view in views]
    seen = observe_points(points, cameras).matrix.toarray() > 0
    partners = find_partners(cameras, points, seen, len(views) - 1)
    return np.stack(find_depths(photos, partners, NEAR, on_photo, levels=levels))


@pytest.mark.integration
def test_level_planes_find_more_of_a_white_ceiling():
    views, truths = ceiling_views()
    right = []
    for levels in (None, Levels(UP, float(np.median(truths)))):
        found = ceiling_depths(views, truths, levels)
        right.append((np.abs(found / truths - 1) < 0.02).mean())
    assert right[1] > 1.5 * right[0]
    assert right[1] > 0.2


def test_each_photo_is_reported_once_a_search():
    views, truths = ceiling_views()
    calls = []
    ceiling_depths(views[:2], truths[:2], Levels(UP, 2.0), lambda: calls.append(1))
    assert len(calls) == 3 * 2


# --- against plain float64 ---------------------------------------------------------------------


def pair():
    cameras = [camera((0, 0, 0), width=24, height=20), camera((0, 0.3, 0.1), width=26, height=22)]
    images = [grain(wall(view, 0.2)[1]).astype(np.float32) for view in cameras]
    return cameras, images


def windows(values: np.ndarray, radius: int) -> np.ndarray:
    """Means of square windows; a row and a column continue beyond the border."""
    padded = np.pad(values, radius, mode="edge")
    height, width = values.shape
    return np.mean([padded[y:y + height, x:x + width]
                    for y in range(2 * radius + 1) for x in range(2 * radius + 1)], axis=0)


def warped(cameras, other: np.ndarray, inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    own, far = cameras
    places = own.center + pixel_rays(own) @ own.viewmat[:3, :3] / inverse[..., None]
    x, y, z = np.moveaxis(places @ far.viewmat[:3, :3].T + far.viewmat[:3, 3], -1, 0)
    u, v = far.fx * x / z + far.cx - 0.5, far.fy * y / z + far.cy - 0.5
    inside = (u >= 0) & (v >= 0) & (u <= far.width - 1) & (v <= far.height - 1)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    i, j = np.minimum(u.astype(int), far.width - 2), np.minimum(v.astype(int), far.height - 2)
    top = other[j, i] * (1 - u + i) + other[j, i + 1] * (u - i)
    low = other[j + 1, i] * (1 - u + i) + other[j + 1, i + 1] * (u - i)
    return top * (1 - v + j) + low * (v - j), inside


@pytest.mark.parametrize("normal", [np.zeros(3), np.array([0.6, 0.0, 0.8])])
@pytest.mark.parametrize("radius", [1, 2])
def test_costs_are_those_of_their_definition(radius, normal):
    cameras, images = pair()
    rays = pixel_rays(cameras[0]) @ cameras[0].viewmat[:3, :3]
    slants = np.abs(rays @ normal) if normal.any() else np.ones(images[0].shape)
    planes = np.linspace(0.1, 0.4, 5)
    costs = np.empty((*images[0].shape, 5), np.float32)
    flat = np.concatenate([image.reshape(-1) for image in images])
    kernels._fill_costs(
        costs, flat, np.array([0, images[0].size]), np.stack([camera_row(c) for c in cameras]), 0,
        np.array([1]), radius, images[0], np.full(images[0].shape, 0.1, np.float32),
        kernels._slants(camera_row(cameras[0]), normal, *images[0].shape), 0.1, 0.075)
    own, other = (image.astype(np.float64) for image in images)
    for d, plane in enumerate(planes):
        there, inside = warped(cameras, other, 0.1 + slants * plane)
        a, b = windows(own, radius), windows(there, radius)
        spread = ((windows(own * own, radius) - a * a + 2)
                  * (windows(there * there, radius) - b * b + 2))
        score = (windows(own * there, radius) - a * b) / np.sqrt(spread) - windows(
            np.minimum(np.abs(own - there), 4), radius) / 4
        expected = 1 - np.where(inside, np.maximum(score, -0.4), 0)
        assert inside.any()
        np.testing.assert_allclose(costs[..., d], expected, atol=2e-3)


def test_paths_are_the_least_of_all_paths():
    """Along a row: the least sum of costs and penalties, by trying every path from the left."""
    generator = np.random.default_rng(2)
    costs = generator.uniform(0, 1, (1, 5, 4)).astype(np.float32)
    penalty = generator.uniform(0.2, 1, (1, 5)).astype(np.float32)
    total = np.zeros_like(costs)
    kernels._add_along_rows(total, costs, penalty)

    def step(x: int, before: int, now: int) -> float:
        if before == now:
            return 0.0
        large = 0.8 * min(penalty[0, x], penalty[0, x - 1])
        return min(0.1, large) if abs(before - now) == 1 else large

    def least(x: int, d: int, shift: int) -> float:
        """The least sum up to pixel x, less the least at the pixel before (as in the method)."""
        if x == 0:
            return float(costs[0, 0, d])
        ends = [least_raw(x - 1, k) for k in range(4)]
        return float(costs[0, x, d]) + min(
            end + step(x, k, d) for k, end in enumerate(ends)) - shift * min(ends)

    def least_raw(x: int, d: int) -> float:
        return least(x, d, 0)

    mirrored = np.zeros_like(costs)
    kernels._add_along_rows(mirrored, costs[:, ::-1].copy(), penalty[:, ::-1].copy())
    np.testing.assert_allclose(mirrored[:, ::-1], total, atol=1e-5)
    from_left = np.array([[least(x, d, 1) for d in range(4)] for x in range(5)])
    # from both sides: what comes from the right is that of the mirrored row
    costs, penalty = costs[:, ::-1].copy(), penalty[:, ::-1].copy()
    from_right = np.array([[least(x, d, 1) for d in range(4)] for x in range(5)])[::-1]
    np.testing.assert_allclose(total[0], from_left + from_right, atol=1e-5)


def test_depth_in_columns_is_that_in_rows_of_the_turned_volume():
    """Straight paths from above are those from the left of the transposed volume."""
    generator = np.random.default_rng(3)
    costs = generator.uniform(0, 1, (6, 1, 5)).astype(np.float32)
    penalty = generator.uniform(0.2, 1, (6, 1)).astype(np.float32)
    down, along = np.zeros_like(costs), np.zeros((1, 6, 5), np.float32)
    kernels._add_along_columns(down, costs, penalty)
    kernels._add_along_rows(
        along, costs.transpose(1, 0, 2).copy(), penalty.T.copy())
    # in one column diagonal paths begin anew at every pixel: four times the cost itself
    np.testing.assert_allclose(down[:, 0] - 4 * costs[:, 0], along[0], atol=1e-5)


# --- planes through blank regions ---------------------------------------------------------------

STEP = 0.02


def plane_depth(inverse, image=None, confirmed=None, blank=None):
    shape = inverse.shape
    image = np.full(shape, 90.0) if image is None else image
    out = np.zeros(shape, np.float32)
    pool.run(
        kernels.lay_planes, inverse.astype(np.float32), image.astype(np.float32),
        np.ones(shape, bool) if confirmed is None else confirmed,
        np.ones(shape, np.float32) if blank is None else blank.astype(np.float32), STEP, out,
        scratch=False)
    return out


def slope(height=40, width=60):
    y, x = np.mgrid[:height, :width]
    return 0.5 + 0.006 * x - 0.004 * y


def by_plain_float64(inverse, image, confirmed, y, x):
    """The plane about one pixel, by weighted least squares with a ridge on its slopes."""
    rows, columns = np.mgrid[-kernels._REACH:kernels._REACH + 1:kernels._STRIDE,
                             -kernels._REACH:kernels._REACH + 1:kernels._STRIDE].reshape(2, -1)
    inside = ((rows + y >= 0) & (rows + y < len(inverse)) & (columns + x >= 0)
              & (columns + x < inverse.shape[1]))
    rows, columns = rows[inside], columns[inside]
    values, greys = inverse[rows + y, columns + x], image[rows + y, columns + x] - image[y, x]
    plane = np.array([inverse[y, x], 0.0, 0.0])
    for turn in range(len(kernels._SPREADS)):
        spread = STEP * kernels._SPREADS[turn]
        off = values - plane @ [np.ones(len(rows)), columns, rows]
        off = (off / spread) ** 2 + (greys / kernels._GREY) ** 2
        weights = np.maximum(1 - off / kernels._CUT, 0) ** 4 * (values > 0)
        weights *= np.where(confirmed[rows + y, columns + x], 1, kernels._UNSURE)
        A = np.stack([columns, rows], axis=1) - np.average(
            np.stack([columns, rows], axis=1), axis=0, weights=weights)
        b = values - np.average(values, weights=weights)
        total = weights.sum()
        slopes = np.linalg.solve(A.T @ (A * weights[:, None]) / total + kernels._SLOPE * np.eye(2),
                                 A.T @ (b * weights) / total)
        plane = np.array([np.average(values - columns * slopes[0] - rows * slopes[1],
                                     weights=weights), *slopes])
    return plane[0]


def test_planes_agree_with_plain_float64():
    generator = np.random.default_rng(0)
    inverse = slope(24, 30) + generator.normal(0, 0.5 * STEP, (24, 30))
    inverse[generator.random(inverse.shape) < 0.1] = 0
    inverse = inverse.astype(np.float32).astype(float)
    image, confirmed = generator.normal(90, 3, inverse.shape), generator.random(inverse.shape) < 0.7
    image = image.astype(np.float32).astype(float)
    result = plane_depth(inverse, image, confirmed)
    for y, x in [(0, 0), (3, 20), (12, 15), (23, 29), (14, 2)]:
        expected = by_plain_float64(inverse, image, confirmed, y, x) if inverse[y, x] > 0 else 0
        assert result[y, x] == pytest.approx(expected, rel=1e-6)


def test_the_steps_of_a_slanted_wall_become_a_plane():
    steps = np.round(slope() / STEP) * STEP
    error = np.abs(plane_depth(steps) - slope())
    assert error.max() < 0.4 * STEP
    assert error.mean() < 0.1 * np.abs(steps - slope()).mean()


def test_what_stands_before_a_wall_and_is_brighter_stays_before_it():
    inverse, image = np.full((40, 60), 0.5), np.full((40, 60), 90.0)
    inverse[:, 30:] += STEP
    image[:, 30:] += 30
    np.testing.assert_allclose(plane_depth(inverse, image), inverse, atol=1e-6)


def test_far_from_the_plane_so_far_nothing_counts():
    inverse = np.full((40, 60), 0.5)
    inverse[:, 30:] += 4 * STEP
    np.testing.assert_allclose(plane_depth(inverse), inverse, atol=1e-6)


def test_depths_that_another_view_agrees_with_outweigh_others():
    inverse, confirmed = np.full((40, 60), 0.5), np.ones((40, 60), bool)
    inverse[13:27, 23:37] += 0.7 * STEP
    confirmed[13:27, 23:37] = False
    assert np.abs(plane_depth(inverse, confirmed=confirmed)[20, 30] - 0.5) < 0.02 * STEP
    assert np.abs(plane_depth(inverse)[20, 30] - 0.5) > 0.04 * STEP


def test_texture_and_missing_depths_stay_as_they_are():
    steps = np.round(slope() / STEP) * STEP
    steps[:5] = 0
    blank = np.ones(steps.shape)
    blank[:, :30] = 0
    result = plane_depth(steps, blank=blank)
    np.testing.assert_array_equal(result[:, :30], steps[:, :30].astype(np.float32))
    assert not result[:5].any()
    assert (result[5:, 30:] != steps[5:, 30:].astype(np.float32)).any()
