import pytest
from PIL import Image

from recon_cli.capture.exif import Lens, read_lens
from recon_cli.capture.images import inspect_photo

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
    assert lens_of(detail) == Lens("", 50.0, None)


@pytest.mark.parametrize("unknown", [0, 0.0, float("nan")])
def test_zero_stands_for_unknown(unknown):
    assert lens_of({FOCAL: unknown, FOCAL_35MM: 0}) == Lens()


def test_a_maker_that_the_model_repeats_is_named_once():
    assert lens_of({}, make="Canon\0", model="Canon EOS R6").camera == "Canon EOS R6"
    assert lens_of({}, make="NIKON", model="Z 6").camera == "NIKON Z 6"
