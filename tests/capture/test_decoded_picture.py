"""Frames as they are displayed: colours, aspect, rotation and fields."""

from fractions import Fraction
from itertools import product

import av
import cv2
import numpy as np
import pytest
from colour_formulas import (
    COLOURS,
    HLG,
    PQ,
    centres,
    depth,
    displayed,
    frame_of,
    hlg_encode,
    pq_encode,
    srgb_decode,
    srgb_encode,
    to_codes,
    to_primaries,
    to_signals,
)
from facts import assert_facts
from media import (
    set_display_matrix,
    spoil_packets,
    texture,
    woven,
    write_interlaced,
    write_luma,
    write_video,
)

from recon_cli.capture.decoded_picture import (
    ROUNDED,
    DecodedPicture,
    LostPacket,
    Tags,
    nearest_orientation,
    read_tags,
)
from recon_cli.capture.scan import scan_video
from recon_cli.capture.video import decode, frames_at
from recon_cli.capture.video_colour import (
    PEAK,
    SDR_WHITE,
    TRANSFERS,
    Transfer,
    hlg_scene,
    pq_light,
    srgb_code,
    tone_map,
)

BT2020, BT2020_NCL = 9, 9  # codes of H.273
BT2020_10 = 14  # SDR
LIGHTS = {PQ: pq_light, HLG: lambda signal: PEAK * hlg_scene(signal) ** 1.2}
CLOCKWISE = (0, 65536, 0, -65536, 0, 0, 0, 0, 1 << 30)


def pictures(path):
    return [item for item in decode(path, threads=1) if isinstance(item, DecodedPicture)]


