"""Photos: size, lens by EXIF and pixels."""

import struct
import zlib
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from facts import raises
from media import texture, turn_heic
from PIL import Image

from recon_cli.capture import images
from recon_cli.capture.exif import ExifLens, read_lens
from recon_cli.capture.images import (
    Photo,
    find_white,
    inspect_photo,
    read_alpha,
    read_photo,
)
from recon_cli.capture.photos import list_photos
from recon_cli.errors import InputError
from recon_cli.io.images import write_png

pytestmark = pytest.mark.floors

ORIENTATION, GPS = 0x0112, 0x8825


def picture():
    return texture(48, 64, coarseness=16)


def photo_of(path):
    return read_photo(inspect_photo(path))


UPRIGHT = [
    (1, lambda p: p),
    (2, lambda p: p[:, ::-1]),
    (3, lambda p: p[::-1, ::-1]),
    (4, lambda p: p[::-1]),
    (5, lambda p: p.transpose(1, 0, 2)),
    (6, lambda p: np.rot90(p, -1)),
    (7, lambda p: p[::-1, ::-1].transpose(1, 0, 2)),
    (8, lambda p: np.rot90(p, 1)),
]


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.webp"])
@pytest.mark.parametrize(("orientation", "upright"), UPRIGHT)
def test_the_orientation_of_exif_is_applied_once(tmp_path, name, orientation, upright):
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    options = {"lossless": True} if name.endswith("webp") else {}
    Image.fromarray(picture()).save(tmp_path / name, exif=exif, **options)
    found = inspect_photo(tmp_path / name)
    expected = upright(picture())
    assert (found.height, found.width) == expected.shape[:2]
    np.testing.assert_array_equal(read_photo(found), expected)


@pytest.mark.parametrize(("orientation", "upright"), UPRIGHT)
def test_a_tiff_of_sixteen_bits_is_turned_once_too(tmp_path, orientation, upright):
    tifffile = pytest.importorskip("tifffile", reason="tifffile writes what Pillow cannot")
    wide, eight = wide_picture(3)
    tifffile.imwrite(
        tmp_path / "a.tif", wide, photometric="rgb",
        extratags=[(ORIENTATION, "H", 1, orientation, True)])
    found = inspect_photo(tmp_path / "a.tif")
    expected = upright(eight)
    assert (found.height, found.width) == expected.shape[:2]
    np.testing.assert_array_equal(read_photo(found), expected)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.bmp", "a.ppm", "a.webp"])
def test_lossless_formats_come_out_unchanged(tmp_path, name):
    options = {"lossless": True} if name.endswith("webp") else {}
    Image.fromarray(picture()).save(tmp_path / name, **options)
    np.testing.assert_array_equal(photo_of(tmp_path / name), picture())


def test_a_photo_is_known_by_its_content_not_by_its_name(tmp_path):
    Image.fromarray(picture()).save(tmp_path / "a.png")
    path = (tmp_path / "a.png").rename(tmp_path / "a.jpg")
    np.testing.assert_array_equal(photo_of(path), picture())


@pytest.mark.parametrize("mode", ["L", "CMYK", "P", "1"])
def test_other_colour_modes_become_rgb(tmp_path, mode):
    image = Image.fromarray(picture()).convert(mode)
    image.save(tmp_path / "a.tif")
    rgb = photo_of(tmp_path / "a.tif")
    np.testing.assert_array_equal(rgb, np.asarray(image.convert("RGB")))
    assert rgb.shape == (48, 64, 3)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_sixteen_bits_are_scaled_not_cut_off(tmp_path, name):
    values = np.array([[0, 257, 128 * 257], [65535, 200 * 257 + 100, 1]], np.uint16)
    Image.fromarray(np.kron(values, np.ones((8, 8), np.uint16))).save(tmp_path / name)
    rgb = photo_of(tmp_path / name)
    assert rgb[::8, ::8, 0].tolist() == [[0, 1, 128], [255, 200, 0]]
    assert (rgb[..., 0] == rgb[..., 2]).all()


def wide_picture(channels):
    values = np.random.default_rng(0).integers(0, 65536, (48, 64, channels), dtype=np.uint16)
    return values, np.round(values / 257).astype(np.uint8)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
@pytest.mark.parametrize("channels", [3, 4])
def test_colours_of_sixteen_bits_are_rounded_to_eight(tmp_path, name, channels):
    wide, expected = wide_picture(channels)
    if channels == 4:
        wide[..., 3] = 65535
    order = [2, 1, 0, 3][:channels]
    cv2.imwrite(str(tmp_path / name), wide[..., order])
    np.testing.assert_array_equal(photo_of(tmp_path / name), expected[..., :3])


