"""TIFF files of all layouts of samples: right, or refused by name."""

from itertools import cycle, product

import numpy as np
import pytest
import tifffile
from facts import raises

from recon_cli.capture.images import (
    find_white,
    inspect_photo,
    read_alpha,
    read_as_stored,
    read_photo,
)
from recon_cli.errors import InputError

H, W = 20, 30
OTHER, ASSOCIATED, UNASSOCIATED = 0, 1, 2  # extra samples
# name: samples of a colour, photometric interpretation, extra samples
LAYOUTS = {
    "gray": (1, "minisblack", ()), "gray, other": (1, "minisblack", (OTHER,)),
    "gray, opacity": (1, "minisblack", (UNASSOCIATED,)),
    "gray, associated": (1, "minisblack", (ASSOCIATED,)), "white is zero": (1, "miniswhite", ()),
    "rgb": (3, "rgb", ()), "rgb, other": (3, "rgb", (OTHER,)),
    "rgb, opacity": (3, "rgb", (UNASSOCIATED,)), "rgb, associated": (3, "rgb", (ASSOCIATED,)),
    "rgb, two others": (3, "rgb", (OTHER, OTHER)),
    "rgb, opacity, other": (3, "rgb", (UNASSOCIATED, OTHER)),
    "cmyk": (4, "separated", ()), "cmyk, other": (4, "separated", (OTHER,)),
    "palette": (1, "palette", ()),
}
KINDS = {8: np.uint8, 16: np.uint16, 32: np.float32}
STORED = [(*stored, orientation) for stored, orientation in zip(
    product(("contig", "separate"), (None, (16, 16)), (False, True)), cycle((1, 6, 7)))]
# Layouts that Pillow may not open, by their planes and compression: read right, or named.
UNUSUAL = {(name, bits) for name, (colours, _, extra) in LAYOUTS.items() for bits in (8, 16)
           if OTHER in extra or (bits == 16 and colours == 1 and extra)} - {("rgb, other", 16)}
# Half a step where it is rounded, and another for each product of two values of 8 bits.
ROUNDED, MULTIPLIED = 0.51, 1.51
TURNS = {1: lambda p: p, 6: lambda p: np.rot90(p, -1),
         7: lambda p: p[::-1, ::-1].swapaxes(0, 1)}


def make_samples(name, bits):
    """Samples [H, W, S], and the values of 0 to 1 that they mean."""
    colours, _, extra = LAYOUTS[name]
    top = {8: 255, 16: 65535, 32: 1}[bits]
    values = np.random.default_rng(bits).random((H, W, colours + len(extra)))
    if ASSOCIATED in extra:
        values[..., :-1] *= values[..., -1:]
    samples = (values * top).astype(KINDS[bits]) if bits == 32 else np.rint(
        values * top).astype(KINDS[bits])
    return samples, samples.astype(float) / top


def shown(name, values):
    """RGB [H, W, 3] from 0 to 1 on black, by TIFF 6.0."""
    colours, photometric, extra = LAYOUTS[name]
    if photometric == "separated":
        rgb = (1 - values[..., :3]) * (1 - values[..., 3:4])
    elif photometric == "miniswhite":
        rgb = 1 - values[..., :1]
    else:
        rgb = values[..., :colours]
    if UNASSOCIATED in extra:
        rgb = rgb * values[..., colours:colours + 1]
    return np.broadcast_to(rgb, (*values.shape[:2], 3))


def write(path, name, samples, plan="contig", tile=None, orientation=1, differences=False):
    _, photometric, extra = LAYOUTS[name]
    data = samples[..., 0] if samples.shape[2] == 1 else (
        np.moveaxis(samples, 2, 0) if plan == "separate" else samples)
    options = {"colormap": np.tile(np.arange(256, dtype=np.uint16) * 257, (3, 1))} if (
        photometric == "palette") else {}
    if differences:
        options |= {"compression": "zlib", "predictor": samples.dtype.kind == "u" or None}
    tifffile.imwrite(
        path, data, photometric=photometric, extrasamples=extra or None, tile=tile, metadata=None,
        planarconfig=plan if samples.shape[2] > 1 else None, rowsperstrip=None if tile else 7,
        extratags=[(274, "H", 1, orientation, True)], **options)
    return path


@pytest.mark.parametrize("bits", KINDS)
@pytest.mark.parametrize("name", LAYOUTS)
def test_all_layouts_of_samples_are_right_or_refused_by_name(tmp_path, name, bits):
    samples, values = make_samples(name, bits)
    most = MULTIPLIED if LAYOUTS[name][2] else ROUNDED
    for at, (plan, tile, differences, orientation) in enumerate(STORED):
        if name == "palette" and bits != 8:
            continue  # there is none
        path = write(tmp_path / f"{at}.tif", name, samples, plan, tile, orientation, differences)
        if bits == 32:
            check_named(path, "floating")
            continue
        try:
            found = inspect_photo(path)
        except InputError:
            assert (name, bits) in UNUSUAL
            check_named(path, bits)
            continue
        expected = TURNS[orientation](255 * shown(name, values))
        assert (found.height, found.width) == expected.shape[:2]
        off = np.abs(read_photo(found) - expected).max()
        assert off <= most, (plan, tile, orientation, differences, off)


def check_named(path, fact):
    with raises(InputError, path.name, fact) as error:
        read_photo(inspect_photo(path))
    assert "again" not in error.value.hint  # it is not damaged


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", ["rgb, opacity", "rgb, associated"])
def test_opacity_of_tiff_is_told(tmp_path, name, bits):
    samples, values = make_samples(name, bits)
    found = inspect_photo(write(tmp_path / "a.tif", name, samples))
    assert np.abs(read_alpha(found) - 255 * values[..., 3]).max() <= ROUNDED


def test_a_fourth_sample_that_is_no_opacity_is_none(tmp_path):
    samples, _ = make_samples("rgb, other", 16)
    assert read_alpha(inspect_photo(write(tmp_path / "a.tif", "rgb, other", samples))) is None


@pytest.mark.parametrize(("order", "big"), [("<", False), (">", False), ("<", True)])
@pytest.mark.parametrize("name", ["gray", "rgb", "rgb, opacity"])
def test_either_byte_order_and_large_files_are_read(tmp_path, name, order, big):
    samples, values = make_samples(name, 16)
    tifffile.imwrite(
        tmp_path / "a.tif", samples, photometric=LAYOUTS[name][1], byteorder=order, bigtiff=big,
        extrasamples=LAYOUTS[name][2] or None)
    found = read_photo(inspect_photo(tmp_path / "a.tif"))
    assert np.abs(found - 255 * shown(name, values)).max() <= MULTIPLIED


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize(("name", "bits"), [("gray", 8), ("rgb", 8), ("rgb", 16)])
def test_images_of_data_sets_stay_as_stored(tmp_path, name, bits, orientation):
    samples, values = make_samples(name, bits)
    path = write(tmp_path / "a.tif", name, samples, orientation=orientation)
    assert np.abs(read_as_stored(path)[0] - 255 * values).max() <= ROUNDED


def test_opacity_does_not_hide_that_values_have_12_bits(tmp_path):
    samples, _ = make_samples("rgb, opacity", 16)
    samples[..., :3] >>= 4
    path = write(tmp_path / "a.tif", "rgb, opacity", samples)
    assert find_white([path]) == 4095
