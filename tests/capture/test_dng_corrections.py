"""Lens shading and distortion that a DNG's opcodes describe, with closed forms as truth."""

import struct

import numpy as np
import pytest
from dng import AFTER, BEFORE, SIZE, Shot, gain_map, linear, opcodes, write_shot

from recon_cli.capture.dng_corrections import describe_corrections, read_corrections
from recon_cli.capture.images import inspect_photo
from recon_cli.capture.raw import develop, plan_raw

WARP, VIGNETTE, WARP_2 = 1, 3, 14
H, W = SIZE
FLAT = 0.3  # light of a wall
STEP = 0.02  # of a share: steps of 8 bits around `FLAT`, and rounding of 14


def bilinear(corners):
    """What a map of 2 x 2 gains gives at the centres of all pixels, [H, W]."""
    y, x = (np.arange(H) + 0.5) / H, (np.arange(W) + 0.5) / W
    (a, b), (c, d) = corners
    return (np.outer(1 - y, 1 - x) * a + np.outer(1 - y, x) * b
            + np.outer(y, 1 - x) * c + np.outer(y, x) * d)


def radius():
    """Squared distances from the centre, 1 in the corners, [H, W]."""
    y, x = np.arange(H) + 0.5 - H / 2, np.arange(W) + 0.5 - W / 2
    return (y[:, None]**2 + x[None]**2) / ((H / 2)**2 + (W / 2)**2)


def develop_light(folder, light, shot=None, **options):
    """Linear sRGB of a DNG of that light, brightness as it is on the whole set."""
    path = write_shot(folder / "a.dng", light, shot or Shot(**options))
    plan = plan_raw({path.name: path})
    return linear(develop(inspect_photo(path), plan)), path


def check_flat(picture):
    """Colours are equal in all of a picture, but at the rim, where LibRaw interpolates less."""
    inner = picture[3:-3, 3:-3]
    np.testing.assert_allclose(inner / np.median(inner, axis=(0, 1)), 1, atol=STEP)


CORNERS = [((2.0, 1.2), (1.5, 1.8)), ((1.8, 1.1), (1.4, 1.6)), ((1.7, 1.2), (1.3, 1.9)),
           ((1.5, 1.0), (1.6, 1.4))]


@pytest.mark.parametrize("demosaiced", [False, True])
def test_one_map_of_gains_for_all_pixels_takes_the_shading_away(tmp_path, demosaiced):
    gains = bilinear(CORNERS[0])
    light = np.full((H, W, 3), FLAT) / gains[..., None]
    corners = np.array(CORNERS[0])[..., None]
    shot = Shot(demosaiced=demosaiced, more={
        BEFORE: opcodes(gain_map(corners, planes=3 if demosaiced else 1))})
    picture, path = develop_light(tmp_path, light, shot)
    check_flat(picture)
    notice, = describe_corrections([read_corrections(path)])
    assert "2.00" in notice
    shaded, _ = develop_light(tmp_path, light, demosaiced=demosaiced)
    with pytest.raises(AssertionError):
        check_flat(shaded)


def test_maps_for_each_pixel_of_the_mosaic_take_its_shading_away(tmp_path):
    light = np.full((H, W, 3), FLAT)
    items = []
    for (row, column), channel, corners in zip(
            ((0, 0), (0, 1), (1, 0), (1, 1)), (0, 1, 1, 2), CORNERS, strict=True):
        light[row::2, column::2, channel] /= bilinear(corners)[row::2, column::2]
        items.append(gain_map(np.array(corners)[..., None], first=(row, column), pitch=(2, 2)))
    picture, _ = develop_light(tmp_path, light, more={BEFORE: opcodes(*items)})
    check_flat(picture)


@pytest.mark.parametrize("demosaiced", [False, True])
def test_maps_for_each_colour_after_demosaicing_are_applied_too(tmp_path, demosaiced):
    gains = np.stack([bilinear(corners) for corners in CORNERS[:3]], axis=2)
    corners = np.moveaxis(np.array(CORNERS[:3]), 0, 2)
    shot = Shot(demosaiced=demosaiced, more={AFTER: opcodes(gain_map(corners, planes=3))})
    check_flat(develop_light(tmp_path, FLAT / gains, shot)[0])


def test_a_polynomial_of_the_radius_takes_the_shading_away(tmp_path):
    terms = (0.5, 0.2, -0.1, 0.05, 0.1)
    square = radius()
    gains = 1 + sum(term * square**(power + 1) for power, term in enumerate(terms))
    vignette = VIGNETTE, struct.pack(">7d", *terms, 0.5, 0.5)
    light = np.full((H, W, 3), FLAT) / gains[..., None]
    check_flat(develop_light(tmp_path, light, more={AFTER: opcodes(vignette)})[0])


def warp(*planes, centre=(0.5, 0.5)):
    return WARP, struct.pack(">I", len(planes)) + b"".join(
        struct.pack(">6d", *plane) for plane in planes) + struct.pack(">2d", *centre)


