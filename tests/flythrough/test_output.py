"""Depth in whole steps and its colours, in closed form; videos by PyAV, read back by PyAV."""

import os

import av
import numpy as np
import pytest
import torch
from facts import assert_facts, raises
from prepared_workspace import wall

from recon_cli.errors import ConfigError, FormatError
from recon_cli.flythrough import output
from recon_cli.flythrough.output import (
    DepthScale,
    VideoEncoding,
    check_encoding,
    depth_colors,
    depth_scale,
    depth_steps,
    encode_video,
)
from recon_cli.io.images import read_image, write_png
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import joined

pytestmark = pytest.mark.floors

SCALE = DepthScale(True, 1e-3, 1.0, 3.0, (0.0, 0.0, 0.0), 50.0)


def steps(depth, alpha, step=1e-3):
    return int(depth_steps(np.array([[depth]], np.float32), np.array([[alpha]], np.float32),
                           step)[0, 0])


@pytest.mark.parametrize(("depth", "alpha", "expected"), [
    (2.0, 1.0, 2000),
    (1.5, 0.75, 2000),  # the sum of alpha T z over what is covered
    (0.98, 0.49, 0),  # more light passes than is stopped
    (0.0, 0.0, 0),
    (1e-5, 1.0, 1),  # there, so not 0
    (70.0, 1.0, 65_535),
])
def test_depth_is_the_mean_of_what_is_there_in_whole_steps(depth, alpha, expected):
    assert steps(depth, alpha) == expected


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_plane_of_gaussians_has_the_depth_that_it_has(backend):
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
    shown = render(wall(3.217, spacing=0.1, half=3.0), camera, torch.zeros(3), 0, backend=backend)
    found = depth_steps(shown.depth.numpy(), shown.alpha.numpy(), 1e-3)
    assert (found == 3217).all()


def test_what_lies_outside_the_windows_moves_no_depth():
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, np.eye(4))
    near, far = wall(3.217, spacing=0.1, half=3.0), wall(300.0, spacing=10.0, half=300.0)
    near.logit_opacities -= 7.0  # some light shines through
    both = joined([near, far])[0]
    kept = SCALE.select_surfaces(both)
    assert len(kept) == len(near)
    assert SCALE.select_surfaces(near) is near
    shown = render(both, camera, torch.zeros(3), 0, backend="torch")
    surfaces = render(kept, camera, torch.zeros(3), 0, backend="torch")
    assert (depth_steps(surfaces.depth.numpy(), surfaces.alpha.numpy(), 1e-3) == 3217).all()
    assert (depth_steps(shown.depth.numpy(), shown.alpha.numpy(), 1e-3) > 3300).any()


def test_colours_go_from_red_to_blue_and_nothing_is_black():
    red, middle, blue, nearer, nothing = depth_colors(
        np.array([[1000, 2000, 3000, 500, 0]], np.uint16), SCALE)[0].astype(int)
    assert red[0] > 100 > red[1:].max()
    assert middle[1] > middle[[0, 2]].max()
    assert blue[2] > 100 > blue[:2].max()
    np.testing.assert_array_equal(nearer, red)
    np.testing.assert_array_equal(nothing, 0)


def scene(points):
    def view(number, place):
        viewmat = np.eye(4)
        viewmat[:3, 3] = -np.array(place)
        camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0, viewmat)
        return View(f"{number}.png", camera, None, None)

    views = (view(0, [0.0, 0, 0]), view(1, [4.0, 0, 0]))
    return Scene(views, (), (), (), points, np.zeros(points.shape, np.uint8))


def test_a_step_is_a_millimetre_in_metres_and_else_a_thousandth_of_the_extent():
    there = scene(np.array([[0.0, 0, 2], [4, 0, 6]]))
    assert there.extent == pytest.approx(2.2)
    known, unknown = depth_scale(there, metres=True), depth_scale(there, metres=False)
    assert (known.step, unknown.step) == (1e-3, pytest.approx(2.2e-3))
    assert known.describe_pictures()["unit"] == "millimetre"
    assert_facts(unknown.describe_pictures()["unit"], "thousandth", "extent")
    assert unknown.describe_pictures()["world_units_per_step"] == unknown.step
    assert 1 <= known.near < 2 < known.far <= 6


