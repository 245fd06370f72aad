"""Light of video as sRGB: the published curves, grays, colours and primaries."""

import numpy as np
import pytest

from recon_cli.capture.video_colour import (
    BT709,
    BT2020,
    P3,
    PEAK,
    SDR_WHITE,
    Transfer,
    gray_table,
    hlg_scene,
    pq_light,
    pq_signal,
    srgb_code,
    srgb_light,
    to_srgb,
    tone_map,
)

WHITE = 65280

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
    found = to_srgb(gray(signal), transfer, primaries=BT2020, white=WHITE)[0].astype(int)
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
    found = to_srgb(
        sixteen_bits(signal)[None, None], transfer, primaries=BT2020, white=WHITE)[0, 0].astype(int)
    expected = srgb_code(np.array(colour) / SDR_WHITE).astype(int)
    assert np.abs(found - expected).max() <= 1


@pytest.mark.parametrize("transfer", Transfer)
def test_a_brighter_colour_keeps_its_hue(transfer):
    colour = np.array([600.0, 200, 100])  # six to two to one, far above the knee
    light = TO_BT2020 @ colour
    signal = hlg_signal(light) if transfer is Transfer.HLG else pq_signal(light)
    code = to_srgb(
        sixteen_bits(signal)[None, None], transfer, primaries=BT2020, white=WHITE)[0, 0] / 255
    linear = ((code + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(linear / linear[0], colour / colour[0], rtol=0.03)
    assert linear[0] * SDR_WHITE == pytest.approx(tone_map(colour[:1])[0], rel=0.02)


def test_colours_beyond_bt709_stay_in_range():
    pure = np.eye(3)[None]
    found = to_srgb(sixteen_bits(pure), Transfer.PQ, primaries=BT2020, white=WHITE)[0]
    assert found.diagonal().tolist() == [255, 255, 255]
    assert (found[~np.eye(3, dtype=bool)] == 0).all()


def test_primaries_that_are_those_of_sdr_stay():
    light = np.array([80.0, 20, 5])
    found = to_srgb(
        sixteen_bits(pq_signal(light))[None, None], Transfer.PQ, primaries=BT709, white=WHITE)
    assert np.abs(found[0, 0].astype(int) - srgb_code(light / SDR_WHITE)).max() <= 1


def test_a_pixel_does_not_depend_on_its_neighbours():
    pixels = np.random.default_rng(0).integers(0, 65536, (300, 200, 3), dtype=np.uint16)

    def convert(part):
        return to_srgb(part, Transfer.HLG, primaries=BT2020, white=WHITE)

    np.testing.assert_array_equal(convert(pixels[100:130]), convert(pixels)[100:130])


def test_grays_of_wide_gamut_sdr_stay_as_they_are():
    signal = np.arange(256) / 255
    for primaries in (BT2020, P3):
        found = to_srgb(gray(signal), None, primaries=primaries, white=WHITE)[0]
        np.testing.assert_array_equal(found, np.repeat(np.arange(256)[:, None], 3, axis=1))


# Linear BT.709 as Display P3, published with CSS Color 4.
TO_P3 = np.array([[0.8224620, 0.1775380, 0], [0.0331942, 0.9668058, 0],
                  [0.0170826, 0.0723974, 0.9105199]])


@pytest.mark.parametrize(("primaries", "matrix"), [(BT2020, TO_BT2020), (P3, TO_P3)])
def test_colours_of_bt709_in_wide_gamut_sdr_come_back(primaries, matrix):
    colours = np.random.default_rng(0).integers(0, 256, (500, 3))
    light = srgb_light(colours / 255) @ matrix.T
    stored = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    found = to_srgb(sixteen_bits(stored)[None], None, primaries=primaries, white=WHITE)[0]
    assert np.abs(found.astype(int) - colours).max() <= 1  # the four digits of the matrices


def test_primaries_without_a_name_are_bt709_in_sdr():
    pixels = np.random.default_rng(0).integers(0, WHITE + 1, (1, 500, 3), dtype=np.uint16)
    found = to_srgb(pixels, None, primaries=2, white=WHITE)
    assert np.abs(found - pixels * (255 / WHITE)).max() <= 0.51
