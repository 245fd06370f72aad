"""The page of a scene in headless Chromium: what it shows, what can be pressed, what it says."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from archive_splats import room
from browser import WatchedPage
from facts import assert_facts
from PIL import Image
from scenes import camera_at, one_splat
from torch import Tensor

from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import joined, transformed
from recon_cli.splats import html
from recon_cli.splats.html import PageStyle, Tour, load_html, write_html

WIDTH, HEIGHT = 240, 180
Y_DOWN = np.array([0.0, -1, 0])
# dB of the page against recon's renderer, at least; measured are 51. The Gaussians are the same,
# but a browser blends in 8 bits and rounds at each layer of a pixel.
AGREE_DB = 48.0
HOSTILE = "</title><script>document.title = 'taken'</script> & \"q\""


def cameras() -> list[Camera]:
    """Three cameras before the room; the last is tilted, off its centre and has flat pixels."""
    first = Camera(WIDTH, HEIGHT, 200.0, 200.0, WIDTH / 2, HEIGHT / 2, np.eye(4))
    shift = np.eye(4)
    shift[:3, 3] = [0.4, -0.2, 0.5]
    second = Camera(WIDTH, HEIGHT, 150.0, 150.0, WIDTH / 2, HEIGHT / 2, shift)
    return [first, second, camera_at(WIDTH, HEIGHT, focal=180.0)]


def made(path: Path, degree: int = 3, count: int = 3000, title: str = "room") -> Path:
    """Writes a page of a made room with the three cameras."""
    write_html(path, room(count, degree=degree), style=PageStyle(title), up=Y_DOWN,
               views=[(f"{i}.png", camera) for i, camera in enumerate(cameras())])
    return path


def opened(page: WatchedPage, path: Path, *, hash: str = "") -> None:
    """Opens a page in a window of the cameras' size and waits until it shows the scene."""
    page.page.set_viewport_size({"width": WIDTH, "height": HEIGHT})
    page.page.goto(f"{path.as_uri()}{hash}")
    page.page.wait_for_selector("#message:empty", state="attached", timeout=60_000)


def picture(page: WatchedPage) -> np.ndarray:
    """What the settled page shows without its buttons, [H, W, 3] in [0, 1]."""
    page.page.add_style_tag(
        content="header, footer { visibility: hidden } #poster { display: none }")
    page.page.evaluate("recon.settled()")
    png = Image.open(io.BytesIO(page.page.screenshot())).convert("RGB")
    return np.asarray(png).astype(np.float64) / 255


def rendered(path: Path, camera: Camera, degree: int = 3) -> np.ndarray:
    """The same by recon's renderer, from the Gaussians in the page."""
    splats = load_html(path).splats
    with torch.no_grad():
        rgb = render(splats, camera, torch.zeros(3), min(degree, splats.sh_degree)).rgb
    return rgb.clamp(0, 1).double().numpy()


def psnr_db(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(max(((one - other) ** 2).mean(), 1e-12)))


def nearest(page: WatchedPage, path: Path) -> int:
    """The number, from 1, of the camera whose picture the page shows."""
    seen = picture(page)
    scores = [psnr_db(seen, rendered(path, camera)) for camera in cameras()]
    assert max(scores) > AGREE_DB, scores
    return int(np.argmax(scores)) + 1


@pytest.mark.parametrize("degree", [0, 3])
def test_the_page_shows_what_recon_renders_and_asks_for_nothing(page, tmp_path, degree):
    path = made(tmp_path / "a.html", degree)
    opened(page, path)
    for number, camera in enumerate(cameras(), start=1):
        page.page.evaluate(f"recon.show({number})")
        seen = picture(page)
        assert psnr_db(seen, rendered(path, camera)) > AGREE_DB, number
        if degree:  # without its harmonics it would be another picture
            assert psnr_db(seen, rendered(path, camera, degree - 1)) < AGREE_DB - 8, number
    page.assert_silent()
    page.assert_offline()


