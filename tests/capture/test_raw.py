import json
from fractions import Fraction

import cv2
import numpy as np
import pytest
from dng import Shot, linear, write_shot
from facts import assert_facts, raises
from media import texture, write_dng

from recon_cli.capture.images import inspect_photo, read_photo
from recon_cli.capture.photos import list_photos
from recon_cli.capture.raw import RawPlan, develop, plan_raw
from recon_cli.errors import InputError

pytestmark = pytest.mark.floors

SPREAD = 0.02  # of brightness over a set, after correction


def scene(*, brightest=0.5):
    """Light of soft blocks, [160, 240, 3], with much to hold on to."""
    soft = cv2.GaussianBlur(texture(160, 240, coarseness=10), (0, 0), 1.5)
    light = linear(soft)
    return light * brightest / light.max()


def plan_of(*paths):
    return plan_raw({path.name: path for path in paths})


def developed(folder, shots, *, expect=None):
    """Writes and develops shots, (light on the sensor, Shot) each, and returns linear pictures."""
    paths = [write_shot(folder / f"{k}.dng", *shot) for k, shot in enumerate(shots)]
    plan = plan_of(*paths)
    assert sorted(plan.broken) == (expect or [])
    return [
        linear(develop(inspect_photo(path), plan)) for path in paths
        if path.name not in plan.broken]


def spread(pictures):
    """Returns how far brightness ranges over pictures of one scene, as a share of the median."""
    usable = np.all([(p.max(axis=2) < 0.8) & (p.min(axis=2) > 0.05) for p in pictures], axis=0)
    assert usable.mean() > 0.2
    levels = np.array([np.median(p[usable] / pictures[0][usable]) for p in pictures])
    return float(np.ptp(levels) / np.median(levels))


SETTINGS = [  # one stop more or less by each means that a camera has
    (0, Shot()),
    (1, Shot(seconds=Fraction(1, 30))),
    (-1, Shot(seconds=Fraction(1, 120))),
    (1, Shot(iso=200)),
    (-2, Shot(f_number=Fraction(4))),
]


def test_exposures_that_exif_tells_are_taken_back(tmp_path):
    light = scene(brightest=0.4)
    shots = [(light * 2.0**ev, shot) for ev, shot in SETTINGS]
    assert spread(developed(tmp_path, shots)) < SPREAD


def test_without_exif_the_pixels_tell_the_exposures(tmp_path):
    light = scene(brightest=0.4)
    shots = [(light * 2.0**ev, Shot(with_exif=False)) for ev in (0, 1, -1, 0.5)]
    assert spread(developed(tmp_path, shots)) < SPREAD


def test_an_exif_that_the_pixels_contradict_is_not_believed(tmp_path):
    light = scene(brightest=0.4)
    shots = [(light, Shot()) for _ in range(4)]
    shots.insert(2, (light, Shot(seconds=Fraction(1, 8))))
    assert spread(developed(tmp_path, shots)) < SPREAD


def test_one_white_balance_that_of_the_median_photo_serves_all(tmp_path):
    neutrals = [(0.45, 1.0, 0.7), (0.5, 1.0, 0.625), (0.6, 1.0, 0.5)]
    light = np.full((64, 96, 3), 0.3)
    pictures = developed(tmp_path, [(light, Shot(neutral=neutral)) for neutral in neutrals])
    for picture in pictures:  # gray, as the second photo has it
        np.testing.assert_allclose(
            picture[32, 48] / picture[32, 48, 1], 1, atol=0.03)
        np.testing.assert_array_equal(picture, pictures[0])


def test_a_gray_set_keeps_its_steps_in_srgb(tmp_path):
    light = np.repeat(np.repeat([[0.05, 0.1, 0.2, 0.4]], 64, 0), 32, 1)[..., None] * np.ones(3)
    picture = developed(tmp_path, [(light, Shot())])[0]
    steps = picture[32, 16::32, 1]
    np.testing.assert_allclose(steps[1:] / steps[:-1], 2, rtol=0.04)  # 8 bits: 3 % at the dark end


def test_the_brightest_point_of_a_photo_does_not_set_its_brightness(tmp_path):
    # LibRaw by itself takes a maximum above .75 of the nominal one for saturation.
    light = np.full((64, 96, 3), 0.3)
    glint = light.copy()
    glint[20:24, 20:24] = 0.8
    plain, shining = developed(tmp_path, [(light, Shot()), (glint, Shot())])
    np.testing.assert_array_equal(plain[50, 80], shining[50, 80])


def test_all_photos_clip_at_one_radiance(tmp_path):
    light = scene(brightest=0.3)
    light[60:64, 100:120] = 0.7  # clipped by the longer exposure alone
    usual, longer = developed(
        tmp_path, [(light, Shot()), (light * 2, Shot(seconds=Fraction(1, 30)))])
    assert (usual[61, 110] > 0.99).all()
    assert (longer[61, 110] > 0.99).all()


