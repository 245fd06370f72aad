"""Dense stereo: costs and paths against plain float64, depth of walls that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from recon_cli.export.mesh import stereo, stereo_kernels
from recon_cli.export.mesh.depth_maps import camera_row, weigh
from recon_cli.export.mesh.stereo import find_partners, stereo_depths, with_stereo
from recon_cli.export.mesh.volume import pixel_rays
from recon_cli.progress import NullProgress
from recon_cli.render.numba.thread_pool import pool
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.train_view import TrainView

UP = np.array([0.0, 0.0, 1.0])
EVERYWHERE = np.full(3, -np.inf), np.full(3, np.inf)
WIDTH, HEIGHT = 160, 120


def camera(eye, target=(3.0, 0.0, 0.0), width=WIDTH, height=HEIGHT):
    viewmat = looking_at(np.array(eye, float), np.array(target, float), UP)
    return Camera(width, height, 0.9 * width, 0.9 * width, width / 2, height / 2, viewmat)


def wall(view: Camera, slant: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the wall x = 3 + slant y, and the places where pixels meet it, [H, W, 3]."""
    rays = pixel_rays(view) @ view.viewmat[:3, :3]
    normal = np.array([1.0, -slant, 0.0])
    depth = (3.0 - view.center @ normal) / (rays @ normal)
    return depth.astype(np.float32), view.center + rays * depth[..., None]


def grain(places: np.ndarray) -> np.ndarray:
    """A texture of many waves, 40 to 200 grey levels."""
    generator = np.random.default_rng(5)
    waves = generator.normal(size=(40, 3)) * generator.uniform(2, 25, (40, 1))
    phases = generator.uniform(0, 6.3, 40)
    return np.clip(120 + 12 * np.cos(places @ waves.T + phases).sum(-1), 40, 200)


def shading(places: np.ndarray) -> np.ndarray:
    """A painted wall: a lamp's light and the shadow at an edge, half a grey level a pixel."""
    return 150 - 9 * ((places[..., 1] - 0.2) ** 2 + (places[..., 2] - 0.1) ** 2) + (
        12 / (1 + np.exp(-6 * (places[..., 1] + places[..., 2]))))


def maps_of(cameras, paint, slant=0.0, guess=None):
    """Maps of the wall; what the Gaussians say of its depth is `guess`, or the truth."""
    views, depths = [], []
    for view in cameras:
        depth, places = wall(view, slant)
        grey = np.rint(paint(places)).astype(np.uint8)
        views.append(TrainView(view, np.repeat(grey[..., None], 3, axis=2)))
        depths.append(depth if guess is None else np.full_like(depth, guess))
    return weigh(views, cameras, depths, [np.ones_like(depth) for depth in depths])


AROUND = [camera((0.0, y, z)) for y in (-0.5, -0.25, 0.0, 0.25, 0.5) for z in (-0.2, 0.2)]


def errors(maps, found, slant=0.0):
    """Relative errors where there is depth, and the share of pixels that have one."""
    depth = np.stack(found)
    truth = np.stack([wall(view, slant)[0] for view in maps.cameras])
    there = depth > 0
    return np.abs(depth[there] / truth[there] - 1), there.mean()


@pytest.mark.parametrize("slant", [0.0, 0.4])
def test_a_wall_with_texture_is_found_to_a_quarter_of_a_percent(slant):
    maps = maps_of(AROUND, grain, slant, guess=2.6)
    error, share = errors(maps, stereo_depths(maps, maps.views), slant)
    assert share > 0.85
    assert np.median(error) < 0.0025
    assert np.quantile(error, 0.9) < 0.01


def test_shading_alone_tells_the_depth_of_a_painted_wall():
    maps = maps_of(AROUND, shading, guess=2.4)
    error, share = errors(maps, stereo_depths(maps, maps.views))
    assert share > 0.6
    assert np.median(error) < 0.02


