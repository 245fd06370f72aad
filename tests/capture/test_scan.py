"""One pass over a video: measures, damage and notices."""

import dataclasses
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from facts import assert_facts, raises
from media import (
    set_display_matrix,
    set_edit_list,
    spoil_packets,
    texture,
    write_luma,
    write_video,
)

from recon_cli.capture.decoded_picture import DecodedPicture
from recon_cli.capture.frame_measures import measure_sharpness
from recon_cli.capture.scan import Scan, decode_threads, measure_scene, scan_video
from recon_cli.capture.video import decode, frames_at
from recon_cli.errors import InputError


def quiet():
    """A step that nobody watches."""


def walk(frames=40, step=2):
    wide = texture(96, 160 + frames * step)
    return [wide[:, i * step:i * step + 160] for i in range(frames)]


@pytest.fixture
def video(tmp_path):
    options = {"qp": "10", "g": "10", "bf": "2", "sc_threshold": "0"}
    return write_video(tmp_path / "walk.mp4", walk(), options=options)


def test_blur_lowers_sharpness():
    gray = texture(96, 160)[:, :, 0]
    blurred = [measure_sharpness(cv2.GaussianBlur(gray, (0, 0), sigma)) for sigma in (0.5, 1, 2, 4)]
    assert blurred == sorted(blurred, reverse=True)
    assert measure_sharpness(np.full((96, 160), 128, np.uint8)) == 0


def test_sharpness_is_measured_at_one_size():
    gray = texture(540, 960, coarseness=12)[:, :, 0]
    larger = cv2.resize(gray, None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST)
    assert measure_sharpness(larger) == pytest.approx(measure_sharpness(gray), rel=1e-6)


@pytest.mark.integration
def test_an_undamaged_video_is_whole(video):
    steps = []
    scan = scan_video(video, threads=2, step=lambda: steps.append(1))
    assert (scan.width, scan.height, scan.declared, len(steps)) == (160, 96, 40, 40)
    assert (scan.lost, scan.expected, scan.intact.all()) == (0, 40, True)
    np.testing.assert_allclose(scan.seconds, np.arange(40) / 10)
    assert decode_threads(scan, 4) == 4


