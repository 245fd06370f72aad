"""What `recon render` refuses before it looks at a workspace, and the sizes of frames."""

from pathlib import Path

import pytest

from recon_cli.errors import ConfigError
from recon_cli.flythrough import images
from recon_cli.flythrough.images import frame_size, refuse_what_does_not_fit
from recon_cli.flythrough.request import Request

BAD = [
    ({"path": "trainnig"}, "training, orbit or a FILE.json"),
    ({"fps": 0.0}, "--fps is 0"),
    ({"fps": float("nan")}, "--fps is nan"),
    ({"seconds": -1.0}, "--seconds is -1"),
    ({"fps": 240.0, "seconds": 1000.0}, "240,000 frames"),
    ({"size": 0}, "at least 1 pixel"),
    ({"size": 100, "width": 100}, "exclude each other"),
    ({"background": (0, 256, 0)}, "0 to 255"),
    ({"path": "a.json", "seconds": 3.0}, "--seconds has no effect"),
    ({"views": ("test",), "fps": 3.0}, "--fps has no effect"),
    ({"views": ("test",), "form": "mp4"}, "no video"),
    ({"views": ("test",), "width": 8, "height": 8}, "keep their shape"),
    ({"crf": 20}, "without --format mp4"),
    ({"codec": "av1"}, "without --format mp4"),
    ({"crf": 52, "form": "mp4"}, "0 to 51"),
    ({"crf": -1, "codec": "av1", "form": "mp4"}, "0 to 63"),
    ({"out": Path("a.mp4"), "form": "png"}, "format is png"),
    ({"out": Path("a.png"), "form": "mp4"}, "format is mp4"),
    ({"out": Path("a.mp4"), "outputs": ("rgb", "depth")}, "2 outputs"),
    ({"out": Path("a.png"), "outputs": ("depth",)}, "what its depth means"),
]


@pytest.mark.parametrize(("options", "said"), BAD)
def test_what_cannot_be_is_refused(options, said):
    with pytest.raises(ConfigError, match=said):
        Request(**options)


def test_a_file_that_ends_in_mp4_is_a_video():
    assert Request(out=Path("a.mp4")).video
    assert not Request(out=Path("folder")).video
    assert Request(form="mp4", out=Path("folder")).video
    assert Request(form="mp4", codec="av1").quality == ("av1", 28)
    assert Request(form="mp4", crf=7).quality == ("h264", 7)


@pytest.mark.parametrize(("options", "own", "expected"), [
    ({}, (601, 337), (601, 337)),
    ({"form": "mp4"}, (601, 337), (600, 336)),
    ({"size": 320}, (600, 338), (320, 180)),
    ({"size": 320}, (338, 600), (180, 320)),
    ({"width": 300}, (600, 337), (300, 168)),
    ({"height": 674}, (600, 337), (1200, 674)),
    ({"width": 300, "form": "mp4"}, (600, 333), (300, 166)),
    ({"width": 100, "height": 90}, (600, 337), (100, 90)),
    ({"size": 2, "form": "mp4"}, (1000, 10), (2, 2)),
])
def test_a_side_that_is_not_given_follows_and_is_even_in_a_video(options, own, expected):
    assert frame_size(*own, Request(**options)) == expected


@pytest.mark.parametrize("options", [{"width": 301}, {"height": 301}, {"size": 301}])
def test_an_odd_side_of_a_video_is_refused(options):
    with pytest.raises(ConfigError, match="301"):
        frame_size(600, 400, Request(form="mp4", **options))


def test_a_frame_that_does_not_fit_is_refused_with_the_memory_it_takes(monkeypatch):
    monkeypatch.setattr(images, "free_memory_bytes", lambda: 1_000_000_000)
    refuse_what_does_not_fit(1920, 1080)
    with pytest.raises(ConfigError, match=r"100000x56250 pixels takes about 562,500 MB.*1,000 MB"):
        refuse_what_does_not_fit(100_000, 56_250)


def test_a_side_beyond_all_formats_is_refused_however_much_memory_there_is(monkeypatch):
    monkeypatch.setattr(images, "free_memory_bytes", lambda: 1 << 60)
    with pytest.raises(ConfigError, match="65,536 pixels"):
        refuse_what_does_not_fit(100_000, 2)
