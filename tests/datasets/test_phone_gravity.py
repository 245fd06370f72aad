"""Up by a phone's accelerometer: which way it is held, in which unit, and how it moves."""

import dataclasses

import numpy as np
import pytest
from app_shots import ARKIT, shots
from facts import assert_facts, raises
from phone_writers import stray

from recon_cli.datasets.layouts import read_posed
from recon_cli.datasets.phone_gravity import read_gravity
from recon_cli.errors import FormatError

HEAD = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z"
# The phone on its side, its top to the left: the camera is level and its x axis goes from the top
# of the phone to its bottom. The right edge of the upright screen is up then, so gravity goes
# along -x of the device.
ON_ITS_SIDE = np.array([-1.0, 0, 0])
# Upright: the camera's x axis, from top to bottom, goes down, and gravity along -y of the device.
UPRIGHT = np.array([0.0, -1, 0])
# On a table, screen up: the camera looks down, and gravity goes along -z.
ON_A_TABLE = np.array([0.0, 0, -1])
TIMES = [5 + 0.1 * at for at in range(20)]


def write(path, rows):
    path.write_text("\n".join([HEAD, *(", ".join(map(str, row)) for row in rows)]) + "\n")
    return path


def accelerations(direction, unit=1.0, noise=0.0):
    rng = np.random.default_rng(0)
    return [[4 + 0.01 * at, *(unit * (direction + noise * rng.normal(size=3))), 0, 0, 0]
            for at in range(400)]


def looking(right, down):
    view = np.eye(4)
    view[:3, :3] = [right, down, np.cross(right, down)]
    return np.tile(view, (len(TIMES), 1, 1))


@pytest.mark.parametrize("unit", [1.0, 9.81])
@pytest.mark.parametrize(("direction", "right", "down"), [
    (ON_ITS_SIDE, [1, 0, 0], [0, -1, 0]), (UPRIGHT, [0, -1, 0], [-1, 0, 0]),
    (ON_A_TABLE, [1, 0, 0], [0, 0, 1])])
def test_up_is_y_however_the_phone_is_held(tmp_path, direction, right, down, unit):
    path = write(tmp_path / "imu.csv", accelerations(direction, unit, noise=0.1))
    gravity = read_gravity(path, TIMES, looking(right, down))
    np.testing.assert_allclose(gravity.up, [0, 1, 0], atol=0.03)
    assert not gravity.is_sure  # the camera never turned


def test_other_units_other_times_and_other_columns_say_nothing(tmp_path):
    views = looking([1, 0, 0], [0, -1, 0])
    path = write(tmp_path / "imu.csv", accelerations(ON_ITS_SIDE, unit=4.0))
    assert read_gravity(path, TIMES, views) is None
    path = write(tmp_path / "imu.csv", accelerations(ON_ITS_SIDE))
    assert read_gravity(path, [time + 100 for time in TIMES], views) is None
    assert read_gravity(write(path, []), TIMES, views) is None
    path.write_text(path.read_text().replace("a_x", "b"))
    with raises(FormatError, "a_x"):
        read_gravity(path, TIMES, views)


def device(c2w, up):
    """What the accelerometer says: gravity in the axes of the device."""
    x, y, z = c2w[:3, :3].T @ -np.array(up)
    return [-y, -x, -z]


@pytest.fixture
def taken(shared_data):
    return shots(shared_data / "rooms" / "office", count=12, step=5, factor=4)


STRAIGHT = np.eye(4)


def record(folder, taken, tilt=STRAIGHT):
    """A recording whose world was turned, while the accelerometer felt the room's up."""
    stray(folder, [dataclasses.replace(
        shot, c2w=np.linalg.inv(ARKIT) @ tilt @ ARKIT @ shot.c2w) for shot in taken], between=1)
    rng = np.random.default_rng(0)
    write(folder / "imu.csv", [
        [shot.time + 0.01 * at, *(np.array(device(shot.c2w, [0, 0, 1]))
                                  + 0.05 * rng.normal(size=3)), 0, 0, 0]
        for shot in taken for at in range(-10, 11)])


def test_a_world_whose_y_is_up_stays_as_it_is(taken, tmp_path):
    record(tmp_path, taken)
    posed = read_posed(tmp_path)
    assert posed.up == (0, 1, 0)
    assert not any("imu" in notice for notice in posed.notices)


def test_a_tilted_world_gets_its_up_from_the_accelerometer(taken, tmp_path):
    tilt = np.eye(4)
    tilt[:2, :2] = [[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]
    record(tmp_path, taken, tilt)
    posed = read_posed(tmp_path)
    np.testing.assert_allclose(posed.up, tilt[:3, 1], atol=0.02)
    assert_facts("\n".join(posed.notices), 29, "degrees", "axis")


def test_accelerations_of_another_recording_change_nothing(taken, tmp_path):
    record(tmp_path, taken)
    rng = np.random.default_rng(1)
    write(tmp_path / "imu.csv", [
        [shot.time, *(one / np.linalg.norm(one)), 0, 0, 0]
        for shot, one in zip(taken, rng.normal(size=(len(taken), 3)), strict=True)])
    assert read_posed(tmp_path).up == (0, 1, 0)