def test_the_page_shows_a_large_gaussian_whose_middle_is_beside_the_window(page, tmp_path):
    # a wall of one colour is few large Gaussians; its middle is at 1.6 times the window here
    path, camera = tmp_path / "a.html", cameras()[0]
    beside = 1.6 * camera.cx / camera.fx
    wall = one_splat((3 * beside, 0.0, 3.0), scale=1.0, opacity=0.9, color=(0.9, 0.8, 0.6))
    both, _ = joined([room(1000, degree=0), wall.with_degree(0).map(Tensor.float)])
    write_html(path, both, up=Y_DOWN, views=[("", camera)])
    opened(page, path)
    # Spark by itself leaves the wall out, which makes 19 dB
    assert psnr_db(picture(page), rendered(path, camera, 0)) > AGREE_DB
    page.assert_silent()


def test_the_page_shows_a_scene_that_was_halved_to_fit_into_spz(page, tmp_path):
    path, camera = tmp_path / "a.html", cameras()[0]
    far = one_splat((1200.0, 300.0, 2500.0), scale=900.0, opacity=0.9, color=(0.9, 0.8, 0.6))
    both, _ = joined([room(1000, degree=0), far.with_degree(0).map(Tensor.float)])
    write_html(path, both, up=Y_DOWN, views=[("", camera)])
    assert 'data-halvings="2"' in path.read_text("utf-8")
    opened(page, path)
    assert psnr_db(picture(page), rendered(path, camera, 0)) > AGREE_DB
    page.assert_silent()


def test_a_page_with_levels_of_detail_shows_the_scene(page, tmp_path, monkeypatch):
    monkeypatch.setattr(html, "_LEVELS_FROM", 3000)
    path = made(tmp_path / "a.html", 0)
    opened(page, path)
    for number, camera in enumerate(cameras(), start=1):
        page.page.evaluate(f"recon.show({number})")
        # few enough for the finest level
        assert psnr_db(picture(page), rendered(path, camera)) > AGREE_DB, number
    page.assert_silent()
    page.assert_offline()


@pytest.mark.parametrize("scale", [0.1, 40.0])
def test_another_frame_and_size_of_the_world_change_nothing(page, tmp_path, scale):
    turn = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
    moved = Similarity(scale, turn, np.array([3.0, -2, 1]))
    path, camera = tmp_path / "a.html", cameras()[2]
    write_html(path, room(3000))
    want = rendered(path, camera)
    write_html(path, transformed(room(3000), moved), up=turn @ Y_DOWN,
               views=[("", moved.camera(camera))])
    opened(page, path)
    assert psnr_db(picture(page), want) > AGREE_DB - 3  # .spz has other steps there
    page.assert_silent()


def test_buttons_keys_and_the_address_choose_the_camera(page, tmp_path):
    path = made(tmp_path / "a.html")
    opened(page, path, hash="#view=3")
    assert nearest(page, path) == 3
    button = {name: page.page.locator(f"#{name}") for name in (
        "before", "after", "reset", "number")}
    page.page.add_style_tag(content="footer { visibility: visible !important }")
    assert button["number"].inner_text() == "3/3"
    button["before"].click()
    assert button["number"].inner_text() == "2/3"
    for _ in range(2):
        button["after"].click()
    assert button["number"].inner_text() == "1/3"  # behind the last comes the first
    page.page.keyboard.press("p")
    assert button["number"].inner_text() == "3/3"
    page.page.keyboard.press("n")
    page.page.keyboard.press("n")
    assert button["number"].inner_text() == "2/3"
    page.page.evaluate("location.hash = '#view=1'")
    page.page.wait_for_timeout(50)
    assert button["number"].inner_text() == "1/3"
    button["after"].click()
    button["reset"].click()
    assert button["number"].inner_text() == "1/3"
    page.page.evaluate("document.querySelector('footer').remove()")
    assert nearest(page, path) == 1
    page.assert_silent()


@pytest.mark.parametrize("mode", ["orbit", "fly"])
def test_a_drag_and_a_key_move_the_camera_and_reset_takes_it_back(page, tmp_path, mode):
    path = made(tmp_path / "a.html")
    opened(page, path)
    before = picture(page)
    if mode == "fly":
        page.page.keyboard.press("f")
        assert page.page.locator("#mode").get_attribute("aria-pressed") == "true"
    page.page.mouse.move(120, 80)
    page.page.mouse.down()
    page.page.mouse.move(170, 100, steps=4)
    page.page.mouse.up()
    dragged = picture(page)
    assert psnr_db(before, dragged) < 30
    page.page.keyboard.down("w")
    page.page.wait_for_timeout(300)
    page.page.keyboard.up("w")
    page.page.wait_for_timeout(300)  # what glides comes to rest
    assert psnr_db(dragged, picture(page)) < 40
    page.page.keyboard.press("r")
    assert psnr_db(before, picture(page)) > 45
    page.assert_silent()


