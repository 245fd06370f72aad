"""`recon render` in process: videos, and files that are asked for by name."""


import av
import numpy as np
import pytest
from facts import assert_facts
from PIL import Image
from render_cli import SHORT, render

from recon_cli.cli import main
from recon_cli.io.images import read_image


def decoded(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_a_video_shows_the_frames_which_stay_beside_it(before_a_wall, tmp_path):
    out = tmp_path / "out"
    assert render(before_a_wall, *SHORT, "--size", "96", "--format", "mp4", "--crf", "8",
                  "--output", "rgb,depth,alpha", "--out", out) == 0
    for video, kind in (("rgb", "rgb"), ("depth", "depth_color"), ("alpha", "alpha")):
        frames = decoded(out / f"{video}.mp4")
        assert [frame.shape for frame in frames] == [(72, 96, 3)] * 4
        first = read_image(out / kind / "00000.png", 96, 72).astype(int)
        assert np.abs(frames[0] - first).mean() < 3


def test_a_file_gives_size_and_pace_unless_asked_otherwise(room, tmp_path):
    assert render(room, "--path", "orbit", "--fps", "8", "--seconds", "0.5", "--width", "40",
                  "--height", "50", "--out", tmp_path / "first") == 0
    path = tmp_path / "first" / "camera_path.json"
    for words, size, fps in (([], (40, 50), 8), (["--fps", "2", "--size", "100"], (80, 100), 2)):
        assert render(room, "--path", path, "--format", "mp4", *words,
                      "--out", tmp_path / str(fps)) == 0
        with av.open(str(tmp_path / str(fps) / "rgb.mp4")) as container:
            stream = container.streams.video[0]
            assert (stream.width, stream.height, stream.average_rate) == (*size, fps)


def test_a_video_is_made_again_only_where_it_is_another(room, tmp_path, capsys):
    words = ["--path", "orbit", *SHORT, "--format", "mp4", "--out", tmp_path / "out"]
    assert render(room, *words) == 0
    video = tmp_path / "out" / "rgb.mp4"
    first = video.stat().st_mtime_ns
    assert render(room, *words) == 0
    assert video.stat().st_mtime_ns == first
    capsys.readouterr()
    assert render(room, *words, "--crf", "40") == 0
    assert_facts(capsys.readouterr().out, 0, "rendered")
    assert video.stat().st_mtime_ns != first
    second = video.stat().st_mtime_ns
    (tmp_path / "out" / "rgb" / "00002.png").unlink()
    assert render(room, *words, "--crf", "40") == 0
    assert video.stat().st_mtime_ns != second


def test_one_video_or_picture_goes_where_a_file_is_named(copied, tmp_path, capsys):
    assert render(copied, *SHORT, "--out", tmp_path / "new" / "walk.mp4") == 0
    assert len(decoded(tmp_path / "new" / "walk.mp4")) == 4
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "new" / "walk.mp4")
    assert render(copied, "--views", "000001", "--out", tmp_path / "one.png") == 0
    assert (tmp_path / "one.png").read_bytes() == (
        copied / "render" / "views_000001-rgb" / "rgb" / "000001.png").read_bytes()
    assert render(copied, *SHORT, "--out", tmp_path / "two.png") == 2
    assert "4 frames" in capsys.readouterr().err


@pytest.mark.parametrize(("form", "codec"), [("webm", ("libdav1d", "av1")), ("mov", ("h264",)),
                                             ("gif", ("gif",))])
def test_a_video_is_of_the_kind_that_its_name_says(room, tmp_path, form, codec):
    file = tmp_path / f"walk.{form}"
    assert render(room, *SHORT, "--size", "96", "--out", file) == 0
    with av.open(str(file)) as container:
        assert container.streams.video[0].codec_context.name in codec
        assert form in container.format.name
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    stills = sorted((room / "render").glob("*/rgb/*.png"))[:4]
    assert len(frames) == len(stills) == 4
    first = read_image(stills[0], frames[0].shape[1], frames[0].shape[0]).astype(int)
    assert np.abs(frames[0] - first).mean() < 6


def test_a_view_is_a_picture_of_the_kind_that_its_name_says(room, tmp_path):
    for name, kind in (("a.jpg", "JPEG"), ("b.webp", "WEBP")):
        assert render(room, "--views", "000001", "--out", tmp_path / name) == 0
        with Image.open(tmp_path / name) as picture:
            assert picture.format == kind


def test_frames_that_stay_are_named_with_their_size_and_can_be_cleaned(copied, tmp_path, capsys):
    assert render(copied, *SHORT, "--out", tmp_path / "walk.mp4") == 0
    assert f"`recon clean --renders -w {copied}`" in capsys.readouterr().err
    assert main(["status", "-w", str(copied)]) == 0
    folder = copied / "render" / "training-rgb"
    assert "render/training-rgb" in capsys.readouterr().err
    assert main(["clean", "-w", str(copied)]) == 0
    assert "`recon clean --renders" in capsys.readouterr().err
    assert folder.exists()
    assert main(["clean", "--renders", "-w", str(copied)]) == 0
    assert "render/training-rgb: " in capsys.readouterr().out
    assert not folder.exists()
    assert (tmp_path / "walk.mp4").exists()
    assert main(["clean", "train", "--renders", "-w", str(copied)]) == 2
