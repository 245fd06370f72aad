from fractions import Fraction

import av
import numpy as np
from media import texture, write_luma, write_video

from recon_cli.capture.scan import scan_video

HLG, PQ, BT2020 = 18, 16, 9


def notices(path):
    return scan_video(path, threads=1, step=lambda: None).notices


def test_plain_video_gives_no_notice(tmp_path):
    assert notices(write_video(tmp_path / "plain.mp4", [texture(64, 96)] * 5)) == ()


def test_hdr_is_named_with_its_kind(tmp_path):
    luma = np.full((64, 96), 500)
    for name, trc in (("HLG", HLG), ("PQ", PQ)):
        path = write_luma(
            tmp_path / f"{name}.mp4", [luma] * 3, trc=trc, primaries=BT2020, colorspace=BT2020)
        assert notices(path) == (
            f"{name}.mp4 is {name} video: tone-mapped to SDR by one curve.",)


def test_ten_bits_of_sdr_give_no_notice(tmp_path):
    assert notices(write_luma(tmp_path / "ten.mp4", [np.full((64, 96), 500)] * 3)) == ()


def test_stretched_pixels_are_named_with_both_sizes(tmp_path):
    path = write_video(tmp_path / "dv.mp4", [texture(64, 90)] * 3, aspect=Fraction(16, 15))
    assert notices(path) == (
        "dv.mp4 has pixels of aspect 16/15: its frames of 90x64 are stretched to 96x64.",)


def test_a_second_video_in_the_file_is_named(tmp_path):
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("libx264", rate=10) for _ in range(2)]
        for stream, width in zip(streams, (96, 64), strict=True):
            stream.width, stream.height, stream.pix_fmt = width, 64, "yuv420p"
        for stream in streams:
            frame = av.VideoFrame.from_ndarray(texture(64, stream.width))
            container.mux([*stream.encode(frame), *stream.encode()])
    assert notices(path) == ("two.mkv holds 2 videos: the first that can be decoded is used.",)
    assert scan_video(path, threads=1, step=lambda: None).width == 96
