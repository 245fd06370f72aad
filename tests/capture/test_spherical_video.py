"""360-degree videos are told by their boxes or by what they show; unstitched ones are refused."""

import struct

import av
import numpy as np
import pytest
from facts import raises
from media import texture
from media import write_video as write_one
from test_panoramas import sphere
from test_two_views import both_eyes, two_circles, view

from recon_cli.capture.scan import scan_video
from recon_cli.capture.spherical_video import is_spherical, read_projection, refuse_unusable
from recon_cli.capture.video import decode
from recon_cli.errors import InputError


def write_video(path, pictures, *, tracks=1):
    """Writes pictures as one or several tracks of a video."""
    with av.open(str(path), "w", format="mp4") as container:
        height, width = pictures[0].shape[:2]
        streams = []
        for _ in range(tracks):
            stream = container.add_stream("libx264", rate=10)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.options = {"crf": "8"}
            streams.append(stream)
        for picture in pictures:
            for stream in streams:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
        for stream in streams:
            container.mux(stream.encode(None))
    return path


def box(name, content):
    return struct.pack(">I4s", 8 + len(content), name) + content


def with_metadata(path, *, stereo=0, projection=b"equi"):
    """Appends the boxes of Spherical Video V2 to the sample entry of a video."""
    proj = box(b"prhd", bytes(16)) + box(projection, bytes(20))
    boxes = box(b"st3d", bytes(4) + bytes([stereo])) + (box(b"sv3d", box(
        b"svhd", bytes(5)) + box(b"proj", proj)) if projection else b"")
    data = bytearray(path.read_bytes())
    end = 0
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"stsd", b"avc1"):
        at = data.index(name, data.rindex(b"moov")) - 4
        size, = struct.unpack_from(">I", data, at)
        struct.pack_into(">I", data, at, size + len(boxes))
        end = at + size
    data[end:end] = boxes
    path.write_bytes(data)
    return path


@pytest.fixture
def plain(tmp_path):
    rng = np.random.default_rng(0)
    return write_video(tmp_path / "plain.mp4", [
        rng.integers(0, 256, (64, 128, 3), np.uint8) for _ in range(5)])


def test_metadata_tell_the_projection(plain):
    assert read_projection(plain) == ""
    assert not is_spherical(plain, 128, 64, 5, "auto")
    with_metadata(plain)
    assert read_projection(plain) == "equirectangular"
    assert is_spherical(plain, 128, 64, 5, "auto")
    assert not is_spherical(plain, 128, 64, 5, "perspective")


@pytest.mark.integration
def test_a_video_that_wraps_around_is_spherical(tmp_path):
    path = write_video(
        tmp_path / "walk.mp4", [sphere(0.02 * index) for index in range(130)])
    assert is_spherical(path, 256, 128, 130, "auto")


def test_what_was_asked_for_must_be_twice_as_wide_as_high(plain):
    assert is_spherical(plain, 128, 64, 5, "equirectangular")
    with raises(InputError, "wide", "high"):
        is_spherical(plain, 128, 96, 5, "equirectangular")


def test_other_projections_are_refused(plain):
    with raises(InputError, "projection", "cubemap"):
        is_spherical(with_metadata(plain, projection=b"cbmp"), 128, 64, 5, "auto")


def test_of_a_panorama_for_each_eye_the_first_is_used(tmp_path):
    path = write_video(tmp_path / "a.mp4", [np.concatenate([
        np.full((64, 128, 3), 200, np.uint8), np.full((64, 128, 3), 50, np.uint8)])] * 5)
    with_metadata(path, stereo=1)
    picture = next(decode(path, threads=1))
    assert picture.size == (128, 64)
    assert abs(float(picture.rgb().mean()) - 200) < 4
    assert is_spherical(path, 128, 64, 5, "auto")


def write_matroska(path, pictures, **metadata):
    """Writes a Matroska file whose track has these tags of FFmpeg's muxer."""
    with av.open(str(path), "w", format="matroska") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.options = "yuv420p", {"crf": "8"}
        stream.metadata.update(metadata)
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(
                np.ascontiguousarray(picture), "rgb24")))
        container.mux(stream.encode(None))
    return path


def element(name, content):
    return name + (0x10000000 | len(content)).to_bytes(4, "big") + content


def test_a_projection_in_matroska_counts(tmp_path):
    path = write_matroska(
        tmp_path / "a.mkv", [texture(64, 128, seed=seed) for seed in range(5)])
    data = path.read_bytes()
    # RFC 9559: Projection in Video, with ProjectionType 1, in place of the padding (Void) before.
    projection = element(b"\x76\x70", b"\x76\x71\x81\x01")
    path.write_bytes(into_track_video(data, projection))
    assert read_projection(path) == "equirectangular"
    assert is_spherical(path, 128, 64, 5, "auto")


