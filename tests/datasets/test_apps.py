"""Every layout of scanning apps and photogrammetry, as its writer writes it, ends where it was."""

from pathlib import Path

import numpy as np
import pytest
from app_sets import APPS
from app_shots import shots
from phone_writers import relative
from PIL import Image

from recon_cli.datasets.layouts import LAYOUTS, read_posed, recognise

DOCS = Path(__file__).parents[2] / "docs" / "captures.md"
DECIMALS = 2e-6  # of the numbers in text files


@pytest.fixture(scope="session")
def frames(shared_data):
    return shots(shared_data / "rooms" / "office")


@pytest.fixture(scope="session")
def still(shared_data):
    return shots(shared_data / "rooms" / "office", moving=False)


def given(app, frames, still):
    return frames if app.own else still


def by_shot(posed):
    """Returns the images in the order of the shots, of the first camera of each."""
    images = [image for image in posed.images if image.frame is None or image.frame % 3 == 0]
    images = [image for image in images if "camera2" not in image.name
              and "right" not in image.name]
    return sorted(images, key=lambda image: (
        image.time if image.time is not None else 0.0, len(image.name), image.name))


@pytest.mark.parametrize("name", APPS)
def test_cameras_depth_and_unit_are_those_of_the_capture(name, frames, still, tmp_path):
    app = APPS[name]
    taken = given(app, frames, still)
    app.write(tmp_path, taken)
    assert recognise(tmp_path) == app.name
    posed = read_posed(tmp_path)
    world = relative(taken) if app.world is None else app.world
    images = by_shot(posed)
    assert len(images) == len(taken)
    assert (posed.metric, posed.accuracy) == (app.metric, app.accuracy)
    assert posed.up == app.up
    for image, shot in zip(images, taken, strict=True):
        np.testing.assert_allclose(np.linalg.inv(image.viewmat), world @ shot.c2w, atol=DECIMALS)
        inner = image.lens.params if len(image.lens.params) > 3 else (
            image.lens.params[0], *image.lens.params)
        np.testing.assert_allclose(inner[:4], shot.inner, atol=1e-5)
        assert (image.lens.width, image.lens.height) == (
            (shot.size[0] // 2 * 2, shot.size[1]) if name == "stray" else shot.size)
        assert (image.depth is not None) == app.depth


@pytest.mark.parametrize("name", [name for name, app in APPS.items() if app.depth])
def test_depth_is_in_metres_with_its_confidence(name, frames, tmp_path):
    APPS[name].write(tmp_path, frames)
    for image, shot in zip(by_shot(read_posed(tmp_path)), frames, strict=True):
        depth = image.depth.read()
        if name == "nerfcapture":  # of the photo's size
            rows = (np.arange(shot.depth.shape[0]) + 0.5) / shot.depth.shape[0] * depth.shape[0]
            columns = (np.arange(shot.depth.shape[1]) + 0.5) / shot.depth.shape[1] * depth.shape[1]
            depth = depth[np.ix_(rows.astype(int), columns.astype(int))]
        np.testing.assert_allclose(depth, shot.depth, atol=6e-4)
        assert image.depth.reliable == 5
        found = image.depth.read_confidence()
        if name in ("record3d", "rtabmap", "nerfcapture"):
            assert found is None
        else:
            assert found[:, 0].max() == 0
            assert set(found[:, 1]) == {1}
            assert found[:, 2:].min() == 2
            assert not image.depth()[:, 0].any()  # low confidence is not used


def test_the_page_of_captures_names_every_layout():
    text = DOCS.read_text(encoding="utf-8")
    for row in LAYOUTS:
        assert f"`{row.name}`" in text, row.name


def test_every_app_layout_has_a_writer_here():
    others = {"replica", "scannet", "7scenes", "tum", "transforms"}
    assert {app.name for app in APPS.values()} == {row.name for row in LAYOUTS} - others


def test_images_of_a_written_capture_are_those_of_the_shots(frames, tmp_path):
    APPS["record3d"].write(tmp_path, frames)
    for image, shot in zip(read_posed(tmp_path).images, frames, strict=True):
        off = np.abs(np.asarray(Image.open(image.path), float) - shot.rgb)
        assert off.mean() < 3