def test_a_scene_without_points_in_sight_has_colours_too():
    nowhere = depth_scale(scene(np.array([[0.0, 0, -2]])), metres=True)
    assert 0 <= nowhere.near < nowhere.far


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Five smooth pictures of 64 x 48 pixels, of which each is brighter than the one before."""
    folder = tmp_path_factory.mktemp("pictures")
    y, x = np.mgrid[:48, :64]
    for number in range(5):
        image = np.stack([x * 2, y * 3, np.full_like(x, 40 * number)], axis=-1)
        write_png(folder / f"{number}.png", image.astype(np.uint8))
    return sorted(folder.glob("*.png"))


def make(pictures, path, codec="h264", crf=12, fps=25.0):
    seen = []
    encode_video(pictures, path, VideoEncoding(codec, crf, 64, 48, fps), threads=1,
           on_frame=lambda: seen.append(1))
    assert len(seen) == len(pictures)


@pytest.mark.parametrize(("codec", "decoded"), [("h264", "h264"), ("av1", "av1")])
def test_a_video_holds_every_picture_at_its_size_and_pace(pictures, tmp_path, codec, decoded):
    make(pictures, tmp_path / "a.mp4", codec, fps=29.97)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        frames = list(container.decode(stream))
        assert decoded in stream.codec_context.name or stream.codec_context.name == "libdav1d"
        assert float(stream.average_rate) == pytest.approx(29.97, abs=0.01)
        assert stream.codec_context.pix_fmt == "yuv420p"
    assert [(frame.width, frame.height) for frame in frames] == [(64, 48)] * 5
    for frame, path in zip(frames, pictures, strict=True):
        error = frame.to_ndarray(format="rgb24").astype(int) - read_image(path, 64, 48)
        assert np.abs(error).mean() < 3  # the colours of two by two pixels are one


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="Linux alone tells it")
@pytest.mark.parametrize("codec", ["h264", "av1"])
def test_an_encoder_leaves_the_scheduling_of_the_thread_as_it_was(pictures, tmp_path, codec):
    before = os.sched_getscheduler(0)
    check_encoding(VideoEncoding(codec, 12, 64, 48, 25.0))
    assert os.sched_getscheduler(0) == before
    make(pictures, tmp_path / "a.mp4", codec)
    assert os.sched_getscheduler(0) == before


def test_colours_are_stored_as_bt709_and_said_to_be(tmp_path):
    write_png(tmp_path / "green.png", np.full((48, 64, 3), [30, 200, 60], np.uint8))
    make([tmp_path / "green.png"], tmp_path / "a.mp4")
    with av.open(str(tmp_path / "a.mp4")) as container:
        frame = next(container.decode(video=0))
    assert (frame.colorspace, frame.color_range) == (1, 1)  # BT.709, limited
    luma = frame.to_ndarray()[:48].mean()
    # ITU-R BT.709: Y = 16 + 219 (0.2126 R + 0.7152 G + 0.0722 B)
    assert luma == pytest.approx(
        16 + 219 * (0.2126 * 30 + 0.7152 * 200 + 0.0722 * 60) / 255, abs=1)


def test_gray_pictures_become_a_video_too(tmp_path):
    write_png(tmp_path / "alpha.png", np.full((48, 64), 77, np.uint8))
    make([tmp_path / "alpha.png"], tmp_path / "a.mp4")
    with av.open(str(tmp_path / "a.mp4")) as container:
        found = next(container.decode(video=0)).to_ndarray(format="rgb24").astype(int)
    assert np.abs(found - 77).max() <= 3


def test_a_smaller_crf_is_closer(pictures, tmp_path):
    sizes = []
    for crf in (5, 45):
        make(pictures, tmp_path / f"{crf}.mp4", crf=crf)
        sizes.append((tmp_path / f"{crf}.mp4").stat().st_size)
    assert sizes[0] > sizes[1]


def test_a_codec_that_this_build_lacks_is_refused(monkeypatch):
    monkeypatch.setitem(output.ENCODERS, "h264", ("libnone",))
    with raises(ConfigError, "h264") as caught:
        check_encoding(VideoEncoding("h264", 18, 64, 48, 30))
    assert "av1" in caught.value.hint


@pytest.mark.parametrize("codec", ["h264", "av1"])
def test_a_size_that_no_encoder_takes_is_refused(codec):
    with raises(ConfigError, "40000x48"):
        check_encoding(VideoEncoding(codec, 18, 40_000, 48, 30))


def test_a_picture_that_is_gone_leaves_no_video_and_the_old_one_stays(pictures, tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"the old one")
    with pytest.raises(FormatError):
        make([*pictures, tmp_path / "none.png"], tmp_path / "a.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"the old one"