def test_a_wall_of_one_colour_says_nothing_that_other_views_confirm():
    """All hypotheses cost the same: nothing is better than the first."""
    maps = maps_of(AROUND, lambda places: np.full(places.shape[:2], 130.0), guess=2.6)
    assert not np.stack(stereo_depths(maps, maps.views)).any()


def test_views_from_one_place_have_no_partners_and_no_depth():
    turned = [camera((0.0, 0.0, 0.0), (3.0, y, 0.0)) for y in (-0.2, 0.0, 0.2)]
    maps = maps_of(turned, grain)
    assert (find_partners(maps) == -1).all()
    assert not np.stack(stereo_depths(maps, maps.views)).any()


def test_partners_see_the_same_from_another_place():
    behind = camera((0.0, 0.0, 0.0), (-3.0, 0.0, 0.0))
    maps = maps_of([*AROUND, behind], grain)
    partners = find_partners(maps)
    assert (partners[-1] == -1).all()
    for own, row in enumerate(partners[:-1]):
        assert own not in row
        assert len(AROUND) not in row
    # ten degrees away before twenty, and the one right below, of eight, before both
    order = list(partners[0])
    assert order.index(1) < order.index(4) < order.index(8)


def test_what_was_cut_off_stays_off():
    maps = maps_of(AROUND, grain)
    box = np.array([-1.0, -0.3, -9.0]), np.array([4.0, 9.0, 9.0])
    found = with_stereo(maps, box, NullProgress())
    assert len(found.depths) == 2 * len(AROUND)
    for view, depth in zip(found.cameras[len(AROUND):], found.depths[len(AROUND):], strict=True):
        places = view.center + pixel_rays(view) @ view.viewmat[:3, :3] * depth[..., None]
        assert (depth > 0).any()
        assert (places[depth > 0, 1] >= -0.3).all()


def test_masked_pixels_have_no_depth():
    maps = maps_of(AROUND, grain)
    mask = np.ones((HEIGHT, WIDTH), bool)
    mask[:, :60] = False
    views = [TrainView(view.camera, view.image, mask) for view in maps.views]
    masked = weigh(views, maps.cameras, maps.depths, maps.gains)
    found = with_stereo(masked, EVERYWHERE, NullProgress())
    own = np.stack(found.depths[len(AROUND):])
    assert not own[:, :, :60].any()
    assert (own[:, :, 60:] > 0).mean() > 0.7


def test_any_number_of_threads_gives_the_same_bytes(monkeypatch):
    maps = maps_of(AROUND[:4], grain, guess=2.6)
    results = []
    for threads in (1, 3):
        monkeypatch.setattr(pool, "threads", threads)
        results.append(np.stack(stereo_depths(maps, maps.views)).tobytes())
    assert results[0] == results[1]


def test_images_of_different_sizes_are_compared():
    cameras = [*AROUND[:5], *(camera(view.center, width=96, height=128) for view in AROUND[5:])]
    maps = maps_of(cameras, grain, guess=2.6)
    found = stereo_depths(maps, maps.views)
    assert [depth.shape for depth in found[4:6]] == [(120, 160), (128, 96)]
    for depth, view in zip(found, cameras, strict=True):
        truth, there = wall(view, 0.0)[0], depth > 0
        assert there.mean() > 0.6
        assert np.median(np.abs(depth[there] / truth[there] - 1)) < 0.003


# --- against plain float64 ---------------------------------------------------------------------


def pair():
    cameras = [camera((0, 0, 0), width=24, height=20), camera((0, 0.3, 0.1), width=26, height=22)]
    images = [grain(wall(view, 0.2)[1]).astype(np.float32) for view in cameras]
    return cameras, images


def windows(values: np.ndarray, radius: int) -> np.ndarray:
    """Means of square windows; a row and a column go on beyond the border."""
    padded = np.pad(values, radius, mode="edge")
    height, width = values.shape
    return np.mean([padded[y:y + height, x:x + width]
                    for y in range(2 * radius + 1) for x in range(2 * radius + 1)], axis=0)