@pytest.mark.integration
def test_a_container_without_a_count_is_checked_by_its_duration(tmp_path):
    path = write_video(tmp_path / "walk.mkv", walk())
    assert scan_video(path, threads=1, step=quiet).declared == 40
    data = path.read_bytes()
    path.write_bytes(data[:len(data) * 4 // 5])  # the first frame alone is half of it
    scan = scan_video(path, threads=1, step=quiet)
    assert scan.declared == pytest.approx(40, abs=1)
    assert 3 <= scan.intact.sum() <= 37


def assert_equal(ours, theirs):
    for name, value in vars(ours).items():
        if name == "tracks":
            for field, array in vars(value).items():
                np.testing.assert_array_equal(array, getattr(theirs.tracks, field))
        else:
            np.testing.assert_array_equal(value, getattr(theirs, name))


@pytest.mark.integration
def test_a_scan_is_read_as_it_was_written(video, tmp_path):
    scan = scan_video(video, threads=1, step=quiet)
    scan.motion[3] = np.nan
    scan = dataclasses.replace(scan, notices=("It is so.", "And so."))
    scan.write(tmp_path / "scan.json")
    assert_equal(Scan.read(tmp_path / "scan.json"), scan)
    overlay = np.random.default_rng(0).random((54, 90)) > .5
    scan = dataclasses.replace(scan, overlay=overlay)
    scan.write(tmp_path / "scan.json")
    assert_equal(Scan.read(tmp_path / "scan.json"), scan)


@pytest.mark.integration
def test_an_overlay_hides_neither_motion_nor_blur(tmp_path):
    """Beside a sharp picture that stays, a plain scene moves, and is blurred in one frame."""
    frames = [np.full((96, 160, 3), 128, np.uint8) for _ in range(20)]
    for index, (frame, view) in enumerate(zip(frames, walk(20), strict=True)):
        frame[:, :40] = cv2.GaussianBlur(view, (0, 0), 4 if index == 10 else .5)[:, :40]
        frame[:, 60:] = texture(96, 100, seed=3)
    overlay = np.zeros((48, 80), np.bool_)
    overlay[:, 25:] = True
    video = write_video(tmp_path / "walk.mp4", frames)
    scan = scan_video(video, threads=1, step=quiet)
    assert np.nansum(scan.motion) < .01
    assert scan.sharpness[10] > .5 * np.median(scan.sharpness)
    scan = measure_scene(
        video, dataclasses.replace(scan, overlay=overlay), threads=1, step=quiet)
    # The corners of the blurred frame are lost.
    assert np.nansum(scan.motion) == pytest.approx(19 * 2 / 160, rel=.2)
    assert scan.sharpness[10] < .2 * np.median(scan.sharpness)


@pytest.mark.integration
@pytest.mark.parametrize("erase", [False, True])
@pytest.mark.parametrize("packet", [1, 4, 13, 22, 35])
def test_whole_frames_are_exactly_those_of_the_undamaged_video(video, packet, erase):
    def pixels():
        found = (item for item in decode(video, threads=1) if isinstance(item, DecodedPicture))
        return {picture.frame.pts: picture.rgb() for picture in found}

    truth = pixels()
    spoil_packets(video, [packet], erase=erase)
    scan = scan_video(video, threads=1, step=quiet)
    damaged = pixels()
    for (pts, rgb), whole in zip(damaged.items(), scan.intact, strict=True):
        if whole:
            np.testing.assert_array_equal(rgb, truth[pts])
    # No more is given up than the group of ten that the packet belongs to.
    assert 1 <= scan.lost <= 10
    assert decode_threads(scan, 4) == 1


@pytest.mark.integration
def test_damage_is_told_alike_by_any_number_of_threads(video):
    spoil_packets(video, [5, 24])
    scans = [scan_video(video, threads=threads, step=quiet) for threads in (1, 2, 4)]
    assert scans[0].lost > 0
    assert_equal(scans[0], scans[1])
    assert_equal(scans[0], scans[2])


def test_times_follow_the_stamps_where_the_frame_rate_varies(tmp_path):
    stamps = [0, 10, 15, 40, 45, 50, 100, 130]  # hundredths of a second
    path = tmp_path / "phone.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=100)
        stream.width, stream.height, stream.pix_fmt = 160, 96, "yuv420p"
        for stamp, rgb in zip(stamps, walk(), strict=False):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb))
            frame.pts, frame.time_base = stamp, Fraction(1, 100)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    scan = scan_video(path, threads=2, step=quiet)
    np.testing.assert_allclose(scan.seconds, np.array(stamps) / 100)
    assert (scan.lost, scan.notices) == (0, ())


def test_a_video_without_one_frame_that_decodes_names_its_codec(video):
    spoil_packets(video, range(40), erase=True)
    with raises(InputError, "h264") as told:
        scan_video(video, threads=1, step=quiet)
    assert "libx264" in told.value.hint


# (first second, seconds) of each part that is shown; groups begin at whole seconds.
@pytest.mark.integration
@pytest.mark.parametrize(("edits", "shown"), [
    ([(0, 2)], range(20)), ([(1.5, 2.5)], range(15, 40)), ([(1.3, 1.7)], range(13, 30)),
    ([(1, 9)], range(10, 40)), ([(None, 1), (1, 2)], range(10, 30)),
    ([(0, 1), (3, 1)], [*range(10), *range(30, 40)]),
    ([(2, 1), (1, 1)], [*range(20, 30), *range(10, 20)])])
@pytest.mark.parametrize("threads", [1, 3])
def test_what_an_edit_list_leaves_out_is_not_lost(video, edits, shown, threads):
    whole = [picture.rgb() for picture in decode(video, threads=1)]
    set_edit_list(video, edits)
    scan = scan_video(video, threads=threads, step=quiet)
    assert (scan.declared, len(scan.intact), scan.lost) == (len(shown), len(shown), 0)
    for index, rgb in frames_at(video, range(len(shown)), threads=threads):
        np.testing.assert_array_equal(rgb, whole[shown[index]])


@pytest.mark.integration
def test_damage_within_an_edit_list_is_still_seen(video):
    set_edit_list(video, [(1, 2)])
    spoil_packets(video, [7], erase=True)
    scan = scan_video(video, threads=1, step=quiet)
    assert (scan.declared, scan.expected) == (20, 20)
    assert 1 <= scan.lost <= 10


