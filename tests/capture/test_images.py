import numpy as np
import pytest
from media import texture, write_dng
from PIL import Image

from recon_cli.capture.images import Photo, inspect_photo, read_photo
from recon_cli.errors import InputError

ORIENTATION, EXIF, FOCAL_35MM = 0x0112, 0x8769, 0xA405


def picture():
    return texture(48, 64, coarseness=16)


def photo_of(path):
    return read_photo(inspect_photo(path))


@pytest.mark.parametrize(("orientation", "upright"), [
    (1, lambda p: p),
    (2, lambda p: p[:, ::-1]),
    (3, lambda p: p[::-1, ::-1]),
    (4, lambda p: p[::-1]),
    (5, lambda p: p.transpose(1, 0, 2)),
    (6, lambda p: np.rot90(p, -1)),
    (7, lambda p: p[::-1, ::-1].transpose(1, 0, 2)),
    (8, lambda p: np.rot90(p, 1)),
])
def test_the_orientation_of_exif_is_applied(tmp_path, orientation, upright):
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    Image.fromarray(picture()).save(tmp_path / "a.png", exif=exif)
    found = inspect_photo(tmp_path / "a.png")
    expected = upright(picture())
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


def test_what_is_transparent_shows_black(tmp_path):
    rgba = np.dstack([np.full((8, 8, 3), 200, np.uint8), np.full((8, 8), 255, np.uint8)])
    rgba[:4, :, 3] = 0
    Image.fromarray(rgba).save(tmp_path / "a.png")
    rgb = photo_of(tmp_path / "a.png")
    assert (rgb[:4] == 0).all()
    assert (rgb[4:] == 200).all()


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.webp"])
def test_half_a_photo_is_refused(tmp_path, name):
    noise = np.random.default_rng(0).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / name)
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[:len(data) // 2])
    with pytest.raises(InputError, match=f"{name} cannot be read"):
        photo_of(tmp_path / name)


@pytest.mark.parametrize("content", [b"", b"no picture", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"])
def test_what_is_no_picture_is_refused(tmp_path, content):
    (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.jpg cannot be read"):
        inspect_photo(tmp_path / "a.jpg")


def test_floating_point_pixels_are_refused_because_their_range_is_unknown(tmp_path):
    Image.fromarray(np.ones((8, 8), np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(InputError, match="floating point"):
        photo_of(tmp_path / "a.tif")


def test_a_decompression_bomb_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 1000)
    Image.fromarray(picture()).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="bomb"):
        inspect_photo(tmp_path / "a.png")


def test_a_large_photo_is_no_bomb_and_raises_no_alarm(tmp_path, monkeypatch, recwarn):
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 2000)  # the picture has 3072
    Image.fromarray(picture()).save(tmp_path / "a.png")
    np.testing.assert_array_equal(photo_of(tmp_path / "a.png"), picture())
    assert not recwarn.list


def test_documents_are_no_photos(tmp_path):
    (tmp_path / "a.eps").write_text("%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    with pytest.raises(InputError):
        inspect_photo(tmp_path / "a.eps")


def test_the_focal_length_follows_from_the_film_equivalent(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(EXIF)[FOCAL_35MM] = 26
    Image.new("RGB", (2016, 1512)).save(tmp_path / "a.jpg", exif=exif)
    Image.new("RGB", (2016, 1512)).save(tmp_path / "b.jpg")
    # 26 mm on 43.267 mm of diagonal; the diagonal of 4:3 is 5/4 of the width.
    assert inspect_photo(tmp_path / "a.jpg").focal_px == pytest.approx(2520 * 26 / 43.267)
    assert inspect_photo(tmp_path / "b.jpg").focal_px is None


def test_pixels_of_another_size_than_the_header_says_are_refused(tmp_path):
    Image.fromarray(picture()).save(tmp_path / "a.png")
    with pytest.raises(InputError, match="64x48 pixels, but its header says 64x50"):
        read_photo(Photo(tmp_path / "a.png", 64, 50, None))


def mosaic():
    """Red at 20000 of 65535, green and blue at 8000."""
    values = np.full((64, 96), 8000, np.uint16)
    values[::2, ::2] = 20000
    return values


@pytest.mark.parametrize(("orientation", "size"), [(1, (96, 64)), (6, (64, 96))])
def test_raw_is_developed_without_brightening(tmp_path, orientation, size):
    found = inspect_photo(write_dng(tmp_path / "a.dng", mosaic(), orientation=orientation))
    assert (found.width, found.height) == size
    rgb = read_photo(found)
    darker = read_photo(inspect_photo(write_dng(
        tmp_path / "b.dng", mosaic() // 4, orientation=orientation)))
    red, green, _ = rgb[20, 20].astype(int)
    assert red > green
    assert darker[20, 20, 0] < red  # brightening by itself would have made both alike


def test_half_a_raw_is_refused(tmp_path):
    path = write_dng(tmp_path / "a.dng", mosaic())
    path.write_bytes(path.read_bytes()[:6000])
    with pytest.raises(InputError, match=r"a\.dng cannot be read"):
        photo_of(path)


def test_a_raw_that_develops_to_black_is_refused(tmp_path):
    with pytest.raises(InputError, match="only black"):
        photo_of(write_dng(tmp_path / "a.dng", mosaic() * 0))


@pytest.mark.parametrize("name", ["IMG_1361.dng", "Canon-R6-pruned.CR3"])
def test_real_raw_files_without_a_picture_are_refused(shared_data, name):
    with pytest.raises(InputError):
        photo_of(shared_data / "raw" / name)