def sources(terms, x, y):
    """Where the pixel (x, y) of the corrected picture lies in the distorted one."""
    unit = np.hypot(H / 2, W / 2)
    dx, dy = (x - W / 2) / unit, (y - H / 2) / unit
    square = dx**2 + dy**2
    radial = sum(terms[power] * square**power for power in range(4))
    return (W / 2 + unit * (dx * radial + terms[4] * 2 * dx * dy + terms[5] * (
                square + 2 * dx**2)),
            H / 2 + unit * (dy * radial + terms[5] * 2 * dx * dy + terms[4] * (
                square + 2 * dy**2)))


def waves(x, y):
    """Light of soft gray waves, [H, W, 3]."""
    gray = FLAT * (1 + 0.4 * np.sin(x / 6) * np.cos(y / 5))
    return np.repeat(gray[..., None], 3, axis=2)


def undistorted(terms, x, y):
    """The pixel of the corrected picture that lies at (x, y) in the distorted one."""
    u, v = x, y
    for _ in range(50):
        at_x, at_y = sources(terms, u, v)
        u, v = u + x - at_x, v + y - at_y
    return u, v


RADIAL = (1, -0.08, 0.02, 0.01, 0, 0)


@pytest.mark.parametrize(("terms", "orientation"), [
    ((0.95, 0, 0, 0, 0, 0), 1), ((1, 0, 0, 0, 0.02, -0.01), 1),
    *((RADIAL, orientation) for orientation in range(1, 9))])
def test_the_distortion_of_the_lens_is_taken_away(tmp_path, terms, orientation):
    y, x = np.mgrid[:H, :W] + 0.5
    light = waves(*undistorted(terms, x, y))
    options = {"more": {AFTER: opcodes(warp(terms))}, "orientation": orientation}
    picture, path = develop_light(tmp_path, light, **options)
    (tmp_path / "plain").mkdir()
    plain, _ = develop_light(tmp_path / "plain", waves(x, y), orientation=orientation)
    inner = np.s_[8:-8, 8:-8]
    assert np.abs(picture - plain)[inner].max() < 0.03  # of 1; cubic interpolation of 8 bits
    assert describe_corrections([read_corrections(path)])
    bent, _ = develop_light(tmp_path, light, orientation=orientation)
    assert np.abs(bent - plain)[inner].max() > 0.1


def test_each_colour_has_its_own_warp(tmp_path):
    planes = [(scale, 0, 0, 0, 0, 0) for scale in (0.97, 0.95, 0.93)]
    y, x = np.mgrid[:H, :W] + 0.5
    light = np.stack([waves(*undistorted(terms, x, y))[..., plane]
                      for plane, terms in enumerate(planes)], axis=2)
    picture, _ = develop_light(tmp_path, light, more={AFTER: opcodes(warp(*planes))})
    plain, _ = develop_light(tmp_path, waves(x, y))
    # sRGB mixes nothing: the colours of this sensor are those of sRGB
    assert np.abs(picture - plain)[8:-8, 8:-8].max() < 0.05


def test_what_is_not_applied_is_said_and_damage_changes_nothing(tmp_path):
    light = np.full((H, W, 3), FLAT)
    _, path = develop_light(tmp_path, light, more={
        AFTER: opcodes((WARP_2, bytes(8)), (99, b""), warp((1, 0, 0, 0, 0, 0)),
                       gain_map(np.ones((2, 2, 1))))})
    found = read_corrections(path)
    assert len(found.left_out) == 2
    said = describe_corrections([found])
    assert all(any(one in text for text in said) for one in found.left_out)
    damaged = opcodes(gain_map(np.ones((2, 2, 1))))[:-5]
    picture, path = develop_light(tmp_path, light, more={BEFORE: damaged})
    assert not read_corrections(path).gains
    check_flat(picture)


@pytest.mark.parametrize("orientation", [1, 2, 3, 4, 5, 6, 7, 8])
def test_all_orientations_of_a_dng_are_applied(tmp_path, orientation):
    light = np.full((H, W, 3), 0.05)
    light[:H // 2, :W // 2] = FLAT  # the first row and column are where EXIF says
    picture, path = develop_light(tmp_path, light, orientation=orientation)
    found = inspect_photo(path)
    assert (found.height, found.width) == picture.shape[:2] == (
        (W, H) if orientation > 4 else (H, W))
    bright = picture[..., 1] > picture[..., 1].mean()
    right, below = {1: (0, 0), 2: (1, 0), 3: (1, 1), 4: (0, 1), 5: (0, 0), 6: (1, 0), 7: (1, 1),
                    8: (0, 1)}[orientation]
    height, width = (side // 2 for side in bright.shape)
    corner = bright[below * height:(below + 1) * height, right * width:(right + 1) * width]
    assert corner.mean() > 0.9
