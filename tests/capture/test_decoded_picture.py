"""Frames as they are displayed: colours, aspect, rotation and fields."""

from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
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
    BT709,
    PEAK,
    SDR_WHITE,
    WHITE,
    DecodedPicture,
    Gap,
    Transfer,
    gray_table,
    hlg_scene,
    pq_light,
    pq_signal,
    srgb_code,
    to_sdr,
    tone_map,
)
from recon_cli.capture.scan import scan_video
from recon_cli.capture.video import decode, frames_at

PQ, HLG, BT2020, BT2020_NCL = 16, 18, 9, 9  # codes of H.273
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
    assert scan.notices == ("fields.mp4 is interlaced: 10 frames are deinterlaced.",)
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
    for picture, whole in zip(damaged, scan.whole, strict=True):
        if whole:
            np.testing.assert_array_equal(picture.rgb(), truth[picture.frame.pts])
    # A group of five, and one frame on either side.
    assert scan.lost <= 7
    assert len(damaged) + sum(isinstance(item, Gap) for item in decode(path, threads=1)) == 20


# ITU-R BT.2087-0: linear BT.709 to linear BT.2020.
TO_BT2020 = np.array([
    [0.6274, 0.3293, 0.0433],
    [0.0691, 0.9195, 0.0114],
    [0.0164, 0.0880, 0.8956],
])
KNEE = 87.8  # cd/m2


def hlg_signal(light):
    """The HLG signal of display light in cd/m2 [3]: inverse OOTF and OETF of BT.2100, in words."""
    luminance = np.dot([0.2627, 0.6780, 0.0593], light) / PEAK
    scene = light / PEAK * luminance ** (1 / 1.2 - 1)
    return np.where(
        scene <= 1 / 12, np.sqrt(3 * scene),
        0.17883277 * np.log(np.maximum(12 * scene - 0.28466892, 1e-9)) + 0.55991073)


def sixteen_bits(signal):
    return np.round(np.asarray(signal) * WHITE).astype(np.uint16)


def gray(signals):
    return np.repeat(sixteen_bits(signals)[None, :, None], 3, axis=2)


# BT.2408, table 1: signal levels of a gray card, white, and the peak.
@pytest.mark.parametrize(("light", "pq", "hlg"), [(26, 0.38, 0.38), (203, 0.58, 0.75)])
def test_the_published_levels_of_gray_and_white_are_met(light, pq, hlg):
    assert pq_light(np.array(pq)) == pytest.approx(light, rel=0.03)  # two digits are published
    assert PEAK * hlg_scene(np.array(hlg)) ** 1.2 == pytest.approx(light, rel=0.03)


def test_both_curves_end_where_the_standard_says():
    assert pq_light(np.array([0.0, 1.0])) == pytest.approx([0, 10000])
    assert hlg_scene(np.array([0.0, 0.5, 1.0])) == pytest.approx([0, 1 / 12, 1], abs=1e-6)
    light = np.geomspace(0.01, 10000, 50)
    np.testing.assert_allclose(pq_light(pq_signal(light)), light, rtol=1e-9)


def test_the_curve_keeps_dark_light_and_bends_the_peak_to_the_white_of_sdr():
    light = np.linspace(0, 2 * PEAK, 20001)
    out = tone_map(light)
    np.testing.assert_allclose(out[light < KNEE], light[light < KNEE], rtol=1e-9)
    assert out[light >= PEAK] == pytest.approx(SDR_WHITE)
    assert (np.diff(out[light <= PEAK]) > 0).all()
    # No corner at the knee: the slope is 1 on both sides.
    steps = np.diff(out) / np.diff(light)
    assert np.abs(np.diff(steps)).max() < 0.002


def test_srgb_codes_are_those_of_the_standard():
    light = np.array([0, 0.0031308, 0.215861, 0.5, 1])  # 0.215861 is byte 128
    assert srgb_code(light).tolist() == [0, 10, 128, 188, 255]


@pytest.mark.parametrize("transfer", Transfer)
def test_a_gray_ramp_follows_the_documented_curve(transfer):
    signal = np.linspace(0, 1, 1024)
    light = pq_light(signal) if transfer is Transfer.PQ else PEAK * hlg_scene(signal) ** 1.2
    expected = srgb_code(tone_map(light) / SDR_WHITE).astype(int)
    found = to_sdr(gray(signal), transfer)[0].astype(int)
    assert np.abs(found - expected[:, None]).max() <= 1  # tables in between
    assert np.ptp(found, axis=1).max() <= 1  # gray stays gray
    table = gray_table(transfer)[np.round(255 * signal).astype(int)].astype(int)
    steep = np.abs(np.diff(expected)).max() * 4  # an eighth bit is four steps of the tenth
    assert np.abs(table - expected).max() <= steep


# Below the knee, where the curve changes nothing: the display light is that of the SDR colour.
@pytest.mark.parametrize("colour", [(80, 20, 5), (5, 70, 30), (3, 8, 85), (60, 60, 60)])
@pytest.mark.parametrize("transfer", Transfer)
def test_colours_of_bt709_in_bt2020_are_shown_as_they_are(transfer, colour):
    light = TO_BT2020 @ np.array(colour, float)
    signal = hlg_signal(light) if transfer is Transfer.HLG else pq_signal(light)
    found = to_sdr(sixteen_bits(signal)[None, None], transfer)[0, 0].astype(int)
    expected = srgb_code(np.array(colour) / SDR_WHITE).astype(int)
    assert np.abs(found - expected).max() <= 1


@pytest.mark.parametrize("transfer", Transfer)
def test_a_brighter_colour_keeps_its_hue(transfer):
    colour = np.array([600.0, 200, 100])  # six to two to one, far above the knee
    light = TO_BT2020 @ colour
    signal = hlg_signal(light) if transfer is Transfer.HLG else pq_signal(light)
    code = to_sdr(sixteen_bits(signal)[None, None], transfer)[0, 0] / 255
    linear = ((code + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(linear / linear[0], colour / colour[0], rtol=0.03)
    assert linear[0] * SDR_WHITE == pytest.approx(tone_map(colour[:1])[0], rel=0.02)


def test_colours_beyond_bt709_stay_in_range():
    pure = np.eye(3)[None]
    found = to_sdr(sixteen_bits(pure), Transfer.PQ)[0]
    assert found.diagonal().tolist() == [255, 255, 255]
    assert (found[~np.eye(3, dtype=bool)] == 0).all()


def test_primaries_that_are_those_of_sdr_stay():
    light = np.array([80.0, 20, 5])
    found = to_sdr(sixteen_bits(pq_signal(light))[None, None], Transfer.PQ, primaries=BT709)
    assert np.abs(found[0, 0].astype(int) - srgb_code(light / SDR_WHITE)).max() <= 1


def test_a_pixel_does_not_depend_on_its_neighbours():
    pixels = np.random.default_rng(0).integers(0, 65536, (300, 200, 3), dtype=np.uint16)
    whole = to_sdr(pixels, Transfer.HLG)
    np.testing.assert_array_equal(to_sdr(pixels[100:130], Transfer.HLG), whole[100:130])
