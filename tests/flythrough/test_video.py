"""Videos by PyAV, read back by PyAV."""

import os

import av
import numpy as np
import pytest

from recon_cli.errors import ConfigError, FormatError
from recon_cli.flythrough import output
from recon_cli.flythrough.output import VideoEncoding, check_encoding, encode_video
from recon_cli.io.images import read_image, write_png


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
    with pytest.raises(ConfigError, match=r"cannot encode h264: it lacks libnone") as caught:
        check_encoding(VideoEncoding("h264", 18, 64, 48, 30))
    assert "av1" in caught.value.hint


@pytest.mark.parametrize("codec", ["h264", "av1"])
def test_a_size_that_no_encoder_takes_is_refused(codec):
    with pytest.raises(ConfigError, match="40000x48 pixels"):
        check_encoding(VideoEncoding(codec, 18, 40_000, 48, 30))


def test_a_picture_that_is_gone_leaves_no_video_and_the_old_one_stays(pictures, tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"the old one")
    with pytest.raises(FormatError):
        make([*pictures, tmp_path / "none.png"], tmp_path / "a.mp4")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"the old one"