def into_track_video(data, content):
    """Returns a Matroska file with an element more in the Video of its first track."""
    spans, at, end = [], 0, len(data)
    for name in (b"\x18\x53\x80\x67", b"\x16\x54\xae\x6b", b"\xae", b"\xe0"):
        while not data[at:].startswith(name):
            at += id_length(data[at]) + sum(read_size(data, at + id_length(data[at])))
            assert at < end
        digits, size = read_size(data, at + len(name))
        spans.append((at + len(name), digits))
        at += len(name) + digits
    body = bytearray(data)
    for where, digits in spans:
        _, size = read_size(data, where)
        if size != (1 << 7 * digits) - 1:  # not: of unknown size
            body[where:where + digits] = (
                (1 << 7 * digits) | size + len(content)).to_bytes(digits, "big")
    body[at:at] = content
    return bytes(body)


def id_length(first):
    return 9 - first.bit_length()


def read_size(data, at):
    """Returns how many bytes an element's size takes, and the size."""
    digits = 9 - data[at].bit_length()
    return digits, int.from_bytes(data[at:at + digits], "big") & (1 << 7 * digits) - 1


def eyes(left, right, axis):
    """Returns frames of two plain views, of the left eye first."""
    return [np.concatenate([
        np.full((96, 160, 3), value, np.uint8) for value in (left, right)], axis)] * 4


@pytest.mark.parametrize(("packing", "axis"), [(3, 1), (4, 0)])
def test_frame_packing_in_the_stream_gives_the_left_view(tmp_path, packing, axis):
    path = write_one(tmp_path / "a.mp4", eyes(200, 50, axis), options={
        "qp": "4", "x264-params": f"frame-packing={packing}"})
    picture = next(decode(path, threads=1))
    assert picture.size == (160, 96)
    assert abs(float(picture.rgb().mean()) - 200) < 4
    assert abs(float(picture.gray().mean()) - 200) < 4
    scan = scan_video(path, threads=1, step=lambda: None)
    assert (scan.width, scan.height) == (160, 96)
    assert "left" in scan.notices[0]
    refuse_unusable(path, "auto")


@pytest.mark.parametrize(("mode", "axis", "first"), [
    ("left_right", 1, True), ("right_left", 1, False), ("top_bottom", 0, True),
    ("bottom_top", 0, False)])
def test_the_stereo_mode_of_matroska_gives_the_left_view(tmp_path, mode, axis, first):
    path = write_matroska(tmp_path / "a.mkv", eyes(200, 50, axis), stereo_mode=mode)
    picture = next(decode(path, threads=1))
    assert picture.size == (160, 96)
    assert abs(float(picture.rgb().mean()) - (200 if first else 50)) < 4


def test_views_that_were_squeezed_get_their_width_back(tmp_path):
    squeezed = [frame[:, ::2] for frame in eyes(200, 50, 1)]
    path = write_one(tmp_path / "a.mp4", squeezed, options={
        "qp": "4", "x264-params": "frame-packing=3"})
    assert next(decode(path, threads=1)).size == (160, 96)


def test_views_that_are_woven_together_are_refused(tmp_path):
    path = write_one(tmp_path / "a.mp4", eyes(200, 50, 1), options={
        "qp": "4", "x264-params": "frame-packing=2"})
    with raises(InputError, "rows"):
        next(decode(path, threads=1))


@pytest.mark.integration
def test_two_views_without_a_tag_are_refused_with_the_way_to_cut_one_out(tmp_path):
    path = write_one(tmp_path / "a.mp4", [both_eyes(seed) for seed in range(6)])
    with raises(InputError, "view") as error:
        refuse_unusable(path, "auto")
    assert "crop=iw/2:ih:0:0" in error.value.hint
    refuse_unusable(path, "perspective")


@pytest.mark.integration
def test_two_circles_are_refused(tmp_path):
    path = write_one(tmp_path / "a.mp4", [two_circles(seed) for seed in range(6)])
    with raises(InputError, "fisheye", "lenses"):
        refuse_unusable(path, "auto")


@pytest.mark.integration
def test_frames_of_one_view_are_not_refused(tmp_path):
    refuse_unusable(
        write_one(tmp_path / "a.mp4", [view(seed, width=640) for seed in range(6)]), "auto")


@pytest.mark.parametrize(("name", "tracks", "app"), [
    ("a.insv", 2, "Insta360 Studio"), ("a.360", 2, "GoPro Player"), ("a.osv", 2, "DJI Studio"),
    ("a.insv", 1, "Insta360 Studio"), ("a.mp4", 2, "the app of the camera")])
def test_two_fisheyes_are_refused_with_the_way_to_stitch_them(tmp_path, name, tracks, app):
    path = write_video(
        tmp_path / name, [np.full((64, 64, 3), 9 * k, np.uint8) for k in range(4)], tracks=tracks)
    with raises(InputError, "fisheye", "lenses") as error:
        refuse_unusable(path, "auto")
    assert app in error.value.hint


def test_an_ordinary_video_is_not_refused(plain, tmp_path):
    refuse_unusable(plain, "auto")
    both = write_video(  # such as a phone's of its two cameras
        tmp_path / "both.mp4", [np.full((48, 64, 3), k, np.uint8) for k in range(4)], tracks=2)
    refuse_unusable(both, "auto")