def warped(cameras, other: np.ndarray, inverse: float) -> tuple[np.ndarray, np.ndarray]:
    own, far = cameras
    places = own.center + pixel_rays(own) @ own.viewmat[:3, :3] / inverse
    x, y, z = np.moveaxis(places @ far.viewmat[:3, :3].T + far.viewmat[:3, 3], -1, 0)
    u, v = far.fx * x / z + far.cx - 0.5, far.fy * y / z + far.cy - 0.5
    inside = (u >= 0) & (v >= 0) & (u <= far.width - 1) & (v <= far.height - 1)
    u, v = np.where(inside, u, 0), np.where(inside, v, 0)
    i, j = np.minimum(u.astype(int), far.width - 2), np.minimum(v.astype(int), far.height - 2)
    top = other[j, i] * (1 - u + i) + other[j, i + 1] * (u - i)
    low = other[j + 1, i] * (1 - u + i) + other[j + 1, i + 1] * (u - i)
    return top * (1 - v + j) + low * (v - j), inside


@pytest.mark.parametrize("radius", [1, 2])
def test_costs_are_those_of_their_definition(radius):
    cameras, images = pair()
    inverses = np.linspace(0.2, 0.5, 5)
    costs = np.empty((*images[0].shape, 5), np.float32)
    flat = np.concatenate([image.reshape(-1) for image in images])
    stereo_kernels._fill_costs(
        costs, flat, np.array([0, images[0].size]), np.stack([camera_row(c) for c in cameras]), 0,
        np.array([1]), radius, images[0], np.full(images[0].shape, 0.2, np.float32), 0.075)
    own, other = (image.astype(np.float64) for image in images)
    for d, inverse in enumerate(inverses):
        there, inside = warped(cameras, other, inverse)
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
    stereo_kernels._add_along_rows(total, costs, penalty)

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
    stereo_kernels._add_along_rows(mirrored, costs[:, ::-1].copy(), penalty[:, ::-1].copy())
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
    stereo_kernels._add_along_columns(down, costs, penalty)
    stereo_kernels._add_along_rows(
        along, costs.transpose(1, 0, 2).copy(), penalty.T.copy())
    # in one column diagonal paths begin anew at every pixel: four times the cost itself
    np.testing.assert_allclose(down[:, 0] - 4 * costs[:, 0], along[0], atol=1e-5)


def test_large_views_are_searched_at_600_pixels_and_compared_at_their_own(monkeypatch):
    monkeypatch.setattr(stereo, "_SIDE", 80)
    maps = maps_of(AROUND, grain)
    maps.depths[0][:] *= 1.1  # of the Gaussians: wrong in one view
    found = with_stereo(maps, EVERYWHERE, NullProgress())
    assert found.depths[0].shape == (HEIGHT, WIDTH)
    assert found.depths[len(AROUND)].shape == (HEIGHT // 2, WIDTH // 2)
    assert found.views[len(AROUND)].image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert (found.gains[0] > 0).mean() < 0.3 < (found.gains[1] > 0).mean()


def test_of_many_views_some_get_a_map(monkeypatch):
    monkeypatch.setattr(stereo, "_MOST_VIEWS", 5)
    maps = maps_of(AROUND, grain)
    found = with_stereo(maps, EVERYWHERE, NullProgress())
    assert len(found.depths) == len(AROUND) + 5
    assert found.cameras[-1].center == pytest.approx(AROUND[-1].center)
    error, share = errors(maps_of(found.cameras[len(AROUND):], grain), found.depths[len(AROUND):])
    assert share > 0.7
    assert np.median(error) < 0.0025


def test_a_range_comes_from_all_views_where_one_shows_nothing():
    maps = maps_of(AROUND[:3], grain)
    maps.depths[1] = np.zeros_like(maps.depths[1])
    low, high = stereo._inverse_range(maps.depths[1], maps)
    assert low < 1 / 3.1 < 1 / 2.9 < high
