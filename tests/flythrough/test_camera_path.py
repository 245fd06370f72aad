"""nerfstudio's camera path: a known matrix, there and back, and what is refused."""

import json

import numpy as np
import pytest
from facts import assert_facts, raises

from recon_cli.errors import FormatError
from recon_cli.flythrough.camera_path import CameraPath, read_camera_path, write_camera_path
from recon_cli.scene.camera_paths import orbit_path

# a camera at (1, 2, 3) that looks along +y with z up, as OpenGL has it: the columns are right (x),
# up (z) and backward (-y)
POSE = [1, 0, 0, 1, 0, 0, -1, 2, 0, 1, 0, 3, 0, 0, 0, 1]


def value(**more):
    return {"camera_type": "perspective", "render_width": 64, "render_height": 48, "fps": 24,
            "seconds": 1, "camera_path": [entry()], **more}


def entry(**more):
    return {"camera_to_world": POSE, "fov": 60, "aspect": 4 / 3, **more}


def without(mapping, key):
    return {name: one for name, one in mapping.items() if name != key}


def read(tmp_path, content):
    path = tmp_path / "path.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return read_camera_path(path)


def test_opengl_axes_become_those_of_opencv(tmp_path):
    found = read(tmp_path, value())
    camera = found.cameras()[0]
    np.testing.assert_allclose(camera.center, [1, 2, 3], atol=1e-15)
    np.testing.assert_allclose(
        camera.viewmat[:3, :3], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)
    ahead = camera.viewmat @ [1, 7, 3, 1]  # five along +y lie five in front
    np.testing.assert_allclose(ahead, [0, 0, 5, 1], atol=1e-14)
    above = camera.viewmat @ [1, 7, 4, 1]  # higher is less in y
    np.testing.assert_allclose(above, [0, -1, 5, 1], atol=1e-14)


def test_fov_is_vertical_and_in_degrees(tmp_path):
    camera = read(tmp_path, value(camera_path=[entry(fov=90)])).cameras()[0]
    assert (camera.width, camera.height, camera.cx, camera.cy) == (64, 48, 32.0, 24.0)
    assert camera.fx == camera.fy == pytest.approx(24.0)


def test_what_is_written_reads_back_as_the_same_cameras(tmp_path):
    rng = np.random.default_rng(0)
    made = CameraPath(
        orbit_path(rng.normal(size=(5, 3)) * 3, rng.normal(size=3), np.array([0.0, 0, 1]), 20),
        rng.uniform(20, 100, 20), 640, 360, 29.97)
    write_camera_path(tmp_path / "path.json", made)
    found = read_camera_path(tmp_path / "path.json")
    assert (found.width, found.height, found.fps) == (640, 360, 29.97)
    for before, after in zip(made.cameras(), found.cameras(), strict=True):
        np.testing.assert_allclose(after.viewmat, before.viewmat, rtol=0, atol=1e-14)
        assert after.fy == pytest.approx(before.fy, rel=1e-14)


def test_the_file_has_the_names_and_rows_that_nerfstudio_reads(tmp_path):
    viewmat = np.eye(4)
    viewmat[:3, 3] = [-1, -2, -3]
    write_camera_path(
        tmp_path / "path.json", CameraPath(viewmat[None], np.array([60.0]), 64, 48, 24.0))
    written = json.loads((tmp_path / "path.json").read_text())
    first = written["camera_path"][0]
    assert first["camera_to_world"] == [1, 0, 0, 1, 0, -1, 0, 2, 0, 0, -1, 3, 0, 0, 0, 1]
    assert (first["fov"], first["aspect"]) == (60.0, 64 / 48)
    assert (written["render_width"], written["render_height"]) == (64, 48)
    assert (written["fps"], written["seconds"]) == (24.0, 1 / 24)


def test_the_pace_may_be_said_by_the_seconds_or_not_at_all(tmp_path):
    four = [entry()] * 4
    assert read(tmp_path, without(value(seconds=2, camera_path=four), "fps")).fps == 2
    assert read(tmp_path, without(without(value(), "fps"), "seconds")).fps is None


def test_a_crop_is_left_out_with_a_word(tmp_path, caplog):
    read(tmp_path, value(crop={"crop_center": [0, 0, 0]}))
    assert_facts(caplog.text, "crop", "ignored")


SCALED = [2 * one if at < 12 and at % 4 < 3 else one for at, one in enumerate(POSE)]
BAD = [
    ("{", ["JSON"]),
    ("[]", ["cameras"]),
    (value(camera_path=[]), ["cameras"]),
    (without(value(), "camera_path"), ["cameras"]),
    (without(value(), "render_width"), ["render_width"]),
    (value(render_height=0), ["render_height", 0]),
    (value(render_height=10.5), ["render_height", 10.5]),
    (value(camera_path=[7]), ["camera 0", "object"]),
    (value(camera_path=[entry(), without(entry(), "camera_to_world")]),
     ["camera 1", "camera_to_world"]),
    (value(camera_path=[entry(camera_to_world=POSE[:12])]), ["camera 0", 12]),
    (value(camera_path=[entry(camera_to_world="here")]), ["camera 0", "matrix"]),
    (value(camera_path=[entry(camera_to_world=[float("nan"), *POSE[1:]])]), ["camera 0", "finite"]),
    (value(camera_path=[entry(camera_to_world=[0] * 15 + [1])]), ["camera 0", "rigid"]),
    (value(camera_path=[entry(camera_to_world=SCALED)]), ["camera 0", 2]),
    (value(camera_path=[entry(camera_to_world=[-1, *POSE[1:]])]), ["camera 0", "reflection"]),
    (value(camera_path=[without(entry(), "fov")]), ["camera 0", "fov"]),
    (value(camera_path=[entry(fov=float("nan"))]), ["fov", "nan"]),
    (value(camera_path=[entry(fov="wide")]), ["fov", "'wide'"]),
    (value(camera_path=[entry(fov=0)]), ["fov", 0]),
    (value(camera_path=[entry(fov=180)]), ["fov", 180]),
    (value(camera_path=[entry(fov=10**400)]), ["finite"]),
    (value(fps=0), ["second", 0]),
    (without(value(seconds=0), "fps"), ["second"]),
    (value(camera_type="equirectangular"), ["equirectangular"]),
]


@pytest.mark.parametrize(("content", "facts"), BAD)
def test_a_file_that_is_no_camera_path_is_refused_with_the_reason(tmp_path, content, facts):
    with raises(FormatError, *facts):
        read(tmp_path, content)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with raises(FormatError):
        read_camera_path(tmp_path / "none.json")
