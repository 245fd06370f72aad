"""The viewer in headless Chromium: what the page shows is what was asked for."""

import math

import numpy as np
import pytest
import torch
import viser.transforms
from viewing import complaints, nodes, opened, until, view

from recon_cli.evaluation.metrics import psnr
from recon_cli.io.images import read_image, to_uint8
from recon_cli.render import render
from recon_cli.splats.html import ICON
from recon_cli.viewer.content import TRAINING
from recon_cli.viewer.measure import locate_click
from recon_cli.viewer.session import Session


@pytest.fixture
def sessions(monkeypatch):
    """All sessions that begin, in order."""
    found = []
    begin = Session.__init__

    def remembered(self, *args):
        begin(self, *args)
        found.append(self)

    monkeypatch.setattr(Session, "__init__", remembered)
    return found


def picture(elsewhere, page, client, camera):
    """The browser's picture for a camera, [H, W, 3] over black."""
    turn = camera.viewmat[:3, :3].T
    asked = elsewhere.submit(
        client.get_render, camera.height, camera.width, transport_format="png", timeout=60,
        position=camera.center, wxyz=viser.transforms.SO3.from_matrix(turn).wxyz,
        fov=2 * math.atan(camera.height / 2 / camera.fy))
    until(page, asked.done)
    rgba = asked.result() / 255
    return rgba[..., :3] * rgba[..., 3:]


def test_the_page_draws_what_recon_renders_and_asks_nobody_else(shown, page, elsewhere):
    client = opened(page, shown)
    until(page, lambda: nodes(page, "GaussianSplatsMessage"))
    page.page.wait_for_timeout(700)  # new Gaussians fade in for half a second
    camera = next(one.view.camera for one in shown.content.views if one.part == TRAINING)
    camera = camera.resized(192, 144)  # where the browser begins, and has its colours from
    with torch.no_grad():
        splats = shown.content.models["pruned"].splats
        ours = render(splats, camera, splats.background, 3).rgb
    drawn = picture(elsewhere, page, client, camera)
    # viser cuts Gaussians off at two standard deviations and drops the faintest
    assert psnr(drawn.astype(np.float32), to_uint8(ours.numpy())) > 27
    assert not complaints(page)
    assert all(shown.address in address or address.startswith(("data:", "blob:"))
               for address in page.addresses)


def test_the_page_has_a_name_and_icon_of_its_own(shown, page):
    opened(page, shown)
    assert page.page.title() == f"{shown.content.title} - recon"
    icon = page.page.evaluate("document.querySelector('link[rel=icon]').href")
    assert icon == ICON
    assert not complaints(page)


def test_on_a_phone_the_panel_is_folded_until_it_is_wanted(shown, page):
    page.page.set_viewport_size({"width": 390, "height": 844})
    page.page.goto(shown.address)
    head = page.page.get_by_text(f"{shown.content.title} - recon", exact=True)
    head.wait_for(timeout=60_000)
    until(page, lambda: head.bounding_box()["y"] > 780)  # the picture above is free
    head.click()
    until(page, lambda: head.bounding_box()["y"] < 600)


def test_a_jump_puts_the_camera_where_the_view_is_and_shows_its_photo_and_score(shown, page):
    client = opened(page, shown)
    page.page.get_by_text("next", exact=True).click()
    page.page.get_by_text("PSNR").wait_for(timeout=60_000)
    view = shown.content.views[0].view
    assert view.name == "000000.png"
    text = page.page.inner_text("body")
    assert "000000.png (held-out), compact: PSNR" in text
    with torch.no_grad():
        splats = shown.content.models["pruned"].splats
        ours = render(splats, view.camera, splats.background, 3).rgb.numpy()
    expected = psnr(ours, read_image(view.original, 48, 36))
    assert float(text.split("PSNR ")[1].split(" dB")[0]) == pytest.approx(expected, abs=0.02)
    reported = until(page, lambda: np.allclose(
        client.camera.position, view.camera.center, atol=1e-4) and client.camera)
    turn = viser.transforms.SO3(reported.wxyz).as_matrix()
    np.testing.assert_allclose(turn, view.camera.viewmat[:3, :3].T, atol=1e-3)
    assert reported.fov == pytest.approx(2 * math.atan(18 / 40), abs=1e-3)
    photos = page.page.locator("img:visible")
    assert [photo.evaluate("image => image.naturalWidth") for photo in photos.all()] == [48, 48]
    page.page.get_by_text("previous", exact=True).click()
    page.page.get_by_text(f"{shown.content.views[-1].label}, compact").wait_for(timeout=60_000)


def test_the_cameras_come_with_their_photos_when_they_are_asked_for(shown, page):
    opened(page, shown)
    assert not nodes(page, "CameraFrustumMessage")
    page.page.get_by_label("Cameras").locator("visible=true").click()
    until(page, lambda: len(nodes(page, "CameraFrustumMessage")) == 12)
    until(page, lambda: page.page.evaluate(
        """() => Object.values(window.__viserSceneTree.getState()).filter(node =>
            node?.message.type === 'CameraFrustumMessage' && node.message.props._image_data)
            .length""") == 12)
    page.page.get_by_text("next", exact=True).click()  # who stands among them sees nothing else
    until(page, lambda: not nodes(page, "CameraFrustumMessage"))


def test_another_model_is_shown_and_counted(shown, page):
    opened(page, shown)
    assert "25 of 25 Gaussians (compact)" in page.page.inner_text("body")
    page.page.get_by_role("combobox", name="Model").click()
    page.page.get_by_role("option", name="original").click()
    page.page.get_by_text("of 60 Gaussians (original)").wait_for(timeout=60_000)