def test_colours_of_sixteen_bits_are_turned_once(tmp_path):
    wide, expected = wide_picture(3)
    cv2.imwrite(str(tmp_path / "a.png"), wide[..., ::-1])
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(with_exif_chunk(data, exif.tobytes()[6:]))
    found = inspect_photo(tmp_path / "a.png")
    assert (found.width, found.height) == (48, 64)
    np.testing.assert_array_equal(read_photo(found), np.rot90(expected, -1))


def with_exif_chunk(png, exif):
    """Returns a PNG with EXIF before its pixels."""
    chunk = b"eXIf" + exif
    at = png.index(b"IDAT") - 4
    return b"".join([
        png[:at], len(exif).to_bytes(4, "big"), chunk, zlib.crc32(chunk).to_bytes(4, "big"),
        png[at:]])


def test_gray_of_sixteen_bits_with_alpha_is_scaled_too(tmp_path):
    gray = np.full((8, 8), 200 * 257, np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), np.dstack([gray, gray, gray, gray * 0]))
    assert (photo_of(tmp_path / "a.png") == 0).all()
    assert (read_alpha(inspect_photo(tmp_path / "a.png")) == 0).all()


@pytest.mark.parametrize("mode", ["RGB", "CMYK"])
def test_a_jpeg_in_the_colours_of_print_looks_like_one_in_rgb(tmp_path, mode):
    # Pillow writes CMYK as Adobe does, inverted, with Adobe's marker.
    smooth = cv2.GaussianBlur(picture(), (0, 0), 6)
    Image.fromarray(smooth).convert(mode).save(tmp_path / "a.jpg", quality=98, subsampling=0)
    assert b"Adobe" in (tmp_path / "a.jpg").read_bytes() or mode == "RGB"
    difference = photo_of(tmp_path / "a.jpg").astype(int) - smooth
    assert np.abs(difference).max() < 12  # of JPEG; inverted colours differ by up to 195


DEEP_MODES = {"gray": 1, "gbrp": 3, "gbrap": 4}  # channels, by the name in FFmpeg


@pytest.mark.parametrize("bits", [9, 10, 12, 14, 16])
@pytest.mark.parametrize("planes", DEEP_MODES)
@pytest.mark.parametrize("name", ["a.jp2", "a.j2k"])
def test_jpeg_2000_of_more_than_eight_bits_keeps_white(tmp_path, name, planes, bits):
    if (planes, bits) in {("gbrap", 9), ("gbrap", 14)}:
        pytest.skip("FFmpeg does not write it")
    top = 2**bits - 1
    values = np.random.default_rng(bits).integers(0, top + 1, (48, 64, DEEP_MODES[planes]))
    values[:16, :16] = top
    if planes == "gbrap":
        values[..., 3] = top
    write_jpeg2000(tmp_path / name, values, planes, bits)
    found = inspect_photo(tmp_path / name)
    assert found.wide
    off = np.abs(read_photo(found) - 255 * values[..., :3] / top)
    assert off.max() <= 0.51  # a half, and what 16 bits of 2^bits - 1 leave


