"""Photos whose colours are told by codes of H.273 or by EXIF: HDR, wide gamuts, Adobe RGB."""

import struct
import zlib

import av
import cv2
import numpy as np
import pillow_heif
import pytest
from colour_formulas import (
    COLOURS,
    HLG,
    PQ,
    XY,
    centres,
    displayed,
    frame_of,
    srgb_encode,
    to_codes,
    to_xyz,
)
from media import turn_heic
from PIL import Image, ImageCms
from test_colour_profile import SRGB, profile

from recon_cli.capture.images import inspect_photo, read_as_stored, read_gray, read_photo
from recon_cli.capture.video_colour import BT709, BT2020, P3, Transfer

SDR, UNKNOWN = 13, 2  # codes of H.273: sRGB, unspecified
BLOCK, COLUMNS = 16, 25
# dB from the formulas. Codes of 8 or 10 bits and the encoders leave 43 to 59; PQ or HLG that is
# taken for sRGB is 10 to 20 from them.
LEAST = 42


def blocks(signals, top=65535):
    """A picture with a block for each of `COLOURS`, [H, W, 3]."""
    rows = -(-len(signals) // COLUMNS)
    cells = np.zeros((rows * COLUMNS, 3))
    cells[:len(signals)] = signals
    picture = cells.reshape(rows, COLUMNS, 3).repeat(BLOCK, 0).repeat(BLOCK, 1)
    return np.round(picture * top).astype(np.uint16 if top > 255 else np.uint8)


def write_heic(path, primaries, transfer, mode="RGB;16"):
    pillow_heif.options.SAVE_HDR_TO_12_BIT = False
    pixels = blocks(COLOURS)
    if mode == "RGBA;16":
        pixels = np.dstack([pixels, np.full(pixels.shape[:2], 65535, np.uint16)])
    height, width = pixels.shape[:2]
    pillow_heif.encode(
        mode, (width, height), pixels.tobytes(), str(path), quality=-1, chroma=444,
        color_primaries=primaries, transfer_characteristics=transfer, matrix_coefficients=BT2020,
        full_range_flag=1)
    return path


def write_avif(path, primaries, transfer):
    codes = to_codes(COLOURS, BT2020, full=True, bits=10)
    frame = frame_of(codes, "yuv420p10le", matrix=BT2020, full=True)
    with av.open(str(path), "w", format="avif") as container:
        stream = container.add_stream("libsvtav1", rate=1)
        stream.width, stream.height, stream.pix_fmt = frame.width, frame.height, "yuv420p10le"
        context = stream.codec_context
        context.color_trc, context.color_primaries = transfer, primaries
        context.colorspace, context.color_range = BT2020, 2
        context.options = {"crf": "1", "preset": "8"}
        container.mux([*stream.encode(frame), *stream.encode()])
    return path


def add_chunk(png, kind, body):
    """Returns a PNG with a chunk behind its header."""
    chunk = struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    return png[:33] + chunk + png[33:]


def write_png(path, primaries, transfer, bits=16):
    pixels = blocks(COLOURS, 2**bits - 1)
    cv2.imwrite(str(path), pixels[..., ::-1])
    path.write_bytes(add_chunk(
        path.read_bytes(), b"cICP", bytes([primaries, transfer, 0, 1])))
    return path


def profile_with_codes(primaries, transfer):
    """An ICC profile with a cicp tag (ICC.1:2022, 9.2.17), as writers of HDR embed."""
    data = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    count, = struct.unpack_from(">I", data, 128)
    body = bytearray(data[:128] + struct.pack(">I", count + 1) + data[132:132 + 12 * count]
                     + struct.pack(">4sII", b"cicp", len(data) + 12, 12) + data[132 + 12 * count:]
                     + b"cicp" + bytes(4) + bytes([primaries, transfer, 0, 1]))
    for at in range(count):
        place = 132 + 12 * at + 4
        struct.pack_into(">I", body, place, struct.unpack_from(">I", body, place)[0] + 12)
    struct.pack_into(">I", body, 0, len(body))
    return bytes(body)


def write_profiled(path, primaries, transfer):
    Image.fromarray(blocks(COLOURS, 255)).save(
        path, icc_profile=profile_with_codes(primaries, transfer))
    return path


WRITERS = {"heic": write_heic, "avif": write_avif, "png": write_png, "icc.png": write_profiled}


def psnr(found, expected):
    off = np.mean((np.asarray(found, float) - expected) ** 2)
    return -10 * np.log10(max(off, 1e-9) / 255**2)


@pytest.mark.parametrize("primaries", [BT2020, P3])
@pytest.mark.parametrize("transfer", [PQ, HLG])
@pytest.mark.parametrize("kind", WRITERS)
def test_photos_in_hdr_get_the_conversion_of_video(tmp_path, kind, transfer, primaries):
    path = WRITERS[kind](tmp_path / f"a.{kind}", primaries, transfer)
    expected = displayed(COLOURS, transfer, primaries)
    photo = inspect_photo(path)
    assert psnr(centres(read_photo(photo)), expected) > LEAST
    assert psnr(255 * COLOURS, expected) < 20  # it makes a difference
    assert photo.coding == (primaries, Transfer.PQ if transfer == PQ else Transfer.HLG)
    np.testing.assert_array_equal(read_as_stored(path)[0], read_photo(photo))
    gray = cv2.cvtColor(read_photo(photo), cv2.COLOR_RGB2GRAY)
    np.testing.assert_array_equal(read_gray(photo), gray)


@pytest.mark.parametrize("kind", WRITERS)
def test_hdr_without_primaries_has_those_of_bt2020_and_says_so(tmp_path, kind):
    photo = inspect_photo(WRITERS[kind](tmp_path / f"a.{kind}", UNKNOWN, HLG))
    assert psnr(centres(read_photo(photo)), displayed(COLOURS, HLG, BT2020)) > LEAST
    assert "BT.2020" in photo.coding.words


@pytest.mark.parametrize("kind", ["heic", "avif", "png"])
@pytest.mark.parametrize("primaries", [BT2020, P3])
def test_wide_gamuts_of_sdr_become_srgb(tmp_path, kind, primaries):
    photo = inspect_photo(WRITERS[kind](tmp_path / f"a.{kind}", primaries, SDR))
    assert photo.coding == (primaries, None)
    assert psnr(centres(read_photo(photo)), displayed(COLOURS, SDR, primaries)) > LEAST


@pytest.mark.parametrize("kind", ["heic", "avif", "png"])
@pytest.mark.parametrize("primaries", [BT709, UNKNOWN])
def test_srgb_by_its_codes_stays(tmp_path, kind, primaries):
    photo = inspect_photo(WRITERS[kind](tmp_path / f"a.{kind}", primaries, SDR))
    assert photo.coding is None
    assert psnr(centres(read_photo(photo)), 255 * COLOURS) > LEAST


@pytest.mark.parametrize("kind", ["heic", "avif"])
def test_codes_that_only_the_stream_holds_are_found(tmp_path, kind):
    path = WRITERS[kind](tmp_path / f"a.{kind}", BT2020, PQ)
    data = path.read_bytes()
    assert data.count(b"colrnclx") == 1
    path.write_bytes(data.replace(b"colrnclx", b"freenclx"))
    photo = inspect_photo(path)
    assert photo.coding == (BT2020, Transfer.PQ)


def test_opacity_and_turns_survive_the_conversion(tmp_path):
    path = write_heic(tmp_path / "a.heic", BT2020, PQ, "RGBA;16")
    rgb, alpha = read_as_stored(path)
    assert alpha.min() > 250
    assert psnr(centres(rgb), displayed(COLOURS, PQ, BT2020)) > LEAST
    turned = inspect_photo(turn_heic(path, 1))
    assert (turned.width, turned.height) == rgb.shape[:2]
    assert psnr(np.rot90(read_photo(turned), -1), rgb) > LEAST


def adobe_rgb():
    """Adobe RGB (1998), 4.3: the signal of `COLOURS` there, in sRGB of 255."""
    adobe = to_xyz(((0.64, 0.33), (0.21, 0.71), (0.15, 0.06)))
    light = COLOURS ** (563 / 256) @ (np.linalg.inv(to_xyz(XY[1])) @ adobe).T
    return 255 * srgb_encode(light)


def write_exif(path, space, index="", **options):
    exif = Image.Exif()
    exif.get_ifd(EXIF)[COLOR_SPACE] = space
    if index:
        exif.get_ifd(EXIF)[INTEROP] = {1: index}
    Image.fromarray(blocks(COLOURS, 255)).save(path, exif=exif, quality=100, **options)
    return path


EXIF, INTEROP, COLOR_SPACE = 0x8769, 0xA005, 0xA001


@pytest.mark.parametrize("name", ["a.jpg", "a.webp"])
@pytest.mark.parametrize(("space", "index"), [(0xFFFF, "R03"), (2, "")])
def test_adobe_rgb_is_told_by_exif_alone(tmp_path, name, space, index):
    options = {"subsampling": 0} if name == "a.jpg" else {"lossless": True}
    photo = inspect_photo(write_exif(tmp_path / name, space, index, **options))
    assert psnr(centres(read_photo(photo)), adobe_rgb()) > LEAST
    assert psnr(255 * COLOURS, adobe_rgb()) < 30
    assert "Adobe RGB" in photo.coding.words


@pytest.mark.parametrize(("space", "index", "icc"), [
    (1, "R98", None), (0xFFFF, "", None), (1, "R03", None), (0xFFFF, "R03", profile(SRGB))])
def test_other_photos_are_not_taken_for_adobe_rgb(tmp_path, space, index, icc):
    path = write_exif(tmp_path / "a.jpg", space, index, subsampling=0, icc_profile=icc)
    assert inspect_photo(path).coding is None
    with Image.open(path) as image:
        np.testing.assert_array_equal(read_photo(inspect_photo(path)), np.asarray(image))


def test_a_profile_counts_before_codes_of_sdr(tmp_path):
    path = tmp_path / "a.heic"
    pillow_heif.from_pillow(Image.fromarray(blocks(COLOURS, 255))).save(
        str(path), quality=-1, chroma=444, icc_profile=profile(SRGB), color_primaries=P3,
        transfer_characteristics=SDR, matrix_coefficients=0)
    assert inspect_photo(path).coding is None
    assert psnr(centres(read_photo(inspect_photo(path))), 255 * COLOURS) > LEAST