def test_an_edit_list_that_shows_nothing_is_named(video):
    set_edit_list(video, [(1, 0)])
    with raises(InputError, 40, "frames") as told:
        scan_video(video, threads=1, step=quiet)
    assert "-ignore_editlist 1" in told.value.hint


@pytest.mark.integration
@pytest.mark.parametrize("codec", ["libx264", "mpeg4"])
def test_places_of_an_avi_that_repeat_a_frame_are_not_lost(tmp_path, codec):
    path = tmp_path / "screen.avi"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 96, "yuv420p"
        for index, rgb in enumerate(walk(60)):
            if index % 4 == 3 or 20 < index < 30:
                continue
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb))
            frame.pts, frame.time_base = index, Fraction(1, 10)
            container.mux(stream.encode(frame.reformat(format="yuv420p")))
        container.mux(stream.encode())
    scan = scan_video(path, threads=1, step=quiet)
    assert (scan.declared, len(scan.intact), scan.lost) == (38, 38, 0)
    data = path.read_bytes()
    path.write_bytes(data[:len(data) * 2 // 3])  # without the index at its end
    assert scan_video(path, threads=1, step=quiet).lost > 0


@pytest.mark.integration
def test_half_a_file_gives_the_frames_of_its_half(tmp_path):
    path = write_video(tmp_path / "walk.ts", walk())
    data = path.read_bytes()
    path.write_bytes(data[:len(data) * 4 // 5])
    scan = scan_video(path, threads=1, step=quiet)
    assert 3 <= scan.intact.sum() < 40


def test_a_scan_is_of_the_upright_square_frame(tmp_path):
    path = write_video(tmp_path / "a.mp4", walk(5), aspect=Fraction(4, 3))
    set_display_matrix(path, (0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30))
    scan = scan_video(path, threads=1, step=quiet)
    assert (scan.width, scan.height) == (96, 213)
    shapes = {rgb.shape for _, rgb in frames_at(path, range(5), threads=1)}
    assert shapes == {(213, 96, 3)}


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
        (notice,) = notices(path)
        assert_facts(notice, f"{name}.mp4", name, "SDR")


@pytest.mark.parametrize(("primaries", "name"), [(9, "BT.2020"), (12, "Display P3")])
def test_a_wide_gamut_of_sdr_is_named(tmp_path, primaries, name):
    path = write_luma(tmp_path / "a.mp4", [np.full((64, 96), 500)] * 3, primaries=primaries)
    (notice,) = notices(path)
    assert_facts(notice, "a.mp4", name, "sRGB")


def test_a_mirrored_video_is_named_and_a_turned_one_is_not(tmp_path):
    path = write_video(tmp_path / "a.mp4", [texture(64, 96)] * 3)
    data = path.read_bytes()
    set_display_matrix(path, (-65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30))
    (notice,) = notices(path)
    assert_facts(notice, "a.mp4", "mirrored")
    path.write_bytes(data)
    set_display_matrix(path, (-65536, 0, 0, 0, -65536, 0, 0, 0, 1 << 30))
    assert notices(path) == ()


def test_ten_bits_of_sdr_give_no_notice(tmp_path):
    assert notices(write_luma(tmp_path / "ten.mp4", [np.full((64, 96), 500)] * 3)) == ()


def test_stretched_pixels_are_named_with_both_sizes(tmp_path):
    path = write_video(tmp_path / "dv.mp4", [texture(64, 90)] * 3, aspect=Fraction(16, 15))
    (notice,) = notices(path)
    assert_facts(notice, "dv.mp4", "16/15", "90x64", "96x64")


def test_a_second_video_in_the_file_is_named(tmp_path):
    path = tmp_path / "two.mkv"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("libx264", rate=10) for _ in range(2)]
        for stream, width in zip(streams, (96, 64), strict=True):
            stream.width, stream.height, stream.pix_fmt = width, 64, "yuv420p"
        for stream in streams:
            frame = av.VideoFrame.from_ndarray(texture(64, stream.width))
            container.mux([*stream.encode(frame), *stream.encode()])
    (notice,) = notices(path)
    assert_facts(notice, "two.mkv", 2)
    assert scan_video(path, threads=1, step=lambda: None).width == 96


def joined(path, *parts):
    """A transport stream of clips (count, width, height) joined without encoding them again."""
    with av.open(str(path), "w") as target:
        stream, end = None, 0
        for number, (count, width, height) in enumerate(parts):
            frames = [cv2.resize(moved, (width, height), interpolation=cv2.INTER_AREA)
                      for moved in stroll(count, seed=number)]
            clip = write_video(path.with_name(f"{number}.ts"), frames, muxer="mpegts",
                               options={"qp": "4", "bf": "0"})
            with av.open(str(clip)) as source:
                stream = stream or target.add_stream_from_template(source.streams.video[0])
                packets = [packet for packet in source.demux(video=0) if packet.size]
                shift = end - packets[0].dts
                for packet in packets:
                    packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                    packet.stream = stream
                    target.mux(packet)
            end += count * 9000  # ticks of 1/90000 s at 10 frames a second
    return path


def stroll(count, *, seed):
    wall = texture(192, 256 + 4 * count, seed=seed, coarseness=8)
    return [wall[:, 4 * step:4 * step + 256] for step in range(count)]


@pytest.mark.integration
@pytest.mark.parametrize(("parts", "size"), [
    (((12, 128, 96), (6, 256, 192)), (128, 96)), (((6, 256, 192), (12, 128, 96)), (128, 96))])
def test_frames_of_another_size_are_scaled_to_the_most_common_one(tmp_path, parts, size):
    path = joined(tmp_path / "a.ts", *parts)
    scan = scan_video(path, threads=2, step=lambda: None)
    assert (scan.width, scan.height) == size == scan.size
    assert len(scan.intact) == 18
    assert scan.intact.all()
    assert scan.lost == scan.gaps == 0
    assert_facts("\n".join(scan.notices), 6, "256x192", "128x96")
    shown = dict(frames_at(path, range(18), threads=1, size=scan.size))
    assert {rgb.shape for rgb in shown.values()} == {(96, 128, 3)}
    alone = [cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
             for count, *_ in parts for rgb in stroll(count, seed=int(count != parts[0][0]))]
    for index, rgb in shown.items():
        assert index == np.argmax([cv2.PSNR(rgb, other) for other in alone])


@pytest.mark.integration
def test_times_in_the_order_of_packets_lose_no_frame(tmp_path):
    path = tmp_path / "a.ts"  # as programs that know no B-frames write
    clip = write_video(tmp_path / "b.ts", stroll(20, seed=0), options={"qp": "4", "bf": "3"})
    with av.open(str(clip)) as source, av.open(str(path), "w") as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for number, packet in enumerate(source.demux(video=0)):
            if packet.size:
                packet.pts = packet.dts = number * 9000
                packet.stream = stream
                target.mux(packet)
    scan = scan_video(path, threads=1, step=lambda: None)
    assert list(scan.seconds) != sorted(scan.seconds)
    assert len(scan.intact) == 20
    assert scan.lost == 0


@pytest.mark.parametrize("first", [True, False])
def test_frames_of_another_shape_are_left_out_and_named(tmp_path, first):
    parts = [(6, 96, 128), (12, 128, 96)]
    path = joined(tmp_path / "a.ts", *(parts if first else parts[::-1]))
    scan = scan_video(path, threads=2, step=lambda: None)
    assert (scan.width, scan.height) == (128, 96)
    assert len(scan.intact) == 12
    assert scan.intact.all()
    assert scan.lost == 0
    assert_facts("\n".join(scan.notices), 6, "96x128")


@pytest.mark.integration
def test_the_size_is_kept_with_a_scan(tmp_path):
    scan = scan_video(joined(tmp_path / "a.ts", (3, 256, 192), (6, 128, 96)), threads=1,
                      step=lambda: None)
    scan.write(tmp_path / "scan.json")
    assert Scan.read(tmp_path / "scan.json").size == (128, 96)


@pytest.mark.parametrize(("primaries", "trc", "log"), [
    (9, 2, True), (9, 1, False), (9, 14, False), (1, 2, False), (12, 2, False), (1, 9, True),
    (9, 18, False)])
def test_video_that_may_be_log_is_named(tmp_path, primaries, trc, log):
    path = write_luma(
        tmp_path / "a.mp4", [np.full((64, 96), 500)] * 3, trc=trc, primaries=primaries)
    scan = scan_video(path, threads=1, step=lambda: None)
    assert any("lut3d" in one for one in scan.notices) == log
