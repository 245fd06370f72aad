"""Display P3 becomes sRGB by the formula; sRGB stays as it is."""

import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image, ImageCms

from recon_cli.capture.colour_profile import to_srgb
from recon_cli.capture.images import inspect_photo, read_as_stored, read_photo

# Columns are red, green and blue in XYZ under D50 (Bradford), as ICC profiles hold them.
P3 = np.array([[0.515102, 0.291965, 0.157153], [0.241182, 0.692236, 0.0665819],
               [-0.00104941, 0.0418818, 0.784378]])
SRGB = np.array([[0.4360747, 0.3850649, 0.1430804], [0.2225045, 0.7168786, 0.0606169],
                 [0.0139322, 0.0971045, 0.7141733]])
WHITE = (0.9642, 1.0, 0.8249)


def linear(values):
    values = np.asarray(values, float)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def encoded(values):
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)


def profile(matrix):
    """Returns the bytes of an RGB display profile with sRGB's curve and these primaries."""
    def number(value):
        return struct.pack(">i", round(value * 65536))

    def xyz(values):
        return b"XYZ " + bytes(4) + b"".join(map(number, values))

    curve = b"para" + bytes(4) + struct.pack(">HH", 3, 0) + b"".join(
        map(number, (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)))
    text = b"desc" + bytes(4) + struct.pack(">I", 5) + b"Test\0" + bytes(78)
    tags = {b"desc": text, b"wtpt": xyz(WHITE), b"rXYZ": xyz(matrix[:, 0]),
            b"gXYZ": xyz(matrix[:, 1]), b"bXYZ": xyz(matrix[:, 2]),
            b"rTRC": curve, b"gTRC": curve, b"bTRC": curve}
    table, data = struct.pack(">I", len(tags)), b""
    for name, value in tags.items():
        table += name + struct.pack(">II", 132 + 12 * len(tags) + len(data), len(value))
        data += value + bytes(-len(value) % 4)
    head = struct.pack(">I", 128 + len(table) + len(data)) + bytes(4) + struct.pack(
        ">I", 0x04000000) + b"mntrRGB XYZ " + bytes(12) + b"acsp" + bytes(28) + b"".join(
        map(number, WHITE)) + bytes(48)
    return head + table + data


COLOURS = np.random.default_rng(0).integers(0, 256, (16, 16, 3), np.uint8)


def expected(matrix):
    """The formula in float64, clipped to what sRGB can show."""
    light = linear(COLOURS / 255) @ (np.linalg.inv(SRGB) @ matrix).T
    return encoded(light.clip(0, 1)) * 255


def test_display_p3_becomes_srgb_by_the_formula(tmp_path):
    Image.fromarray(COLOURS).save(tmp_path / "a.png", icc_profile=profile(P3))
    shown = read_photo(inspect_photo(tmp_path / "a.png")).astype(float)
    assert np.abs(shown - COLOURS).max() > 30  # it makes a difference
    assert np.abs(shown - expected(P3)).max() <= 2
    np.testing.assert_array_equal(read_as_stored(tmp_path / "a.png")[0], shown)


def test_colours_of_sixteen_bits_are_converted_too(tmp_path):
    cv2.imwrite(str(tmp_path / "wide.png"), COLOURS[:, :, ::-1].astype(np.uint16) * 257)
    data = (tmp_path / "wide.png").read_bytes()
    body = b"iCCP" + b"p3\0\0" + zlib.compress(profile(P3))
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    (tmp_path / "wide.png").write_bytes(data[:33] + chunk + data[33:])
    shown = read_photo(inspect_photo(tmp_path / "wide.png")).astype(float)
    assert np.abs(shown - expected(P3)).max() <= 2


@pytest.mark.parametrize("icc", [
    ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes(), profile(SRGB), b"broken",
    b""])
def test_srgb_and_what_is_no_profile_change_nothing(icc):
    image = Image.fromarray(COLOURS)
    image.info["icc_profile"] = icc
    assert to_srgb(image) is image


def test_opacity_survives():
    rgba = np.dstack([COLOURS, np.arange(256, dtype=np.uint8).reshape(16, 16)])
    image = Image.fromarray(rgba)
    image.info["icc_profile"] = profile(P3)
    shown = np.asarray(to_srgb(image))
    np.testing.assert_array_equal(shown[..., 3], rgba[..., 3])
    assert np.abs(shown[..., :3] - expected(P3)).max() <= 2


def test_gray_has_no_colours_to_convert():
    image = Image.fromarray(COLOURS[..., 0])
    image.info["icc_profile"] = profile(P3)
    assert to_srgb(image) is image
