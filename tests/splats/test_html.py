"""A page with a scene in it: what is read back, what visitors are told, and files that lie."""

import base64
import json
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from archive_splats import room
from facts import raises

from recon_cli.errors import FormatError
from recon_cli.scene.camera import Camera
from recon_cli.splats.axes import turn_from
from recon_cli.splats.format import Tour
from recon_cli.splats.html import PageStyle, default_view, find_title, load_html, write_html
from recon_cli.splats.spz import load_spz, spz_bytes

Y_DOWN = np.array([0.0, -1, 0])
HOSTILE = '</script><script>alert(1)</script>"><img src=x onerror=alert(2)><!-- $scene &lt; \u2028'


def camera(x: float = 0.0) -> Camera:
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    return Camera(200, 100, 150.0, 160.0, 98.0, 53.0, viewmat)


@pytest.fixture
def written(tmp_path):
    """A page of 40 Gaussians of degree 3 with two cameras."""
    path = tmp_path / "a.html"
    write_html(path, room(40), style=PageStyle("room"), up=Y_DOWN,
               views=[("a", camera()), ("b", camera(1.0))])
    return path


class Elements(HTMLParser):
    """The elements of a page with their attributes and texts, in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None], str]] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, dict(attrs), ""))

    def handle_data(self, data):
        if self.found:
            tag, attributes, text = self.found[-1]
            self.found[-1] = (tag, attributes, text + data)

    def of(self, tag, **wanted):
        return [(attributes, text) for found, attributes, text in self.found
                if found == tag and all(attributes.get(key) == value
                                        for key, value in wanted.items())]


def told(path):
    """What the page tells its viewer."""
    [(_, text)] = Elements(path.read_text(encoding="utf-8")).of("script", id="views")
    return json.loads(text)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_page_reads_back_as_the_spz_of_the_same_scene(tmp_path, degree):
    splats = room(500, degree=degree)
    write_html(tmp_path / "a.html", splats)
    finest = spz_bytes(
        tmp_path / "a.spz", turn_from("rub", splats.as_arrays()), harmonic_step=1)
    (tmp_path / "a.spz").write_bytes(finest)
    page = load_html(tmp_path / "a.html").splats
    spz = load_spz(tmp_path / "a.spz", axes="rub").splats
    assert torch.allclose(page.means, splats.means, atol=1e-3)
    for name, value in spz.parameters().items():
        assert torch.equal(getattr(page, name), value), name


@pytest.mark.parametrize(("log_scale", "halvings"), [(5.9, 0), (6.1, 1), (8.8, 5)])
def test_a_scene_with_gaussians_too_large_for_spz_is_halved_and_read_back_as_it_was(
        tmp_path, log_scale, halvings, caplog):
    splats = room(200, degree=0)
    splats.log_scales[3] = log_scale
    splats.means[3] = torch.tensor([1500.0, -900.0, 40.0])
    write_html(tmp_path / "a.html", splats)
    text = (tmp_path / "a.html").read_text("utf-8")
    assert (f'data-halvings="{halvings}"' in text) == (halvings > 0)
    assert "smaller" not in caplog.text
    back = load_html(tmp_path / "a.html").splats
    assert (back.log_scales - splats.log_scales).abs().max() <= 0.5 / 16 + 1e-5
    assert (back.means - splats.means).abs().max() <= 0.5 / 2**11


def test_the_same_scene_gives_the_same_bytes(tmp_path):
    for name in ("a.html", "b.html"):
        write_html(tmp_path / name, room(40), style=PageStyle("x"), views=[("v", camera())])
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


def test_a_page_names_nothing_that_lies_outside_of_it(written):
    for tag, attributes, _ in Elements(written.read_text(encoding="utf-8")).found:
        for name in ("src", "href", "action", "data", "poster", "srcset"):
            assert (attributes.get(name) or "data:").startswith("data:"), (tag, attributes)


def test_the_licences_of_what_is_in_the_page_are_in_the_page(written):
    text = written.read_text(encoding="utf-8")
    for owner in ("three.js authors", "WORLD LABS TECHNOLOGIES", "Arjun Barrett"):
        assert owner in text


def test_no_name_can_add_an_element_or_a_scene(tmp_path):
    plain, hostile = tmp_path / "plain.html", tmp_path / "hostile.html"
    write_html(plain, room(40), style=PageStyle("room"), views=[("view", camera())])
    write_html(hostile, room(40), style=PageStyle(HOSTILE), views=[(HOSTILE, camera())])
    tags = [[(tag, sorted(attributes)) for tag, attributes, _ in
             Elements(path.read_text(encoding="utf-8")).found] for path in (plain, hostile)]
    assert tags[0] == tags[1]
    [(_, title)] = Elements(hostile.read_text(encoding="utf-8")).of("title")
    assert title.rstrip("\n") == HOSTILE
    assert len(load_html(hostile).splats) == 40


def test_a_name_that_is_no_text_becomes_some(tmp_path):
    write_html(
        tmp_path / "a.html", room(9), style=PageStyle("a\udcff"), views=[("b\udcff", camera())])
    [(_, title)] = Elements((tmp_path / "a.html").read_text(encoding="utf-8")).of("title")
    assert title.startswith("a?")


def test_a_viewer_is_told_each_camera_exactly_and_each_lens_once(written):
    value = told(written)
    assert len(value["views"]) == 2
    assert value["lenses"] == [
        {"fx": 150.0, "fy": 160.0, "cx": 98.0, "cy": 53.0, "width": 200, "height": 100}]
    pose = np.array(value["views"][1]["pose"]).reshape(3, 4)
    assert np.array_equal(pose, [[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0]])
    assert value["up"] == [0, -1, 0]


def test_the_orbit_turns_about_what_a_camera_sees(tmp_path):
    splats = room(2000)
    splats.means[:, 2] = torch.where(splats.means[:, 0] > 0, 3.0, 50.0)
    right = camera()
    right.viewmat[0, 3] = -1.6  # only what is at x > 0 lies in its picture at a depth of 3
    write_html(tmp_path / "a.html", splats.select(splats.means[:, 0] > 0.5), views=[("", right)])
    assert told(tmp_path / "a.html")["views"][0]["distance"] == pytest.approx(3.0)


def test_a_camera_that_sees_nothing_turns_about_something_all_the_same(tmp_path):
    away = camera()
    away.viewmat[2, 2] = away.viewmat[0, 0] = -1.0
    write_html(tmp_path / "a.html", room(40), views=[("", away)])
    value = told(tmp_path / "a.html")
    assert value["views"][0]["distance"] == value["reach"] > 0


@pytest.mark.parametrize("up", np.concatenate([np.eye(3), -np.eye(3), [[0.6, 0, 0.8]]]))
def test_without_cameras_the_page_opens_in_front_of_the_scene(up):
    splats = room(400)
    _, found = default_view(splats, up)
    middle = splats.means.median(dim=0).values.double().numpy()
    place = found.viewmat[:3, :3] @ middle + found.viewmat[:3, 3]
    reach = np.quantile(np.linalg.norm(splats.means.double().numpy() - middle, axis=1), 0.9)
    assert np.allclose(place[:2], 0, atol=reach * 0.01)
    assert reach < place[2] < 4 * reach
    turn = found.viewmat[:3, :3]
    assert np.allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1)
    assert turn[1] @ up < -0.9  # y of the camera is down
    assert abs(turn[0] @ up) < 1e-12  # the horizon is level


def test_one_gaussian_makes_a_page(tmp_path):
    write_html(tmp_path / "a.html", room(1))
    assert len(load_html(tmp_path / "a.html").splats) == 1
    assert told(tmp_path / "a.html")["reach"] > 0


def test_what_no_spz_holds_no_page_holds_and_nothing_is_written(tmp_path):
    splats = room(9)
    splats.means[3, 1] = float("nan")
    with raises(FormatError, "finite"):
        write_html(tmp_path / "a.html", splats)
    with raises(FormatError, "Gaussians"):
        write_html(tmp_path / "a.html", splats.select(torch.arange(0)))
    assert list(tmp_path.iterdir()) == []


def test_names_of_files_are_not_in_the_page(tmp_path):
    write_html(tmp_path / "a.html", room(9), views=[("IMG_0042.jpg", camera())])
    assert b"IMG_0042" not in (tmp_path / "a.html").read_bytes()


def test_a_page_has_a_picture_and_tells_programs_of_links_where_it_lies(tmp_path):
    picture = b"\xff\xd8 a picture"
    write_html(tmp_path / "a.html", room(9), style=PageStyle(
        "a <room>", poster=picture, preview="a.jpg"))
    elements = Elements((tmp_path / "a.html").read_text(encoding="utf-8"))
    [(image, _)] = elements.of("img")
    assert base64.b64decode(image["src"].split(",")[1]) == picture
    said = {attributes["property"]: attributes["content"]
            for attributes, _ in elements.of("meta") if "property" in attributes}
    assert (said["og:title"], said["og:image"]) == ("a <room>", "a.jpg")


@pytest.mark.parametrize("credits", [True, False])
def test_credits_are_shown_where_they_are_wanted(tmp_path, credits):
    write_html(tmp_path / "a.html", room(9), style=PageStyle(credits=credits))
    found = Elements((tmp_path / "a.html").read_text(encoding="utf-8")).of("span", id="credits")
    assert len(found) == credits


def test_a_tour_is_told_place_by_place(tmp_path):
    margins = np.array([[1, 1.5, 1, 1], [1, 1, 1.25, 2]])
    write_html(tmp_path / "a.html", room(40), up=Y_DOWN, views=[("a", camera())], style=PageStyle(
        tour=Tour([camera(), camera(2.0)], margins, seconds=7.5, start=1)))
    tour = told(tmp_path / "a.html")["tour"]
    assert (tour["seconds"], tour["start"]) == (7.5, 1)
    assert [view["margins"] for view in tour["views"]] == margins.tolist()
    assert [view["pose"][3] for view in tour["views"]] == [0, 2]


@pytest.mark.parametrize(("name", "title"), [
    ("living_room.mp4", "Living room"), ("my-flat", "My flat"), ("kitchen 2.mov", "Kitchen 2"),
    ("IMG_4711.MOV", "A place in 3D"), ("20260314_101500.mp4", "A place in 3D"),
    ("PXL_20260314_101500123.mp4", "A place in 3D"), ("DSC00042.JPG", "A place in 3D"),
])
def test_a_title_is_made_of_a_name_that_somebody_gave(name, title):
    assert find_title(name) == title