def ramp(step=2):
    """Codes of ten bits from black (64) to white (940), each two columns wide, [64, W]."""
    return np.broadcast_to(np.repeat(np.arange(64, 941, step), 2), (64, 2 * (876 // step + 1)))


@pytest.mark.parametrize("suffix", [".mp4", ".mkv"])
@pytest.mark.parametrize("trc", [PQ, HLG])
def test_a_gray_ramp_of_hdr_video_follows_the_documented_curve(tmp_path, trc, suffix):
    path = write_luma(
        tmp_path / f"ramp{suffix}", [ramp()] * 3, trc=trc, primaries=BT2020, colorspace=BT2020_NCL)
    picture = pictures(path)[1]
    assert picture.tags.transfer is (Transfer.PQ if trc == PQ else Transfer.HLG)
    signal = (ramp()[0] - 64) / 876
    expected = srgb_code(tone_map(LIGHTS[trc](signal)) / SDR_WHITE).astype(int)
    found = picture.rgb()[32].astype(int)
    assert np.abs(found - expected[:, None]).max() <= 1  # the tables' rounding
    # Sharpness and motion are measured on the same brightness, but from 8 bits.
    assert np.abs(picture.gray()[32].astype(int) - expected).max() <= 4


@pytest.mark.parametrize("name", ["a.mp4", "a.ts"])
def test_hlg_that_is_declared_within_the_stream_alone_is_seen(tmp_path, name):
    """As broadcasters do, for old receivers: the tag says SDR, an SEI message says HLG."""
    path = tmp_path / name
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx265", rate=10)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p10le"
        context = stream.codec_context
        context.color_trc, context.color_primaries = BT2020_10, BT2020
        context.options = {"x265-params": f"log-level=none:atc-sei={HLG}"}
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(texture(64, 96)).reformat(format="yuv420p10le")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert {picture.tags.transfer for picture in pictures(path)} == {Transfer.HLG}


@pytest.mark.parametrize("trc", [1, BT2020_10])
def test_a_ramp_of_ten_bits_is_rounded_to_eight(tmp_path, trc):
    picture = pictures(write_luma(tmp_path / "ten.mp4", [ramp()] * 2, trc=trc))[0]
    assert picture.tags.transfer is None
    signal = 255 * (ramp()[0] - 64) / 876
    # A half, and 0.01 for coefficients of 14 bits.
    assert np.abs(picture.rgb()[32] - signal[:, None]).max() <= 0.51
    assert np.abs(picture.gray()[32] - signal).max() <= 1


def test_a_ramp_of_ten_bits_equals_that_of_eight(tmp_path):
    codes = ramp(step=4)  # those that eight bits hold as well
    ten = pictures(write_luma(tmp_path / "ten.mp4", [codes] * 2))[0]
    eight = pictures(write_luma(tmp_path / "eight.mp4", [codes // 4] * 2, depth=8))[0]
    assert np.abs(ten.rgb().astype(int) - eight.rgb()).max() <= 1
    # Gray is for measuring alone and takes the short way; swscale's last rows are one darker there.
    assert np.abs(ten.gray().astype(int) - eight.gray()).max() <= 2


SDR, BT709, BT601, P3, UNTAGGED, RESERVED = 1, 1, 5, 12, 2, 3  # codes of H.273
# Of 255: a half for the rounding to bytes; the rest for coefficients of 14 bits, and for tables
# whose neighbours differ by 0.2 %, a tenth of 255 at the steepest.
EXACT = 0.6
# Without ACCURATE_RND: RGB and gray are cut to whole numbers, and chroma once before.
TRUNCATED = 3
FORMATS = (
    "yuv420p", "yuvj420p", "nv12", "yuv422p", "yuvj422p", "nv16", "yuv444p", "yuv420p10le",
    "p010le", "yuv422p10le", "p210le", "yuv444p10le", "yuv420p12le", "p012le", "yuv422p12le",
    "yuv444p12le")


@pytest.mark.parametrize("primaries", [BT709, BT2020, P3])
@pytest.mark.parametrize("trc", [SDR, HLG, PQ])
@pytest.mark.parametrize("pixels", FORMATS)
def test_saturated_colours_are_those_of_the_formulas(pixels, trc, primaries):
    tags = Tags(transfer=TRANSFERS.get(trc), primaries=primaries)
    large = BT2020 if trc != SDR or primaries == BT2020 else BT601  # of 400 columns
    matrices = {matrix: matrix for matrix in (BT709, BT601, BT2020)}
    for matrix, meant in {**matrices, UNTAGGED: large, RESERVED: large}.items():
        for full in (False, True) if "j" not in pixels else (True,):
            codes = to_codes(COLOURS, meant, full=full, bits=depth(pixels))
            picture = DecodedPicture(frame_of(codes, pixels, matrix=matrix, full=full), tags)
            signals = to_signals(codes, meant, full=full, bits=depth(pixels))
            expected = displayed(signals, trc, primaries)
            off = np.abs(centres(picture.rgb()) - expected).max()
            assert off <= EXACT, (matrix, full, off)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("pixels", FORMATS)
def test_gray_is_that_of_bt601_for_any_matrix(pixels, full):
    for matrix in (BT709, BT601, BT2020):
        codes = to_codes(COLOURS, matrix, full=full or "j" in pixels, bits=depth(pixels))
        frame = frame_of(codes, pixels, matrix=matrix, full=full or "j" in pixels)
        signals = to_signals(codes, matrix, full=full or "j" in pixels, bits=depth(pixels))
        expected = 255 * signals @ np.array([0.299, 0.587, 0.114])
        assert np.abs(centres(DecodedPicture(frame).gray()) - expected).max() <= TRUNCATED


# What decoders of ProRes, MJPEG, DV, VP9, lossless H.264 and screen recorders give besides.
@pytest.mark.parametrize(("pixels", "bits"), [
    ("rgb24", 8), ("bgr0", 8), ("rgba", 8), ("gbrp", 8), ("rgb48le", 10), ("gbrp10le", 10),
    ("gbrp12le", 10), ("gbrap12le", 10), ("x2rgb10le", 8), ("yuva444p10le", 10),
    ("yuva444p12le", 10), ("ayuv64le", 10),
    # A step of limited range in Cb or Cr is nearly two in R or B.
    ("yuv440p10le", 9), ("y210le", 9), ("xv30le", 9)])
@pytest.mark.parametrize("trc", [SDR, HLG, PQ])
def test_other_formats_give_their_colours_to_their_bits(pixels, bits, trc):
    codes = to_codes(COLOURS, BT2020, full=False, bits=12)
    signals = to_signals(codes, BT2020, full=False, bits=12)
    frame = frame_of(codes, "yuv444p12le", matrix=BT2020, full=False).reformat(
        format=pixels, dst_colorspace=BT2020, interpolation=ROUNDED)
    expected = displayed(signals, trc, BT2020)
    off = np.abs(centres(DecodedPicture(frame, Tags(
        transfer=TRANSFERS.get(trc), primaries=BT2020)).rgb()) - expected)
    # A step of the format, in any direction of R, G and B.
    steps = [np.clip(signals + np.array(step) / (1 << bits), 0, 1)
             for step in product((-1, 0, 1), repeat=3)]
    reach = np.max([np.abs(displayed(step, trc, BT2020) - expected) for step in steps], axis=0)
    assert (off <= reach + EXACT).all()


@pytest.mark.parametrize("transfer", Transfer)
def test_untagged_hdr_and_wide_sdr_take_the_matrix_of_bt2020(transfer):
    codes = to_codes(COLOURS, BT2020, full=False, bits=10)
    tagged, untagged = (
        frame_of(codes, "yuv420p10le", matrix=matrix, full=False) for matrix in (BT2020, UNTAGGED))
    for tags in (Tags(transfer=transfer), Tags(primaries=BT2020)):
        np.testing.assert_array_equal(
            DecodedPicture(untagged, tags).rgb(), DecodedPicture(tagged, tags).rgb())


@pytest.mark.parametrize("aspect", [Fraction(4, 3), Fraction(2)])
@pytest.mark.parametrize("trc", [HLG, PQ])
def test_anamorphic_hdr_keeps_its_colours(trc, aspect):
    codes = to_codes(COLOURS, BT2020, full=False, bits=10)
    frame = frame_of(codes, "yuv420p10le", matrix=BT2020, full=False)
    tags = Tags(aspect, TRANSFERS[trc], BT2020)
    narrow = cv2.resize(
        DecodedPicture(frame, tags).rgb(), (frame.width, frame.height),
        interpolation=cv2.INTER_AREA)
    signals = to_signals(codes, BT2020, full=False, bits=10)
    off = np.abs(centres(narrow) - displayed(signals, trc, BT2020))
    assert off.max() <= 1  # rounded twice


def write_frame(path, codes, *, trc, primaries, matrix):
    """A file of three equal frames of ten bits, 4:2:0, without loss, with these tags."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        frame = frame_of(codes, "yuv420p10le", matrix=matrix, full=False)
        stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, frame.format.name
        context = stream.codec_context
        context.color_trc, context.color_primaries = trc, primaries
        context.colorspace, context.color_range = matrix, 1
        for _ in range(3):
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def test_copies_of_one_clip_in_sdr_hlg_and_pq_look_alike(tmp_path):
    """Colours of BT.709 below the knee of the curve, where HDR shows the light of SDR."""
    light = srgb_decode(COLOURS) * 0.43  # of the white of SDR: 87 cd/m2
    wide = to_primaries(light * SDR_WHITE, BT2020)
    clips = {
        "sdr": (srgb_encode(light), SDR, BT709), "p3": (
            srgb_encode(to_primaries(light, P3)), SDR, P3),
        "bt2020": (srgb_encode(wide / SDR_WHITE), BT2020_10, BT2020),
        "hlg": (hlg_encode(wide), HLG, BT2020), "pq": (pq_encode(wide), PQ, BT2020)}
    means = {}
    for name, (signals, trc, primaries) in clips.items():
        matrix = BT2020_NCL if primaries == BT2020 else BT709
        codes = to_codes(signals, matrix, full=False, bits=10)
        path = write_frame(
            tmp_path / f"{name}.mkv", codes, trc=trc, primaries=primaries, matrix=matrix)
        found = centres(pictures(path)[1].rgb())
        stored = to_signals(codes, matrix, full=False, bits=10)
        assert np.abs(found - displayed(stored, trc, primaries)).max() <= EXACT, name
        means[name] = found.mean(axis=0) / found.mean(axis=0).sum()
    for name, mean in means.items():
        np.testing.assert_allclose(mean, means["sdr"], atol=0.002, err_msg=name)


# a, b, c, d of x' = a x + c y, y' = b x + d y, and what a player does to a picture.
EIGHT = {
    "as stored": ((1, 0, 0, 1), lambda picture: picture),
    "turned right": ((0, 1, -1, 0), lambda picture: np.rot90(picture, -1)),
    "upside down": ((-1, 0, 0, -1), lambda picture: np.rot90(picture, 2)),
    "turned left": ((0, -1, 1, 0), lambda picture: np.rot90(picture)),
    "mirrored": ((-1, 0, 0, 1), np.fliplr),
    "top down": ((1, 0, 0, -1), np.flipud),
    "transposed": ((0, 1, 1, 0), lambda picture: picture.swapaxes(0, 1)),
    "transposed upside down": (
        (0, -1, -1, 0), lambda picture: np.rot90(picture.swapaxes(0, 1), 2))}


def matrix_of(a, b, c, d):
    """The matrix of an MP4's track header, without a translation."""
    return (*(round(65536 * value) for value in (a, b)), 0,
            *(round(65536 * value) for value in (c, d)), 0, 0, 0, 1 << 30)


@pytest.mark.parametrize("name", EIGHT)
@pytest.mark.parametrize("write", [write_video, write_interlaced])
def test_a_frame_is_shown_as_players_show_it(tmp_path, write, name):
    shape, show = EIGHT[name]
    path = write(tmp_path / "a.mp4", [texture(64, 96, coarseness=8)] * 2)
    stored = pictures(path)[0]
    if name != "as stored":
        set_display_matrix(path, matrix_of(*shape))
    picture = pictures(path)[0]
    np.testing.assert_array_equal(picture.rgb(), show(stored.rgb()))
    np.testing.assert_array_equal(picture.gray(), show(stored.gray()))
    assert picture.size == picture.gray().shape[::-1]
    assert picture.tags.orientation.mirrored == (np.linalg.det(np.reshape(shape, (2, 2))) < 0)


def turn(degrees):
    """A rotation to the right."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return cos, sin, -sin, cos


@pytest.mark.parametrize(("shape", "name"), [
    ((0, 0, 0, 0), "as stored"),
    (turn(10), "as stored"), (turn(44), "as stored"), (turn(45), "as stored"),
    (turn(50), "turned right"), (turn(170), "upside down"), (turn(-80), "turned left"),
    ((1, 0, 0, 0), "as stored"), ((0, 0, 0, 5), "as stored"), ((0, 1, 0, 0), "turned right"),
    ((1, 1, 1, 1), "as stored"), ((9, 0, 0, 0.1), "as stored"), ((0, 9, -0.1, 0), "turned right"),
    ((-0.1, 0, 0, 3), "mirrored"), ((0.01, 5, 5, 0), "transposed")])
def test_an_odd_matrix_is_the_nearest_of_the_eight(shape, name):
    assert nearest_orientation(*shape) == nearest_orientation(*EIGHT[name][0])


@pytest.mark.parametrize("shape", [(0, 0, 0, 0), turn(10), (1, 0, 0, 0), (1, 1, 1, 1)])
def test_a_frame_with_an_odd_matrix_is_shown_as_stored(tmp_path, shape):
    path = write_video(tmp_path / "a.mp4", [texture(64, 96, coarseness=8)] * 2)
    stored = pictures(path)[0].rgb()
    set_display_matrix(path, matrix_of(*shape))
    np.testing.assert_array_equal(pictures(path)[0].rgb(), stored)


def test_a_matrix_that_stretches_gives_the_aspect_of_the_pixels(tmp_path):
    path = write_video(tmp_path / "a.mp4", [texture(64, 96, coarseness=8)] * 2)
    set_display_matrix(path, matrix_of(-2, 0, 0, 1))
    picture = pictures(path)[0]
    assert picture.size == (192, 64)
    assert picture.tags.orientation.mirrored


def test_side_data_that_cannot_be_listed_leaves_the_rotation(tmp_path):
    class Frame:
        """A frame with side data of a kind that PyAV does not know."""

        rotation = -90

        @property
        def side_data(self):
            raise ValueError(99)

    path = write_video(tmp_path / "a.mp4", [texture(64, 96)])
    with av.open(str(path)) as container:
        assert read_tags(container.streams.video[0], Frame()).orientation == nearest_orientation(
            *EIGHT["turned right"][0])


def square_video(path, aspect, *, width=120):
    """A white square of 64x64 on black, stored with pixels of this aspect."""
    picture = np.zeros((96, width, 3), np.uint8)
    picture[16:80, 20:20 + round(64 / aspect)] = 255
    return write_video(path, [picture] * 2, aspect=aspect)


def box(gray):
    """Width and height of what is white."""
    _, white = cv2.threshold(gray, 127, 1, cv2.THRESH_BINARY)
    return cv2.boundingRect(white)[2:]


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".ts"])
@pytest.mark.parametrize("aspect", [Fraction(4, 3), Fraction(2), Fraction(8, 9)])
def test_a_square_of_anamorphic_video_is_square_again(tmp_path, aspect, suffix):
    picture = pictures(square_video(tmp_path / f"wide{suffix}", aspect))[0]
    assert picture.size == (round(120 * aspect), 96)
    rgb = picture.rgb()
    assert rgb.shape == (96, round(120 * aspect), 3)
    for found in (box(rgb[..., 1]), box(picture.gray())):
        np.testing.assert_allclose(found, (64, 64), atol=2)  # interpolated edges


def test_anamorphic_video_is_stretched_before_it_is_turned(tmp_path):
    path = square_video(tmp_path / "phone.mp4", Fraction(4, 3))
    set_display_matrix(path, CLOCKWISE)
    picture = pictures(path)[0]
    assert picture.size == (96, 160)
    assert picture.rgb().shape == (160, 96, 3)
    np.testing.assert_allclose(box(picture.gray()), (64, 64), atol=2)


def test_square_pixels_are_left_alone(tmp_path):
    path = write_video(tmp_path / "plain.mp4", [np.zeros((96, 120, 3), np.uint8)] * 2)
    picture = pictures(path)[0]
    assert picture.size == picture.square_size == (120, 96)


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


def decode_pictures(path, threads=1):
    return [item for item in decode(path, threads=threads) if isinstance(item, DecodedPicture)]


def combing(gray):
    """How far rows are from the mean of those above and below."""
    rows = gray.astype(float)
    return np.abs(rows[1:-1] - (rows[:-2] + rows[2:]) / 2).mean()


@pytest.mark.parametrize("order", ["tff", "bff"])
@pytest.mark.parametrize("threads", [1, 3])
def test_a_moving_edge_has_no_comb_and_is_where_the_first_field_saw_it(tmp_path, threads, order):
    path = write_interlaced(tmp_path / "a.mp4", woven(moments(), order), order=order, rate=RATE)
    stored, shown = decoded(path), decode_pictures(path, threads)
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
    assert len(decode_pictures(path)) == count


def test_times_and_indices_stay_in_the_scan_and_after_it(video):
    scan = scan_video(video, threads=2, step=lambda: None)
    np.testing.assert_allclose(scan.seconds, np.arange(COUNT) / RATE)
    (notice,) = scan.notices
    assert_facts(notice, "fields.mp4", "interlaced", COUNT)
    for index, rgb in frames_at(video, [0, 3, COUNT - 1], threads=2):
        assert np.flatnonzero(rgb[48, :, 1] > 130)[0] == 8 + 2 * STEP * index


def test_a_stamp_of_a_frame_counts_in_the_units_of_the_stream(video):
    with av.open(str(video)) as container:
        stamps = [(frame.pts, frame.time_base) for frame in container.decode(video=0)]
    assert [(p.frame.pts, p.frame.time_base) for p in decode_pictures(video)] == stamps


def test_frames_that_are_flagged_as_progressive_stay_as_they_are(tmp_path):
    path = write_video(tmp_path / "plain.mp4", woven(moments()), rate=RATE)
    for stored, picture in zip(decoded(path), decode_pictures(path), strict=True):
        assert not picture.interlaced
        np.testing.assert_array_equal(picture.gray(), stored)


def test_progressive_frames_among_interlaced_ones_stay_as_they_are(tmp_path):
    parts = [
        write(tmp_path / f"{index}.h264", woven(moments()), muxer="h264", rate=RATE)
        for index, write in enumerate([write_video, write_interlaced, write_video])
    ]
    path = tmp_path / "all.h264"
    path.write_bytes(b"".join(part.read_bytes() for part in parts))
    shown = decode_pictures(path)
    assert [picture.interlaced for picture in shown] == (
        [False] * COUNT + [True] * COUNT + [False] * COUNT)
    for stored, picture in zip(decoded(path), shown, strict=True):
        assert np.array_equal(picture.gray(), stored) is not picture.interlaced


@pytest.mark.parametrize("packet", [1, 6, 12, 19])
def test_whole_frames_are_those_of_the_undamaged_video(tmp_path, packet):
    options = {"g": "5", "bf": "0", "sc_threshold": "0"}
    frames = woven(moments(40, width=240))
    path = write_interlaced(tmp_path / "video.mp4", frames, options=options)
    truth = {picture.frame.pts: picture.rgb() for picture in decode_pictures(path)}
    spoil_packets(path, [packet], erase=True)
    scan = scan_video(path, threads=2, step=lambda: None)
    assert scan.lost > 0
    damaged = decode_pictures(path)
    for picture, whole in zip(damaged, scan.intact, strict=True):
        if whole:
            np.testing.assert_array_equal(picture.rgb(), truth[picture.frame.pts])
    # A group of five, and one frame on either side.
    assert scan.lost <= 7
    lost = sum(isinstance(item, LostPacket) for item in decode(path, threads=1))
    assert len(damaged) + lost == 20