def test_a_long_exposure_of_a_dark_corner_does_not_erase_a_bright_room(tmp_path):
    room = scene(brightest=0.8)
    corner = np.full_like(room, 0.02)
    corner[:, :60] = room[:, :60]
    shots = [(room, Shot()) for _ in range(4)]
    shots.append((corner * 16, Shot(seconds=Fraction(16, 60))))
    pictures = developed(tmp_path, shots)
    assert (pictures[0].max(axis=2) > 0.99).mean() < 0.15


def test_a_dark_set_is_brightened_as_one(tmp_path):
    dark = scene(brightest=0.25)
    first, second = developed(tmp_path, [(dark, Shot()), (dark / 2, Shot(iso=50))])
    assert first.max() > 0.9
    assert spread([first, second]) < 0.05  # the values of the darker one are few


def test_a_plan_survives_json(tmp_path):
    paths = [write_shot(tmp_path / f"{k}.dng", scene() * 2.0**-k, Shot()) for k in range(2)]
    (tmp_path / "bad.dng").write_bytes(b"no RAW")
    plan = plan_of(*paths, tmp_path / "bad.dng")
    assert RawPlan.from_json(json.loads(json.dumps(plan.to_json()))) == plan


def test_a_raw_photo_is_turned_once_and_tells_its_lens(tmp_path):
    path = write_shot(tmp_path / "a.dng", scene(), Shot(orientation=6))
    found = inspect_photo(path)
    assert (found.width, found.height) == (160, 240)
    assert found.focal_px == pytest.approx(np.hypot(160, 240) * 26 / 43.267)
    assert (found.camera, found.focal_mm) == ("Test Mosaic One", pytest.approx(4.36))
    straight = write_shot(tmp_path / "b.dng", scene(), Shot())
    plan = plan_of(path, straight)
    upright = np.rot90(develop(inspect_photo(straight), plan), -1)
    turned = develop(found, plan)
    assert np.median(np.abs(turned.astype(int) - upright)) <= 1  # the mosaic is not turned


def test_another_camera_keeps_its_own_white_balance(tmp_path):
    light = np.full((64, 96, 3), 0.3)
    paths = [
        write_shot(tmp_path / "a.dng", light, Shot()),
        write_dng(tmp_path / "b.dng", np.full((64, 96), 20000, np.uint16))]
    first, second = plan_of(*paths).shots.values()
    assert first.multipliers != second.multipliers
    assert first.saturation != second.saturation


def test_what_cannot_be_developed_is_named_and_the_rest_is_planned(tmp_path):
    good = write_shot(tmp_path / "good.dng", scene(), Shot())
    black = write_dng(tmp_path / "black.dng", np.zeros((64, 96), np.uint16))
    half = write_dng(tmp_path / "half.dng", np.full((64, 96), 8000, np.uint16))
    half.write_bytes(half.read_bytes()[:6000])
    plan = plan_of(black, good, half)
    assert list(plan.shots) == ["good.dng"]
    assert_facts(plan.broken["black.dng"], "black.dng")
    assert_facts(plan.broken["half.dng"], "half.dng")
    with pytest.raises(InputError) as caught:
        develop(inspect_photo(black), plan)
    assert_facts(str(caught.value), "black.dng", "black")


def test_a_dng_with_jpeg_xl_inside_is_not_taken_for_damaged(tmp_path):
    path = write_shot(tmp_path / "a.dng", scene(), Shot(compression=52546))
    with raises(InputError, "JPEG", "XL") as error:
        inspect_photo(path)
    assert "not damaged" in error.value.hint
    (reason,) = list_photos([path]).broken.values()
    assert error.value.hint in reason


def test_a_photo_that_breaks_after_the_plan_is_refused(tmp_path):
    path = write_shot(tmp_path / "a.dng", scene(), Shot())
    found, plan = inspect_photo(path), plan_of(path)
    path.write_bytes(b"")
    with raises(InputError, "a.dng"):
        develop(found, plan)


def test_a_raw_photo_is_not_read_like_a_picture(tmp_path):
    found = inspect_photo(write_shot(tmp_path / "a.dng", scene(), Shot()))
    with raises(ValueError, "RAW"):
        read_photo(found)


@pytest.mark.parametrize("name", ["IMG_1361.dng", "Canon-R6-pruned.CR3"])
def test_real_raw_files_without_a_picture_are_named(shared_data, name):
    plan = plan_of(shared_data / "raw" / name)
    assert list(plan.broken) == [name]
    assert name in plan.broken[name]


@pytest.mark.integration
def test_views_of_a_real_scene_match_after_development(shared_data, tmp_path):
    folder = shared_data / "snowmiku_photos"
    truth, shots = [], []
    for path, (ev, shot) in zip(sorted(folder.glob("*.jpg")), SETTINGS, strict=False):
        bgr = cv2.resize(cv2.imread(str(path)), (400, 300), interpolation=cv2.INTER_AREA)
        light = linear(bgr[..., ::-1]) * 0.7
        truth.append(light)
        shots.append((light * 2.0**ev, shot))
    factors = []
    for light, picture in zip(truth, developed(tmp_path, shots), strict=True):
        usable = (picture.max(axis=2) < 0.8) & (picture.min(axis=2) > 0.02)
        factors.append(np.median(picture[usable] / light[usable]))
    assert np.ptp(factors) / np.median(factors) < SPREAD
