"""Heights above the floor along a walk, and what they say of its scale."""

import numpy as np
import pycolmap
import pytest
from made_model import MadeModel, along, wall
from scipy.spatial.transform import Rotation

from recon_cli.scene.camera import PANORAMA
from recon_cli.sfm.verdict.floor_heights import (
    MAX_LOG_STEP,
    SPREAD,
    compare_heights,
    compare_sides,
    measure_heights,
    weigh_step,
)

HEIGHT = 1.6  # of the cameras, whose y axis points down


def hall(*, floor: bool) -> MadeModel:
    """Thirty cameras along a wall, over a floor where there is one."""
    draws = np.random.default_rng(0)
    ground = np.column_stack([
        draws.uniform(-6, 20, 3000), np.full(3000, HEIGHT), draws.uniform(3, 9, 3000)])
    points = wall(-6, 20, count=1500) * [1, 0.5, 1]
    return MadeModel(np.concatenate([points, ground[:3000 * floor]]), along(np.arange(30) * 0.4))


@pytest.mark.integration
def test_the_height_is_that_over_the_floor_and_unknown_without_one():
    made = hall(floor=True)
    heights = measure_heights(made.model(), made.names)
    assert heights[:, 0] == pytest.approx(np.full(30, HEIGHT), abs=0.15)  # the cameras wobble by .1
    assert np.isnan(heights[:, 1]).all()
    bare = hall(floor=False)
    assert np.isnan(measure_heights(bare.model(), bare.names)).all()


def one_row(heights):
    return np.column_stack([heights, np.full(len(heights), np.nan)])


def test_two_sides_are_compared_by_their_middle_heights():
    heights = one_row(np.repeat([1.5, 2.0], 30))
    assert compare_heights(heights, 30) == pytest.approx(np.log(2.0 / 1.5))
    far = np.repeat([1.5, 1.5 * np.exp(MAX_LOG_STEP + 0.01)], 30)
    assert compare_heights(one_row(far), 30) is None
    few = np.where(np.arange(60) < 5, 1.5, np.nan)
    assert compare_heights(one_row(few), 30) is None


def test_floor_and_ceiling_count_alike():
    rows = np.array([[1.5, 1.0], [1.5, np.nan], [1.8, 1.1], [1.8, 1.1]])
    assert compare_sides(rows[:2], rows[2:]) == pytest.approx(np.log(1.2 * 1.1) / 2)
    # one ceiling alone is known before
    assert compare_sides(rows[:2], rows[2:], 2) == pytest.approx(np.log(1.2))


def test_the_floor_decides_where_the_cameras_know_little_and_nothing_where_they_know_much():
    assert weigh_step(1e6, 0.3)[0] == pytest.approx(0.3)
    assert weigh_step(0.001, 0.3)[0] == pytest.approx(0.001, rel=0.01)
    assert weigh_step(0.2, 0.0) == (pytest.approx((1 / 0.2**2 + 1 / SPREAD**2) ** -0.5), 0.0)
    errors = np.array([weigh_step(error, 0.1)[0] for error in np.linspace(0.01, 1, 50)])
    assert (np.diff(errors) > 0).all()


def flat(tilt_deg=0.3, *, shrink=1.0):
    """A model of two empty rooms, three level panoramas in each; the second room may be smaller.

    It holds floor, ceiling and the far walls of each room, and shrinks about the door between.
    """
    draws, model = np.random.default_rng(0), pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(
        camera_id=1, model=PANORAMA, width=2048, height=1024, params=[2048, 1024]))
    number = 0
    for room, scale in ((-1, 1.0), (1, shrink)):
        x, y, z = draws.uniform([0, -1, -2], [5, 1.6, 2], (1200, 3)).T
        y = np.where(np.arange(1200) % 3 == 0, 1.6, np.where(np.arange(1200) % 3 == 1, -1.0, y))
        x = np.where(np.arange(1200) % 3 == 2, 5.0, x)
        points = scale * np.column_stack([room * x, y, z])
        for stand in range(3):
            number += 1
            center = scale * np.array([room * (1.0 + stand), 0.0, 0.3 * stand])
            turn = Rotation.from_euler(
                "zxy", [*draws.normal(0, tilt_deg, 2), 80 * number], degrees=True)
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn.as_quat()), -turn.apply(center))
            pixels = np.asarray(model.camera(1).img_from_cam(np.asarray(pose * points)))
            model.add_image_with_trivial_frame(pycolmap.Image(
                image_id=number, name=f"{number}.png", camera_id=1,
                points2D=[pycolmap.Point2D(xy) for xy in pixels]), pose)
        for place, point in enumerate(points):
            model.add_point3D(point, pycolmap.Track([
                pycolmap.TrackElement(number - back, place) for back in range(3)]))
    return model, [f"{index}.png" for index in range(1, 7)]


@pytest.mark.integration
@pytest.mark.parametrize("shrink", [1.0, 0.9])
def test_level_panoramas_know_their_heights_under_the_ceiling_too(shrink):
    heights = measure_heights(*flat(shrink=shrink))
    assert heights[:3] == pytest.approx(np.tile([1.6, 1.0], (3, 1)), abs=0.05)
    assert heights[3:] == pytest.approx(shrink * np.tile([1.6, 1.0], (3, 1)), abs=0.05)
    assert compare_sides(heights[:3], heights[3:]) == pytest.approx(np.log(shrink), abs=0.03)


def test_panoramas_that_lean_every_way_have_no_level():
    assert np.isnan(measure_heights(*flat(tilt_deg=60.0))).all()
