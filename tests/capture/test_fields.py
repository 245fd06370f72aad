import av
import numpy as np
import pytest
from media import spoil_packets, woven, write_interlaced, write_video

from recon_cli.capture.decoded_picture import Gap, Picture
from recon_cli.capture.scan import scan_video
from recon_cli.capture.video import decode, frames_at

RATE = 25
STEP = 4  # pixels from field to field
COUNT = 10


def moments(count=2 * COUNT, height=96, width=160):
    """A bright bar on its way across, once for each field."""
    found = np.full((count, height, width, 3), 40, np.uint8)
    for index, picture in enumerate(found):
        picture[:, 8 + STEP * index:28 + STEP * index] = 220
    return list(found)


@pytest.fixture
def video(tmp_path):
    return write_interlaced(tmp_path / "fields.mp4", woven(moments()), rate=RATE)


def decoded(path):
    """The frames as they are stored."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="gray") for frame in container.decode(video=0)]


def pictures(path, threads=1):
    return [item for item in decode(path, threads=threads) if isinstance(item, Picture)]


def combing(gray):
    """How far rows are from the mean of those above and below."""
    rows = gray.astype(float)
    return np.abs(rows[1:-1] - (rows[:-2] + rows[2:]) / 2).mean()


@pytest.mark.parametrize("order", ["tff", "bff"])
@pytest.mark.parametrize("threads", [1, 3])
def test_a_moving_edge_has_no_comb_and_is_where_the_first_field_saw_it(tmp_path, threads, order):
    path = write_interlaced(tmp_path / "a.mp4", woven(moments(), order), order=order, rate=RATE)
    stored, shown = decoded(path), pictures(path, threads)
    first = 0 if order == "tff" else 1
    assert len(shown) == len(stored) == COUNT
    assert all(picture.interlaced for picture in shown)
    for index, (before, picture) in enumerate(zip(stored, shown, strict=True)):
        after = picture.gray()
        assert combing(before) > 5
        assert combing(after) < 0.5
        np.testing.assert_array_equal(after[first::2], before[first::2])  # as recorded
        bar = np.flatnonzero(after[48] > 130)
        assert (bar[0], bar[-1]) == (8 + 2 * STEP * index, 27 + 2 * STEP * index)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_one_frame_comes_out_for_each_that_goes_in(tmp_path, count):
    frames = woven(moments(2 * count))
    path = write_interlaced(tmp_path / "short.mp4", frames)
    assert len(pictures(path)) == count


def test_times_and_indices_stay_in_the_scan_and_after_it(video):
    scan = scan_video(video, threads=2, step=lambda: None)
    np.testing.assert_allclose(scan.seconds, np.arange(COUNT) / RATE)
    assert scan.notices == ("fields.mp4 is interlaced: 10 frames are deinterlaced.",)
    for index, rgb in frames_at(video, [0, 3, COUNT - 1], threads=2):
        assert np.flatnonzero(rgb[48, :, 1] > 130)[0] == 8 + 2 * STEP * index


def test_a_stamp_of_a_frame_counts_in_the_units_of_the_stream(video):
    with av.open(str(video)) as container:
        stamps = [(frame.pts, frame.time_base) for frame in container.decode(video=0)]
    assert [(p.frame.pts, p.frame.time_base) for p in pictures(video)] == stamps


def test_frames_that_are_flagged_as_progressive_stay_as_they_are(tmp_path):
    path = write_video(tmp_path / "plain.mp4", woven(moments()), rate=RATE)
    for stored, picture in zip(decoded(path), pictures(path), strict=True):
        assert not picture.interlaced
        np.testing.assert_array_equal(picture.gray(), stored)


def test_progressive_frames_among_interlaced_ones_stay_as_they_are(tmp_path):
    parts = [
        write(tmp_path / f"{index}.h264", woven(moments()), muxer="h264", rate=RATE)
        for index, write in enumerate([write_video, write_interlaced, write_video])
    ]
    path = tmp_path / "all.h264"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    shown = pictures(path)
    assert [picture.interlaced for picture in shown] == (
        [False] * COUNT + [True] * COUNT + [False] * COUNT)
    for stored, picture in zip(decoded(path), shown, strict=True):
        assert np.array_equal(picture.gray(), stored) is not picture.interlaced


@pytest.mark.parametrize("packet", [1, 6, 12, 19])
def test_whole_frames_are_those_of_the_undamaged_video(tmp_path, packet):
    options = {"g": "5", "bf": "0", "sc_threshold": "0"}
    frames = woven(moments(40, width=240))
    path = write_interlaced(tmp_path / "video.mp4", frames, options=options)
    truth = {picture.frame.pts: picture.rgb() for picture in pictures(path)}
    spoil_packets(path, [packet], erase=True)
    scan = scan_video(path, threads=2, step=lambda: None)
    assert scan.lost > 0
    damaged = pictures(path)
    for picture, whole in zip(damaged, scan.whole, strict=True):
        if whole:
            np.testing.assert_array_equal(picture.rgb(), truth[picture.frame.pts])
    # A group of five, and one frame on either side.
    assert scan.lost <= 7
    assert len(damaged) + sum(isinstance(item, Gap) for item in decode(path, threads=1)) == 20