def test_the_box_hides_what_is_outside_and_is_given_as_export_takes_it(shown, page):
    opened(page, shown)
    page.page.get_by_text("Crop", exact=True).click()
    page.page.get_by_label("Hide what is outside").locator("visible=true").click()
    lowest = page.page.locator("input[inputmode]:visible").first
    lowest.fill("0.5")
    lowest.press("Enter")
    words = until(page, lambda: page.page.get_by_text("recon export --crop 0.5").all())
    numbers = [float(word) for word in words[0].inner_text().split("--crop ")[1].split()]
    means = shown.content.models["pruned"].splats.means
    inside = ((means >= torch.tensor(numbers[:3])) & (means <= torch.tensor(numbers[3:]))).all(1)
    assert 0 < inside.sum() < 25
    page.page.get_by_text(f"{inside.sum()} of 25 Gaussians").wait_for(timeout=60_000)


def test_browsers_come_go_and_reload_and_each_has_its_own_colours(
    shown, page, chromium, sessions
):
    opened(page, shown)
    other = chromium.new_page()
    other.goto(shown.address)
    until(page, lambda: len(sessions) == 2)
    page.page.get_by_text("next", exact=True).click()
    first, second = sessions
    seen = [one.view.camera.center for one in shown.content.views]
    packed = shown.content.models["pruned"]
    until(page, lambda: np.abs(
        first._node.rgbs.astype(int) - packed.colors(seen[0].tolist())).max() <= 1)
    assert np.abs(first._node.rgbs.astype(int) - second._node.rgbs).max() > 1
    other.close()
    until(page, lambda: len(shown.server.get_clients()) == 1)
    page.page.reload()
    until(page, lambda: len(sessions) == 3 and len(shown.server.get_clients()) == 1)
    page.page.get_by_text("25 of 25 Gaussians").wait_for(timeout=60_000)


def test_a_viewer_that_ends_lets_go_of_its_browsers(room, page):
    with view(room) as shown:
        opened(page, shown)
        page.page.get_by_text("next", exact=True).click()
    assert not shown.server.get_clients()


def test_two_clicked_points_have_the_distance_of_the_surfaces_under_them(
    shown, page, sessions
):
    client = opened(page, shown)
    page.page.set_viewport_size({"width": 1000, "height": 700})  # the panel covers no surface
    page.page.get_by_text("next", exact=True).click()
    page.page.get_by_text("PSNR").wait_for(timeout=60_000)
    view = shown.content.views[0].view
    until(page, lambda: np.allclose(client.camera.position, view.camera.center, atol=1e-4))
    page.page.get_by_text("Measure", exact=True).click()
    page.page.get_by_label("Click points").locator("visible=true").click()
    page.page.wait_for_timeout(500)  # until the canvas listens
    canvas = page.page.locator("canvas").first.bounding_box()
    focal = canvas["height"] / 2 / math.tan(client.camera.fov / 2)
    splats = shown.content.models["pruned"].splats

    def surface(x, y):
        ray = np.array([(x - canvas["width"] / 2) / focal, (y - canvas["height"] / 2) / focal, 1])
        return locate_click(splats, view.camera.center, view.camera.viewmat[:3, :3].T @ ray,
                            "torch")

    grid = [(x, y) for x in np.linspace(0.1, 0.5, 9) * canvas["width"]
            for y in np.linspace(0.4, 0.9, 6) * canvas["height"] if surface(x, y) is not None]
    expected = []
    for number, (x, y) in enumerate((grid[0], grid[-1]), start=1):
        expected.append(surface(x, y))
        page.page.mouse.move(canvas["x"] + x, canvas["y"] + y)
        page.page.mouse.down()
        page.page.wait_for_timeout(100)  # as long as people press
        page.page.mouse.up()
        until(page, lambda n=number: len(sessions[0]._measure._points) == n)
    np.testing.assert_allclose(sessions[0]._measure._points, expected, atol=0.02)
    distance = float(np.linalg.norm(expected[1] - expected[0]))
    page.page.get_by_text("Distance:").wait_for(timeout=60_000)
    shown_text = page.page.inner_text("body").split("Distance: ")[1].split()[0]
    assert float(shown_text) == pytest.approx(distance, abs=0.02)
    known = page.page.get_by_label("Known length (m)").locator("visible=true")
    known.fill("3")
    known.press("Enter")
    page.page.get_by_text("Distance: 3.000 m").wait_for(timeout=60_000)
    page.page.get_by_text("recon export --scale-between").wait_for(timeout=60_000)
    page.page.get_by_text("undo", exact=True).click()
    page.page.get_by_text("Click two points").wait_for(timeout=60_000)


def test_trust_tints_the_scene_from_where_one_stands_and_takes_the_tint_off_again(
    shown, page, sessions
):
    opened(page, shown)
    session = sessions[0]
    plain = session._node.rgbs.copy()
    tint = page.page.get_by_label("Trust").locator("visible=true")
    tint.click()
    until(page, lambda: (session._node.rgbs != plain).any())
    tinted = session._node.rgbs.copy()
    page.page.get_by_text("next", exact=True).click()
    until(page, lambda: (session._node.rgbs != tinted).any())
    tint.click()
    camera = shown.content.views[0].view.camera
    packed = shown.content.models["pruned"]
    until(page, lambda: np.abs(
        session._node.rgbs.astype(int) - packed.colors(camera.center.tolist())).max() <= 1)
