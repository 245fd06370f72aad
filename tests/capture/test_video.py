"""Video files: which can be read, their length, their frames, and what the container says."""

import av
import numpy as np
import pytest
from av.stream import Disposition
from facts import assert_facts, raises
from media import set_display_matrix, texture, write_sound, write_video
from PIL import Image

from recon_cli.capture.decoded_picture import DecodedPicture, LostPacket
from recon_cli.capture.video import (
    codec_name,
    decode,
    frames_at,
    lacks_index,
    open_video,
    read_declared_length,
)
from recon_cli.errors import InputError

pytestmark = pytest.mark.floors

# Two roundings (to YUV and back) of 8-bit values, and a little loss of the codec.
COLOUR_TOLERANCE = 4
BT709, BT601, LIMITED, FULL = 1, 5, 1, 2

COLOURS = ((255, 0, 0), (0, 200, 30), (20, 40, 220), (240, 240, 240))  # by quadrant


def quadrants(height=64, width=96):
    picture = np.zeros((height, width, 3), np.uint8)
    picture[: height // 2, : width // 2] = COLOURS[0]
    picture[: height // 2, width // 2:] = COLOURS[1]
    picture[height // 2:, : width // 2] = COLOURS[2]
    picture[height // 2:, width // 2:] = COLOURS[3]
    return picture


def centres(picture):
    height, width = picture.shape[:2]
    rows, columns = (height // 4, 3 * height // 4), (width // 4, 3 * width // 4)
    return np.array([picture[y, x] for y in rows for x in columns], int)


def first_frame(path):
    return next(f for f in decode(path, threads=1) if isinstance(f, DecodedPicture))


# The matrices that cameras write: the picture has to be turned clockwise by so much to be upright.
@pytest.mark.parametrize(("clockwise", "matrix"), [
    (0, (65536, 0, 0, 0, 65536, 0)),
    (1, (0, 65536, 0, -65536, 0, 0)),
    (2, (-65536, 0, 0, 0, -65536, 0)),
    (3, (0, -65536, 0, 65536, 0, 0)),
])
def test_a_tagged_rotation_is_applied(tmp_path, clockwise, matrix):
    path = write_video(tmp_path / "phone.mp4", [quadrants()] * 3)
    set_display_matrix(path, (*matrix, 0, 0, 1 << 30))
    picture = first_frame(path)
    upright = np.rot90(quadrants(), -clockwise)
    rgb = picture.rgb()
    assert rgb.shape == upright.shape
    assert np.abs(centres(rgb) - centres(upright)).max() <= COLOUR_TOLERANCE
    assert picture.gray().shape == upright.shape[:2]
    assert picture.size == upright.shape[1::-1]


@pytest.mark.parametrize(("codec", "pixels", "colorspace", "color_range"), [
    ("libx264", "yuv420p", None, None),
    ("libx264", "yuv420p", BT709, LIMITED),
    ("libx264", "yuv420p", BT709, FULL),
    ("libx264", "yuv420p", BT601, LIMITED),
    ("libx264", "yuv420p", BT601, FULL),
    ("libx264", "yuv420p10le", BT709, LIMITED),
    ("ffv1", "yuv444p", None, None),
    ("mpeg4", "yuv420p", None, None),
])
def test_colours_come_out_as_they_went_in(tmp_path, codec, pixels, colorspace, color_range):
    path = write_video(
        tmp_path / "video.mkv", [quadrants()] * 3, codec=codec, pixels=pixels,
        colorspace=colorspace, color_range=color_range)
    rgb = first_frame(path).rgb()
    assert rgb.dtype == np.uint8
    assert np.abs(centres(rgb) - COLOURS).max() <= COLOUR_TOLERANCE


def test_untagged_video_of_high_definition_is_taken_as_bt709(tmp_path):
    tagged = write_video(
        tmp_path / "tagged.mkv", [quadrants(720, 1280)], codec="ffv1", colorspace=BT709,
        color_range=LIMITED)
    picture = first_frame(tagged)
    picture.frame.colorspace = 2  # unspecified
    assert np.abs(centres(picture.rgb()) - COLOURS).max() <= COLOUR_TOLERANCE


@pytest.mark.parametrize("name", ["YCgCo", "ICtCp"])
def test_a_colour_matrix_that_cannot_be_converted_is_named(tmp_path, name):
    path = write_video(
        tmp_path / "a.mkv", [quadrants()] * 3, colorspace=BT709, color_range=LIMITED,
        options={"qp": "4", "x264-params": f"colormatrix={name}"})
    with raises(InputError, "a.mkv", name) as told:
        list(decode(path, threads=1))
    assert_facts(told.value.hint, path, "zscale=matrix=709")


def test_gray_uses_the_full_range(tmp_path):
    path = write_video(tmp_path / "video.mp4", [np.full((64, 96, 3), 255, np.uint8)] * 3)
    assert first_frame(path).gray().min() >= 255 - COLOUR_TOLERANCE


@pytest.mark.parametrize("name", ["text.mp4", "text.txt"])
def test_text_is_no_video_whatever_its_name(tmp_path, name):
    path = tmp_path / name
    path.write_text("no frames in here\n" * 100)
    with raises(InputError, name, "video"):
        read_declared_length(path)


def test_a_video_without_frames_is_refused(tmp_path):
    with av.open(str(tmp_path / "empty.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width, stream.pix_fmt = 64, 64, "yuv420p"
        container.start_encoding()
    with raises(InputError, "video", "decoded"):
        read_declared_length(tmp_path / "empty.mp4")


def test_sound_is_no_video(tmp_path):
    with raises(InputError, "video", "decoded"):
        read_declared_length(write_sound(tmp_path / "sound.mp4"))


def test_an_empty_file_is_named_as_such(tmp_path):
    (tmp_path / "empty.mp4").touch()
    with raises(InputError, "empty"):
        read_declared_length(tmp_path / "empty.mp4")


def test_a_missing_file_is_named_as_such(tmp_path):
    with raises(InputError):
        read_declared_length(tmp_path / "none.mp4")


def test_a_single_picture_is_refused_even_if_named_like_a_video(tmp_path):
    Image.fromarray(quadrants()).save(tmp_path / "a.jpg")
    (tmp_path / "a.jpg").rename(tmp_path / "a.mp4")
    with raises(InputError, "single", "picture"):
        read_declared_length(tmp_path / "a.mp4")


def test_a_video_is_known_by_its_content_not_by_its_name(tmp_path):
    path = write_video(tmp_path / "video.mp4", [quadrants()] * 5)
    path = path.rename(tmp_path / "room: take 1.txt")
    assert read_declared_length(path).frames == 5
    with open_video(path) as (_, stream):
        assert stream.width == 96


def test_the_count_is_taken_from_the_duration_where_the_container_names_none(tmp_path):
    path = write_video(tmp_path / "video.mkv", [quadrants()] * 12)
    claim = read_declared_length(path)
    assert claim.frames == 0
    assert claim.count(claim.rate) == 12


@pytest.mark.parametrize("threads", [1, 3])
def test_every_frame_is_decoded_once_and_in_order(tmp_path, threads):
    shades = [np.full((64, 96, 3), 10 * i + 20, np.uint8) for i in range(20)]
    path = write_video(tmp_path / "video.mp4", shades)
    seen = [int(np.median(frame.rgb())) for frame in decode(path, threads=threads)]
    np.testing.assert_allclose(seen, [10 * i + 20 for i in range(20)], atol=COLOUR_TOLERANCE)


def test_frames_are_found_again_by_their_index(tmp_path):
    shades = [np.full((64, 96, 3), 10 * i + 20, np.uint8) for i in range(20)]
    path = write_video(tmp_path / "video.mp4", shades)
    found = {index: int(np.median(rgb)) for index, rgb in frames_at(path, [3, 11], threads=2)}
    assert found == {
        3: pytest.approx(50, abs=COLOUR_TOLERANCE), 11: pytest.approx(130, abs=COLOUR_TOLERANCE)}
    assert list(frames_at(path, [], threads=1)) == []


def test_a_frame_that_is_gone_on_the_second_reading_is_an_error(tmp_path):
    path = write_video(tmp_path / "video.mp4", [quadrants()] * 5)
    with raises(InputError, 9, "ended"):
        list(frames_at(path, [2, 9], threads=1))


def test_frames_that_change_their_size_midway_count_as_lost(tmp_path):
    parts = [
        write_video(tmp_path / f"{width}.h264", [texture(64, width)] * 6, muxer="h264")
        for width in (96, 128)
    ]
    path = tmp_path / "both.h264"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    items = list(decode(path, threads=1))
    assert {item.size[0] for item in items if isinstance(item, DecodedPicture)} == {96}
    assert any(isinstance(item, LostPacket) for item in items)


def mixed(path, *, cover):
    """A video of 96x64 behind a sound track and, first in the file, the cover of a song."""
    with av.open(str(path), "w") as container:
        if cover:
            picture = container.add_stream("mjpeg", rate=1)
            picture.width, picture.height, picture.pix_fmt = 32, 32, "yuvj420p"
            picture.disposition = Disposition.attached_pic
        sound = container.add_stream("aac", rate=16000, layout="mono")
        video = container.add_stream("libx264", rate=10)
        video.width, video.height, video.pix_fmt = 96, 64, "yuv420p"
        if cover:
            frame = av.VideoFrame.from_ndarray(quadrants(32, 32)).reformat(format="yuvj420p")
            container.mux([*picture.encode(frame), *picture.encode()])
        for _ in range(8):
            container.mux(video.encode(av.VideoFrame.from_ndarray(quadrants())))
        samples = av.AudioFrame.from_ndarray(
            np.zeros((1, 16000), np.float32), format="fltp", layout="mono")
        samples.sample_rate = 16000
        container.mux([*video.encode(), *sound.encode(samples), *sound.encode()])
    return path


@pytest.mark.parametrize(("name", "cover"), [("a.mp4", False), ("a.mkv", False), ("c.mp4", True)])
def test_sound_and_covers_are_passed_over(tmp_path, name, cover):
    path = mixed(tmp_path / name, cover=cover)
    with av.open(str(path)) as container:
        assert len(container.streams) == (3 if cover else 2)
    items = list(decode(path, threads=2))
    assert [item.size for item in items] == [(96, 64)] * 8
    assert np.abs(centres(items[3].rgb()) - COLOURS).max() <= 2 * COLOUR_TOLERANCE


@pytest.mark.parametrize(("fourcc", "name"), [(b"evc1", "EVC"), (b"zzzz", "zzzz")])
def test_a_codec_without_a_decoder_is_named_and_how_to_convert_it(tmp_path, fourcc, name):
    path = write_video(tmp_path / "new.mp4", [texture(64, 96)] * 5)
    # EVC is known to FFmpeg, but none of its own decoders reads it; zzzz is known to nobody.
    path.write_bytes(path.read_bytes().replace(b"avc1", fourcc).replace(b"avcC", b"free"))
    with raises(InputError, name, "decoded") as told:
        list(decode(path, threads=1))
    assert_facts(told.value.hint, path, "libx264")


def test_noise_is_no_video(tmp_path):
    path = tmp_path / "noise.mp4"
    path.write_bytes(np.random.default_rng(0).bytes(20000))
    with raises(InputError, "video"):
        read_declared_length(path)


@pytest.mark.parametrize("faststart", [False, True])
def test_an_mp4_whose_index_is_cut_off_is_named_as_such(tmp_path, faststart):
    path = mixed(tmp_path / "whole.mp4", cover=False)
    data = path.read_bytes()
    if faststart:  # the index before the frames, as files for the web have it
        at = data.index(b"moov") - 4
        head = data.index(b"mdat") - 12  # an empty box lies in front of it
        data = data[:head] + data[at:] + data[head:at]
    for kept in (data.index(b"moov") + 10, data.index(b"moov") + 300):
        path.write_bytes(data[:kept])
        with raises(InputError, "truncated", "index") as told:
            read_declared_length(path)
        assert_facts(told.value.hint, "camera", "again")


@pytest.fixture(scope="module")
def mp4(tmp_path_factory):
    return write_video(tmp_path_factory.mktemp("mp4") / "a.mp4", [texture(64, 96)] * 5).read_bytes()


@pytest.mark.parametrize(("fourcc", "name"), [
    (b"avc1", "avc1"), (b"av01", "AV1"), (b"hvc1", "HEVC"), (b"dvh1", "HEVC"), (b"xy z", "xy z")])
def test_an_mp4_names_its_codec_by_four_letters(tmp_path, mp4, fourcc, name):
    path = tmp_path / "a.mp4"
    path.write_bytes(mp4.replace(b"avc1", fourcc))
    assert codec_name(path) == name


@pytest.mark.parametrize(("suffix", "codec", "name"), [
    (".mkv", "libx264", "V_MPEG4/ISO/AVC"), (".avi", "mpeg4", "FMP4"), (".ts", "libx264", "")])
def test_other_containers_name_it_in_their_own_way_or_not_at_all(tmp_path, suffix, codec, name):
    path = write_video(tmp_path / f"a{suffix}", [texture(64, 96)] * 5, codec=codec)
    assert codec_name(path) == name


def test_an_mp4_has_its_index_until_a_byte_of_it_is_missing(tmp_path, mp4):
    path = tmp_path / "a.mp4"
    end = mp4.index(b"moov") - 4 + int.from_bytes(mp4[mp4.index(b"moov") - 4:][:4])
    for length, lacking in ((end, False), (end - 1, True), (len(mp4) // 2, True), (9, True)):
        path.write_bytes(mp4[:length])
        assert lacks_index(path) is lacking, length


@pytest.mark.parametrize("content", [b"", b"text\n" * 50, bytes(5000), b"RIFF\0\0\0\0AVI LIST"])
def test_what_is_no_mp4_lacks_no_index(tmp_path, content):
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    assert lacks_index(path) is False


def test_a_length_of_64_bits_and_one_to_the_end_are_understood(tmp_path):
    path = tmp_path / "a.mp4"
    long = (1).to_bytes(4) + b"mdat" + (100).to_bytes(8) + bytes(84)
    path.write_bytes(long + bytes(4) + b"moov" + bytes(20))
    assert lacks_index(path) is False
    path.write_bytes(long + (200).to_bytes(4) + b"moov" + bytes(20))
    assert lacks_index(path) is True
