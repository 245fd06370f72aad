"""360-degree videos are told by their boxes or by what they show; unstitched ones are refused."""

import struct

import av
import numpy as np
import pytest
from test_panoramas import sphere

from recon_cli.capture.spherical_video import is_spherical, read_projection, refuse_unstitched
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
    """Appends the boxes of Spherical Video V2 to the index of a video, as a box of its own."""
    proj = box(b"prhd", bytes(16)) + box(projection, bytes(20))
    boxes = box(b"st3d", bytes(4) + bytes([stereo])) + box(b"sv3d", box(
        b"svhd", bytes(5)) + box(b"proj", proj))
    data = path.read_bytes()
    at = data.rindex(b"moov") - 4
    size = struct.unpack_from(">I", data, at)[0]
    index = data[at + 8:at + size] + box(b"udta", boxes)
    path.write_bytes(data[:at] + box(b"moov", index) + data[at + size:])
    return path


@pytest.fixture
def plain(tmp_path):
    rng = np.random.default_rng(0)
    return write_video(tmp_path / "plain.mp4", [
        rng.integers(0, 256, (64, 128, 3), np.uint8) for _ in range(5)])


def test_metadata_tell_the_projection(plain):
    assert read_projection(plain) == ("", False)
    assert not is_spherical(plain, 128, 64, 5, "auto")
    with_metadata(plain)
    assert read_projection(plain) == ("equirectangular", False)
    assert is_spherical(plain, 128, 64, 5, "auto")
    assert not is_spherical(plain, 128, 64, 5, "perspective")


def test_a_video_that_wraps_around_is_spherical(tmp_path):
    path = write_video(
        tmp_path / "walk.mp4", [sphere(0.02 * index) for index in range(130)])
    assert is_spherical(path, 256, 128, 130, "auto")


def test_what_was_asked_for_must_be_twice_as_wide_as_high(plain):
    assert is_spherical(plain, 128, 64, 5, "equirectangular")
    with pytest.raises(InputError, match="twice as wide as high"):
        is_spherical(plain, 128, 96, 5, "equirectangular")


def test_a_panorama_for_each_eye_and_other_projections_are_refused(plain, tmp_path):
    other = tmp_path / "other.mp4"
    other.write_bytes(plain.read_bytes())
    with pytest.raises(InputError, match="for each eye") as error:
        is_spherical(with_metadata(plain, stereo=1), 128, 64, 5, "auto")
    assert "crop=iw:ih/2" in error.value.hint
    with pytest.raises(InputError, match="projection cubemap"):
        is_spherical(with_metadata(other, projection=b"cbmp"), 128, 64, 5, "auto")


@pytest.mark.parametrize(("name", "tracks", "app"), [
    ("a.insv", 2, "Insta360 Studio"), ("a.360", 2, "GoPro Player"), ("a.osv", 2, "DJI Studio"),
    ("a.insv", 1, "Insta360 Studio"), ("a.mp4", 2, "the app of the camera")])
def test_two_fisheyes_are_refused_with_the_way_to_stitch_them(tmp_path, name, tracks, app):
    path = write_video(
        tmp_path / name, [np.full((64, 64, 3), 9 * k, np.uint8) for k in range(4)], tracks=tracks)
    with pytest.raises(InputError, match="two fisheye lenses") as error:
        refuse_unstitched(path)
    assert app in error.value.hint


def test_an_ordinary_video_is_not_refused(plain, tmp_path):
    refuse_unstitched(plain)
    refuse_unstitched(write_video(  # such as a phone's of its two cameras
        tmp_path / "both.mp4", [np.full((48, 64, 3), k, np.uint8) for k in range(4)], tracks=2))