def write_jpeg2000(path, values, planes, bits):
    """Writes [H, W, C] without loss."""
    frame = av.VideoFrame(values.shape[1], values.shape[0], f"{planes}{bits}le")
    order = [1, 2, 0, 3][:values.shape[2]] if planes != "gray" else [0]
    for plane, channel in zip(frame.planes, order, strict=True):
        lines = np.zeros((plane.height, plane.line_size // 2), "<u2")
        lines[:, :values.shape[1]] = values[..., channel]
        plane.update(lines.tobytes())
    context = av.CodecContext.create("jpeg2000", "w")
    context.width, context.height, context.pix_fmt = frame.width, frame.height, frame.format.name
    context.time_base = Fraction(1, 1)
    context.options = {"pred": "1", "format": "jp2" if path.suffix == ".jp2" else "j2k"}
    path.write_bytes(b"".join(bytes(packet) for packet in [
        *context.encode(frame), *context.encode()]))


def test_gray_jpeg_2000_of_16_bits_with_opacity_is_refused_by_name(tmp_path):
    frame = av.VideoFrame(64, 48, "ya16le")
    context = av.CodecContext.create("jpeg2000", "w")
    context.width, context.height, context.pix_fmt = 64, 48, "ya16le"
    context.time_base = Fraction(1, 1)
    (tmp_path / "a.jp2").write_bytes(b"".join(map(bytes, context.encode(frame))))
    with raises(InputError, "LA", 16, "bits") as error:
        photo_of(tmp_path / "a.jp2")
    assert "not damaged" in error.value.hint


@pytest.mark.parametrize("masks", [(0xF800, 0x7E0, 0x1F), (0x7C00, 0x3E0, 0x1F)])
def test_bitmaps_with_five_or_six_bits_a_colour_are_read(tmp_path, masks):
    packed = np.random.default_rng(0).integers(0, 65536, (48, 64)).astype("<u2")
    head = struct.pack("<IiiHHIIiiII", 40, 64, 48, 1, 16, 3, packed.nbytes, 0, 0, 0, 0)
    head += struct.pack("<3I", *masks)
    (tmp_path / "a.bmp").write_bytes(
        struct.pack("<2sIHHI", b"BM", 14 + len(head) + packed.nbytes, 0, 0, 14 + len(head))
        + head + packed[::-1].tobytes())
    colours = [(packed & mask) / mask * 255 for mask in masks]
    assert np.abs(photo_of(tmp_path / "a.bmp") - np.stack(colours, 2)).max() <= 1


def test_integers_beyond_sixteen_bits_are_refused(tmp_path):
    Image.fromarray(np.full((8, 8), 70000, np.int32)).save(tmp_path / "a.tif")
    with raises(InputError, 70000):
        photo_of(tmp_path / "a.tif")


def heic(path, *, orientation=1, turns=0):
    """Writes the picture, larger, for HEIC codes blocks of 64 pixels."""
    pixels = texture(64, 96, coarseness=32)
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    Image.fromarray(pixels).save(path, exif=exif, quality=95)
    return turn_heic(path, turns), pixels


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
@pytest.mark.parametrize("orientation", [1, 6])
def test_heic_is_turned_once_by_its_own_box_and_not_by_exif(tmp_path, turns, orientation):
    inspect_any(tmp_path)  # makes HEIC known to Pillow
    path, pixels = heic(tmp_path / "a.heic", orientation=orientation, turns=turns)
    expected = np.rot90(pixels, turns)
    found = inspect_photo(path)
    assert (found.height, found.width) == expected.shape[:2]
    difference = np.abs(read_photo(found).astype(int) - expected)
    assert np.median(difference) < 8  # of compression; wrongly turned, it is above 40


def inspect_any(folder):
    Image.new("RGB", (8, 8)).save(folder / "any.png")
    inspect_photo(folder / "any.png")


def test_a_frame_carries_neither_place_nor_camera(tmp_path):
    exif = Image.Exif()
    exif[0x0110] = "Camera 7"
    exif.get_ifd(GPS)[1] = "N"
    Image.fromarray(picture()).save(tmp_path / "a.jpg", exif=exif, comment=b"at home")
    write_png(tmp_path / "frame.png", photo_of(tmp_path / "a.jpg"))
    with Image.open(tmp_path / "frame.png") as frame:
        assert not frame.getexif()
        assert not frame.info
    assert b"Camera 7" not in (tmp_path / "frame.png").read_bytes()


def test_opacity_is_told_apart_from_colour_and_turned_with_it(tmp_path):
    rgba = np.dstack([picture(), np.full((48, 64), 255, np.uint8)])
    rgba[:10, :20, 3] = 0
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.fromarray(rgba).save(tmp_path / "a.png", exif=exif)
    alpha = read_alpha(inspect_photo(tmp_path / "a.png"))
    np.testing.assert_array_equal(alpha, np.rot90(rgba[..., 3], -1))
    Image.fromarray(picture()).save(tmp_path / "b.png")
    assert read_alpha(inspect_photo(tmp_path / "b.png")) is None


@pytest.mark.parametrize("mode", ["LA", "P"])
def test_gray_and_palettes_may_be_transparent(tmp_path, mode):
    alpha = np.full((8, 8), 255, np.uint8)
    alpha[:4] = 0
    if mode == "LA":
        image = Image.fromarray(np.dstack([np.full((8, 8), 200, np.uint8), alpha]), "LA")
        image.save(tmp_path / "a.png")
    else:
        image = Image.fromarray((alpha > 0).astype(np.uint8), "P")
        image.putpalette([9, 9, 9, 200, 200, 200])
        image.save(tmp_path / "a.png", transparency=0)
    photo = inspect_photo(tmp_path / "a.png")
    np.testing.assert_array_equal(read_alpha(photo), alpha)
    np.testing.assert_array_equal(read_photo(photo)[..., 1], np.where(alpha, 200, 0))


def test_what_is_transparent_shows_black(tmp_path):
    rgba = np.dstack([np.full((8, 8, 3), 200, np.uint8), np.full((8, 8), 255, np.uint8)])
    rgba[:4, :, 3] = 0
    Image.fromarray(rgba).save(tmp_path / "a.png")
    rgb = photo_of(tmp_path / "a.png")
    assert (rgb[:4] == 0).all()
    assert (rgb[4:] == 200).all()


@pytest.mark.integration
@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.webp", "a.heic"])
def test_half_a_photo_is_refused(tmp_path, name):
    inspect_any(tmp_path)
    noise = np.random.default_rng(0).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / name)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[:len(data) // 2])
    with raises(InputError, name):
        photo_of(tmp_path / name)


@pytest.mark.parametrize("content", [b"", b"no picture", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_picture_is_refused(tmp_path, content):
    (tmp_path / "a.jpg").write_bytes(content)
    with raises(InputError, "a.jpg"):
        inspect_photo(tmp_path / "a.jpg")


@pytest.mark.parametrize(("content", "reason"), [(b"", "empty"), (b"no picture", "format")])
def test_a_file_that_is_no_picture_is_refused_in_plain_words(tmp_path, content, reason):
    (tmp_path / "a.jpg").write_bytes(content)
    with raises(InputError, "a.jpg", reason) as caught:
        inspect_photo(tmp_path / "a.jpg")
    assert "/" not in caught.value.message


def test_floating_point_colours_are_refused_too(tmp_path):
    cv2.imwrite(str(tmp_path / "a.tif"), np.ones((8, 8, 3), np.float32))
    with raises(InputError, "a.tif"):
        photo_of(tmp_path / "a.tif")


def test_floating_point_pixels_are_refused_because_their_range_is_unknown(tmp_path):
    Image.fromarray(np.ones((8, 8), np.float32)).save(tmp_path / "a.tif")
    with raises(InputError, "floating", "point"):
        photo_of(tmp_path / "a.tif")


def test_pixels_that_memory_does_not_hold_are_refused(tmp_path, monkeypatch):
    Image.fromarray(picture()).save(tmp_path / "a.png")
    monkeypatch.setattr(images, "free_memory_bytes", lambda: 3072 * 10)
    with raises(InputError, "64x48") as error:
        inspect_photo(tmp_path / "a.png")
    assert "again" not in error.value.hint


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "wide.tif"])
def test_memory_and_not_pillow_sets_the_limit(tmp_path, monkeypatch, recwarn, name):
    if name == "wide.tif":
        cv2.imwrite(str(tmp_path / name), picture().astype(np.uint16) * 257)
    else:
        Image.fromarray(picture()).save(tmp_path / name)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)  # the picture has 3072
    assert photo_of(tmp_path / name).shape == (48, 64, 3)
    assert Image.MAX_IMAGE_PIXELS == 1000
    assert not recwarn.list


def test_jpeg_xl_is_named_where_its_package_is_not_installed(tmp_path, monkeypatch):
    (tmp_path / "a.jxl").write_bytes(b"\xff\x0a" + bytes(100))
    known = tuple(name for name in images._formats() if name != "JXL")
    monkeypatch.setattr(images, "_formats", lambda: known)
    with raises(InputError, "JPEG", "XL") as error:
        inspect_photo(tmp_path / "a.jxl")
    assert "pillow-jxl-plugin" in error.value.hint
    assert list_photos(tmp_path.iterdir()).broken


@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L"])
def test_jpeg_xl_is_read_and_turned_once(tmp_path, mode, orientation):
    pytest.importorskip("pillow_jxl", reason="pillow-jxl-plugin reads JPEG XL")
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    image = Image.fromarray(picture()).convert(mode)
    image.save(tmp_path / "a.jxl", lossless=True, exif=exif.tobytes())
    found = inspect_photo(tmp_path / "a.jxl")
    np.testing.assert_array_equal(read_photo(found), np.asarray(image.convert("RGB")))


def test_a_jpeg_that_was_repacked_as_jpeg_xl_is_turned_as_before(tmp_path):
    pytest.importorskip("pillow_jxl", reason="pillow-jxl-plugin reads JPEG XL")
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.fromarray(picture()).save(tmp_path / "a.jpg", exif=exif)
    with Image.open(tmp_path / "a.jpg") as image:
        image.save(tmp_path / "a.jxl", lossless_jpeg=True)
    expected = photo_of(tmp_path / "a.jpg")
    np.testing.assert_array_equal(photo_of(tmp_path / "a.jxl"), expected)


def test_documents_are_no_photos(tmp_path):
    (tmp_path / "a.eps").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    with pytest.raises(InputError):
        inspect_photo(tmp_path / "a.eps")


def test_pixels_of_another_size_than_the_header_says_are_refused(tmp_path):
    Image.fromarray(picture()).save(tmp_path / "a.png")
    with raises(InputError, "64x48", "64x50"):
        read_photo(Photo(tmp_path / "a.png", 64, 50, None))


EXIF, MAKE, MODEL = 0x8769, 0x010F, 0x0110
FOCAL, FOCAL_35MM, WIDE, HIGH = 0x920A, 0xA405, 0xA002, 0xA003
PLANE_X, PLANE_UNIT = 0xA20E, 0xA210
INCH, CENTIMETRE = 2, 3


def exif_of(detail, **main):
    exif = Image.Exif()
    exif.get_ifd(EXIF).update(detail)
    for tag, value in main.items():
        exif[{"make": MAKE, "model": MODEL}[tag]] = value
    return exif


def lens_of(detail, width=2016, height=1512, **main):
    return read_lens(exif_of(detail, **main), width, height)


def test_the_focal_length_follows_from_the_film_equivalent(tmp_path):
    exif = exif_of({FOCAL: 4.36, FOCAL_35MM: 26}, make="LGE", model="LM-V510N")
    Image.new("RGB", (2016, 1512)).save(tmp_path / "a.jpg", exif=exif)
    Image.new("RGB", (2016, 1512)).save(tmp_path / "b.jpg")
    # 26 mm on 43.267 mm of diagonal; the diagonal of 4:3 is 5/4 of the width.
    found = inspect_photo(tmp_path / "a.jpg")
    assert found.focal_px == pytest.approx(2520 * 26 / 43.267)
    assert (found.focal_mm, found.camera) == (pytest.approx(4.36), "LGE LM-V510N")
    assert inspect_photo(tmp_path / "b.jpg").focal_px is None


@pytest.mark.parametrize(("density", "unit"), [(6000 / 36 * 25.4, INCH), (6000 / 3.6, CENTIMETRE)])
def test_without_it_the_sensor_follows_from_the_resolution_of_the_focal_plane(density, unit):
    detail = {FOCAL: 50.0, PLANE_X: density, PLANE_UNIT: unit, WIDE: 6000, HIGH: 4000}
    # A sensor of 36 mm; the photo was reduced to a third since.
    assert lens_of(detail, 2000, 1333).focal_px == pytest.approx(2000 * 50 / 36, rel=1e-6)
    assert lens_of(detail, 1333, 2000).focal_px == pytest.approx(2000 * 50 / 36, rel=1e-6)


def test_an_impossible_sensor_gives_no_focal_length():
    detail = {FOCAL: 50.0, PLANE_X: 72.0, PLANE_UNIT: INCH, WIDE: 6000}  # of 2 metres
    assert lens_of(detail) == ExifLens(None, "", 50.0)


@pytest.mark.parametrize("unknown", [0, 0.0, float("nan")])
def test_zero_stands_for_unknown(unknown):
    assert lens_of({FOCAL: unknown, FOCAL_35MM: 0}) == ExifLens()


def test_a_maker_that_the_model_repeats_is_named_once():
    assert lens_of({}, make="Canon\0", model="Canon EOS R6").camera == "Canon EOS R6"
    assert lens_of({}, make="NIKON", model="Z 6").camera == "NIKON Z 6"


@pytest.mark.parametrize(("bits", "white"), [(8, 255), (10, 1023), (12, 4095), (14, 16383),
                                            (16, 65535)])
@pytest.mark.parametrize("channels", [1, 3])
def test_values_of_fewer_bits_in_sixteen_are_told_by_the_brightest_of_a_set(
        tmp_path, bits, white, channels):
    shape = (8, 8) if channels == 1 else (8, 8, 3)
    for index, top in enumerate((0.3, 0.9, 0.5)):
        values = np.linspace(0, top * (2**bits - 1), int(np.prod(shape))).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"{index}.png"), values.reshape(shape))
    paths = sorted(tmp_path.iterdir())
    assert all(inspect_photo(path).wide for path in paths)
    assert find_white(paths) == white
    shown = read_photo(inspect_photo(paths[1]), white)
    assert abs(int(shown.max()) - 0.9 * 255) <= 1


def test_pictures_of_eight_bits_and_black_ones_tell_nothing(tmp_path):
    Image.fromarray(np.full((8, 8), 9, np.uint8)).save(tmp_path / "a.png")
    Image.fromarray(np.zeros((8, 8), np.uint16)).save(tmp_path / "b.png")
    (tmp_path / "c.png").write_bytes(b"broken")
    assert find_white(sorted(tmp_path.iterdir())) == 65535
