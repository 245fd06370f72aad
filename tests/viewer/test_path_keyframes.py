"""A camera path by keyframes: set in the browser, played there, saved for `recon render`."""

import shutil

import numpy as np
import pytest
from facts import assert_facts, raises
from viewing import opened, until, view

from recon_cli.errors import WorkspaceError
from recon_cli.flythrough.camera_path import CameraPath, read_camera_path
from recon_cli.viewer.keyframes import PathFolder


def click(page, text):
    page.page.get_by_text(text, exact=True).locator("visible=true").first.click()


def jump(page, client, shown, number):
    """Goes to the next view and waits until the browser is there."""
    click(page, "next")
    center = shown.content.views[number].view.camera.center
    until(page, lambda: np.allclose(client.camera.position, center, atol=1e-4))


def test_keyframes_become_a_path_that_is_played_and_saved(room, page, tmp_path):
    workspace = shutil.copytree(room, tmp_path / "room")
    with view(workspace) as shown:
        client = opened(page, shown)
        page.page.set_viewport_size({"width": 1000, "height": 900})
        click(page, "Camera path")
        click(page, "preview")
        page.page.get_by_text("A path needs two keyframes").wait_for(timeout=60_000)
        for number in range(3):
            jump(page, client, shown, number)
            click(page, "add")
            page.page.get_by_text(f"{number + 1} keyframe").wait_for(timeout=60_000)
        click(page, "add")
        page.page.get_by_text("Move the camera first").wait_for(timeout=60_000)
        click(page, "remove last")
        page.page.get_by_text("2 keyframes").wait_for(timeout=60_000)
        first, second = (shown.content.views[number].view.camera for number in (0, 1))
        seconds = page.page.get_by_label("Seconds").locator("visible=true")
        seconds.fill("1")
        seconds.press("Enter")
        click(page, "preview")
        until(page, lambda: np.allclose(client.camera.position, second.center, atol=1e-3))
        click(page, "save")
        page.page.get_by_text("recon render -w").wait_for(timeout=60_000)
    found = read_camera_path(workspace / "path-1.json")
    assert len(found.viewmats) == 30
    cameras = found.cameras()
    for camera, key in ((cameras[0], first), (cameras[-1], second)):
        np.testing.assert_allclose(camera.viewmat, key.viewmat, atol=1e-3)
    assert found.fovs_deg[0] == pytest.approx(np.degrees(2 * np.arctan(18 / 40)), abs=0.1)
    assert (found.width, found.height) == (48, 36)


def test_a_path_never_takes_the_place_of_another_and_a_full_disk_is_told(tmp_path, monkeypatch):
    path = CameraPath(np.tile(np.eye(4), (2, 1, 1)), np.array([50.0, 50.0]), 64, 48, 30.0)
    folder = PathFolder(tmp_path, tmp_path)
    for number in (1, 2):
        assert_facts(folder.save(path), f"path-{number}.json", f"--out path-{number}.mp4")
    assert "recon" not in PathFolder(tmp_path, None).save(path)
    assert sorted(file.name for file in tmp_path.iterdir()) == [
        "path-1.json", "path-2.json", "path-3.json"]

    def fail(*_args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("recon_cli.viewer.keyframes.write_camera_path", fail)
    with raises(WorkspaceError, "space", "left"):
        folder.save(path)
