"""Requests that `recon render` refuses before it looks at a workspace."""

from pathlib import Path

import pytest
from facts import raises

from recon_cli.errors import ConfigError
from recon_cli.flythrough.request import RenderRequest

BAD = [
    ({"path": "trainnig"}, ["training", "orbit", "tour"]),
    ({"fps": 0.0}, ["--fps", 0]),
    ({"fps": float("nan")}, ["--fps", "nan"]),
    ({"seconds": -1.0}, ["--seconds", -1]),
    ({"fps": 240.0, "seconds": 1000.0}, ["240,000"]),
    ({"size": 0}, ["--size", 0, 1]),
    ({"size": 100, "width": 100}, ["--size", "--width"]),
    ({"background": (0, 256, 0)}, [255]),
    ({"path": "a.json", "seconds": 3.0}, ["--seconds"]),
    ({"views": ("test",), "fps": 3.0}, ["--fps", "single views"]),
    ({"views": ("test",), "form": "mp4"}, ["video", "views"]),
    ({"views": ("test",), "width": 8, "height": 8}, ["--width", "--height", "single views"]),
    ({"crf": 20}, ["--crf", "video"]),
    ({"codec": "av1"}, ["--codec", "video"]),
    ({"crf": 52, "form": "mp4"}, ["--crf", 51]),
    ({"crf": -1, "codec": "av1", "form": "mp4"}, ["--crf", 63]),
    ({"out": Path("a.mp4"), "form": "png"}, ["a.mp4", "png"]),
    ({"out": Path("a.png"), "form": "mp4"}, ["a.png", "mp4"]),
    ({"out": Path("a.mp4"), "outputs": ("rgb", "depth")}, ["a.mp4", 2]),
    ({"out": Path("a.gif"), "form": "webm"}, ["a.gif", "webm"]),
    ({"out": Path("a.jpg"), "form": "png"}, ["a.jpg", "png"]),
    ({"out": Path("a.webm"), "codec": "h264"}, [".webm", "av1", "h264"]),
    ({"out": Path("a.gif"), "crf": 20}, ["--crf", ".gif"]),
    ({"out": Path("a.xyz")}, ["a.xyz"]),
    ({"out": Path("a.png"), "outputs": ("depth",)}, ["a.png", "depth"]),
]


@pytest.mark.parametrize(("options", "facts"), BAD)
def test_what_cannot_be_is_refused(options, facts):
    with raises(ConfigError, *facts):
        RenderRequest(**options)


def test_a_file_that_ends_in_mp4_is_a_video():
    assert RenderRequest(out=Path("a.mp4")).video
    assert not RenderRequest(out=Path("folder")).video
    assert RenderRequest(form="mp4", out=Path("folder")).video
    assert RenderRequest(form="mp4", codec="av1").quality == ("av1", 28)
    assert RenderRequest(form="mp4", crf=7).quality == ("h264", 7)


def test_a_file_says_the_kind_of_video_and_a_folder_may_have_a_dot():
    for form, codec in (("mp4", "h264"), ("mov", "h264"), ("webm", "av1"), ("gif", "gif")):
        request = RenderRequest(out=Path(f"a.{form.upper()}"))
        assert (request.video, request.quality[0]) == (form, codec)
    assert RenderRequest(out=Path("a.jpg"), views=("test",)).out_file == Path("a.jpg")
    for name in (".hidden", "v1.5", "plain"):
        assert RenderRequest(out=Path(name)).out_file is None


def test_a_folder_that_is_there_keeps_its_name(tmp_path):
    (tmp_path / "walk.v2").mkdir()
    assert RenderRequest(out=tmp_path / "walk.v2").out_file is None
