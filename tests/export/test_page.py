"""What a page shows by itself: its title, its tour, and how much around a view was seen."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from PIL import Image

from recon_cli.context import StageContext
from recon_cli.export.page import POSTER, _find_margins, draw_poster, plan_tour
from recon_cli.progress import NullProgress
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.camera_paths import order_cameras, tour_seconds
from recon_cli.scene.splats import Splats

CONTEXT = StageContext(NullProgress(), "cpu", "numba", 1)
UP = np.array([0.0, 0, 1])


def box(side: float = 4.0, step: float = 0.2) -> Splats:
    """The inside of a box of opaque grey Gaussians, its middle at the origin."""
    across = np.arange(-side / 2, side / 2 + step / 2, step)
    a, b = (grid.ravel() for grid in np.meshgrid(across, across))
    walls = [np.insert(np.stack([a, b], 1), axis, sign * side / 2, axis=1)
             for axis in range(3) for sign in (-1, 1)]
    means = torch.from_numpy(np.concatenate(walls)).float()
    count = len(means)
    log_scales = torch.full((count, 3), float(np.log(step)))
    for axis in range(3):  # flat on their walls
        log_scales[2 * axis * len(a):2 * (axis + 1) * len(a), axis] = float(np.log(step / 100))
    return Splats(
        means=means, quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=log_scales,
        logit_opacities=torch.full((count,), 4.0), sh_dc=torch.zeros(count, 3),
        sh_rest=torch.zeros(count, 0, 3))


def ring(count: int = 40, tilt: float = 0.0) -> list[Camera]:
    """Cameras near the middle that look outwards, level or down."""
    cameras = []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False):
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        viewmat = looking_at(0.2 * out, 2 * out - [0, 0, tilt], UP)
        cameras.append(Camera(160, 90, 110.0, 110.0, 80.0, 45.0, viewmat))
    return cameras


@pytest.mark.integration
def test_a_tour_knows_that_views_beside_have_seen_more_and_none_above():
    tour = plan_tour(box(), ring(), CONTEXT)
    assert tour is not None
    assert 20 <= tour.seconds <= 180
    left, right, up, down = np.median(tour.margins, axis=0)
    assert min(left, right) > 1.4  # the neighbours of a level ring look there
    assert max(up, down) < 1.15
    assert tour.margins.shape == (len(tour.cameras), 4)
    assert tour.margins.min() >= 1


@pytest.mark.integration
def test_the_picture_of_a_page_has_the_shape_of_a_preview():
    tour = plan_tour(box(), ring(), CONTEXT)
    assert tour is not None
    picture = Image.open(io.BytesIO(draw_poster(box(), tour, CONTEXT)))
    assert picture.size == POSTER
    assert np.asarray(picture).min() > 60  # the box is everywhere


def test_one_camera_is_not_a_tour():
    assert plan_tour(box(), ring(1), CONTEXT) is None


def test_margins_end_where_the_seen_ends():
    seen = np.zeros((80, 120), bool)  # the picture is rows 20 to 60 and columns 30 to 90
    seen[20:75, 30:90] = True
    left, right, up, down = _find_margins(seen)
    assert (left, right, up) == (1, 1, 1)
    assert down == pytest.approx(1 + 15 / 20, abs=0.1)


def test_photos_in_no_order_are_put_into_one_and_a_walk_stays_as_it_is():
    viewmats = np.stack([camera.viewmat for camera in ring(30)])
    assert np.array_equal(order_cameras(viewmats), np.arange(30))
    mixed = np.random.default_rng(0).permutation(30)
    steps = np.diff(mixed[order_cameras(viewmats[mixed])])
    assert np.mean(np.isin(np.abs(steps) % 30, (1, 29))) > 0.9


def test_a_tour_is_at_an_easy_pace():
    turned = np.stack([camera.viewmat for camera in ring(200)])
    assert tour_seconds(turned, 2.0) == pytest.approx(360 * 199 / 200 / 15, rel=0.02)
    assert tour_seconds(turned[:4], 2.0) == 20