def test_what_the_wheel_did_in_orbit_is_not_done_again_in_flight(page, tmp_path):
    opened(page, made(tmp_path / "a.html", 0))
    before = picture(page)
    page.page.mouse.move(120, 80)
    page.page.mouse.wheel(0, -300)
    assert psnr_db(before, picture(page)) < 30
    page.page.keyboard.press("r")
    page.page.keyboard.press("f")
    page.page.wait_for_timeout(200)
    assert psnr_db(before, picture(page)) > 45


def test_the_orbit_keeps_the_middle_of_the_scene_in_the_middle(page, tmp_path):
    """A bright Gaussian alone: however one turns about it, it stays where it is."""
    splats = room(1, degree=0)
    splats.means[:], splats.log_scales[:] = torch.tensor([0.0, 0, 4]), -1.0
    splats.logit_opacities[:], splats.sh_dc[:] = 8.0, 2.0
    write_html(tmp_path / "a.html", splats, up=Y_DOWN, views=[("", cameras()[0])])
    opened(page, tmp_path / "a.html")
    before = picture(page)
    page.page.mouse.move(60, 80)
    page.page.mouse.down()
    page.page.mouse.move(150, 90, steps=5)
    page.page.mouse.up()
    assert before[HEIGHT // 2, WIDTH // 2].min() > 0.8
    assert psnr_db(before, picture(page)) > 35


def test_the_page_stands_upright(page, tmp_path):
    """From an orbit the scene's up is up: a Gaussian above the middle lies above it."""
    splats = room(2, degree=0)
    splats.means[:] = torch.tensor([[0.0, 0, 4], [0.0, 0, 5]])  # the second is above: z is up
    splats.log_scales[:], splats.logit_opacities[:] = -2.0, 8.0
    splats.sh_dc[:] = torch.tensor([[2.0, -2, -2], [-2.0, 2, -2]])  # red, green
    write_html(tmp_path / "a.html", splats)
    opened(page, tmp_path / "a.html")
    seen = picture(page)
    red, green = (np.argwhere(seen[:, :, one] > 0.5).mean(axis=0) for one in (0, 1))
    assert green[0] < red[0] - 10
    assert abs(green[1] - red[1]) < 3


def test_a_hostile_name_is_only_a_name(page, tmp_path):
    path = made(tmp_path / "a.html", 0, 50, HOSTILE)
    opened(page, path)
    assert page.page.title() == HOSTILE
    page.assert_silent()


def test_it_fits_a_phone(page, tmp_path):
    path = made(tmp_path / "a.html", 0, 500)
    opened(page, path)
    page.page.set_viewport_size({"width": 360, "height": 640})
    page.page.evaluate("recon.settled()")
    assert page.page.evaluate("document.documentElement.scrollWidth") == 360
    for name in ("reset", "mode", "before", "after", "ask"):
        box = page.page.locator(f"#{name}").bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 360
        assert box["y"] + box["height"] <= 640
        assert min(box["width"], box["height"]) >= 32  # a finger hits it
    canvas = page.page.locator("canvas").bounding_box()
    assert (canvas["width"], canvas["height"]) == (360, 640)
    page.assert_silent()


def toured(path: Path) -> Path:
    """Writes a page with a tour of ten seconds through the first two cameras, from the second."""
    tour = Tour(cameras()[:2], np.ones((2, 4)), seconds=10.0, start=1)
    write_html(path, room(3000), up=Y_DOWN, style=PageStyle("room", tour),
               views=[(f"{i}.png", camera) for i, camera in enumerate(cameras())])
    return path


@pytest.mark.parametrize("width", [360, 390])
def test_all_buttons_of_a_tour_fit_a_phone_with_their_words(page, tmp_path, width):
    opened(page, toured(tmp_path / "a.html"))
    page.page.set_viewport_size({"width": width, "height": 640})
    page.page.evaluate("recon.settled()")
    for name in ("play", "speed", "reset", "mode", "before", "after", "ask"):
        box = page.page.locator(f"#{name}").bounding_box()
        assert 0 <= box["x"] <= box["x"] + box["width"] <= width
        assert min(box["width"], box["height"]) >= 32  # a finger hits it
        inside = page.page.locator(f"#{name}").evaluate("e => e.clientWidth - e.scrollWidth")
        assert inside >= 0  # no word is cut off


def test_a_page_opens_where_its_tour_starts_and_returns_there(page, tmp_path):
    path = toured(tmp_path / "a.html")
    opened(page, path)
    assert nearest(page, path) == 2
    page.page.evaluate("recon.tour(0)")
    assert nearest(page, path) == 1
    page.page.keyboard.press("r")
    assert nearest(page, path) == 2
    page.assert_silent()


def test_a_tour_plays_until_the_visitor_takes_the_camera(page, tmp_path):
    opened(page, toured(tmp_path / "a.html"))
    page.page.evaluate("recon.tour(0)")
    first = picture(page)
    page.page.add_style_tag(content="footer { visibility: visible !important }")
    play = page.page.locator("#play")
    play.click()
    page.page.wait_for_timeout(1500)
    assert play.get_attribute("aria-pressed") == "true"
    page.page.mouse.move(120, 60)
    page.page.mouse.down()
    page.page.mouse.up()
    assert play.get_attribute("aria-pressed") == "false"
    stopped = picture(page)
    assert psnr_db(first, stopped) < 40  # it has gone on
    page.page.wait_for_timeout(500)
    assert psnr_db(stopped, picture(page)) > 45
    page.page.add_style_tag(content="footer { visibility: visible !important }")
    speed = page.page.locator("#speed")
    said = []
    for _ in range(3):
        speed.click()
        said.append(speed.inner_text())
    assert [text[0] for text in said] == ["2", "½", "1"]
    page.assert_silent()


def test_a_tall_window_shows_no_more_than_views_have_seen(page, tmp_path):
    """Of a margin of one the picture fills the window; of two there is as much above as in it."""
    for margin in (1.0, 2.0):
        tour = Tour(cameras()[:2], np.full((2, 4), margin), seconds=10.0, start=0)
        write_html(tmp_path / "a.html", room(100), up=Y_DOWN, style=PageStyle("room", tour))
        opened(page, tmp_path / "a.html")
        page.page.set_viewport_size({"width": 200, "height": 600})
        page.page.evaluate("recon.settled()")
        down = page.page.evaluate("recon.degreesDown()")
        whole = np.sqrt(WIDTH / 200 * HEIGHT / 600) * 600  # without any limit
        shown = min(whole, margin * HEIGHT)
        assert down == pytest.approx(2 * np.degrees(np.arctan(shown / 2 / 200.0)), abs=0.01)


def test_while_it_loads_the_page_says_so(page, tmp_path):
    page.page.add_init_script("""
        window.said = [];
        new MutationObserver(() => {
            const message = document.getElementById("message");
            if (message) said.push(message.textContent);
        }).observe(document, {childList: true, subtree: true, characterData: true});""")
    opened(page, made(tmp_path / "a.html", 0, 50))
    said = page.page.evaluate("said")
    assert said[0].startswith("Loading")
    assert said[-1] == ""


def test_without_webgl_2_the_page_says_what_to_do(page, tmp_path):
    page.page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    path = made(tmp_path / "a.html", 0, 50)
    page.page.goto(path.as_uri())
    assert_facts(page.page.locator("#message").inner_text(), "WebGL", 2)
    assert not page.page.locator("#reset").is_visible()
    page.assert_silent()


def test_an_old_browser_is_told_that_it_is_too_old(page, tmp_path):
    page.page.add_init_script("delete window.DecompressionStream")
    path = made(tmp_path / "a.html", 0, 50)
    page.page.goto(path.as_uri())
    assert "too old" in page.page.locator("#message").inner_text()
    page.assert_silent()


def test_a_damaged_scene_is_an_error_in_the_page(page, tmp_path):
    path = made(tmp_path / "a.html", 0, 50)
    text = path.read_text(encoding="utf-8")
    at = text.index(">", text.index('<script id="scene"')) + 1
    path.write_text(text[:at] + "AAAA" + text[at + 4:], encoding="utf-8")
    page.page.goto(path.as_uri())
    page.page.wait_for_selector("#message.failed", timeout=30_000)
    assert "cannot be shown" in page.page.locator("#message").inner_text()
