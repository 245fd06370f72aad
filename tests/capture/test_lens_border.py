"""The black border around the round picture of a fisheye is masked, and nothing else is."""

import numpy as np
import pytest
from media import texture

from recon_cli.capture.lens_border import (
    BorderMeter,
    LensCircle,
    find_circle,
    fit_circle,
    hide_border,
)
from recon_cli.io.images import read_png, write_png

WIDTH, HEIGHT = 320, 240
CENTER, RADIUS = (163.0, 118.0), 112.0


def round_frame(seed, *, radius=RADIUS, dim=1.0):
    """A picture inside a circle, with the noise of a camera around it."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    away = np.hypot(x - CENTER[0], y - CENTER[1])
    shown = texture(HEIGHT, WIDTH, seed=seed) * dim * np.clip(radius - away, 0, 2)[..., None] / 2
    return np.clip(shown + rng.normal(3, 2, shown.shape), 0, 255).astype(np.uint8)


def write(folder, frames):
    paths = [folder / f"{index:03d}.png" for index in range(len(frames))]
    for path, frame in zip(paths, frames, strict=True):
        write_png(path, frame)
    return paths


@pytest.mark.parametrize("radius", [112.0, 165.0])  # whole in the frame, and cut by two sides
def test_the_round_picture_is_found(tmp_path, radius):
    circle = find_circle(write(tmp_path, [round_frame(i, radius=radius) for i in range(6)]))
    assert circle is not None
    np.testing.assert_allclose(
        np.array([circle.x, circle.y, circle.radius]) * WIDTH, [*CENTER, radius], atol=2)
    counts = circle.inside(WIDTH, HEIGHT)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    away = np.hypot(x - CENTER[0], y - CENTER[1])
    assert not counts[away > radius - 1].any()
    assert counts[away < 0.94 * radius].all()


def test_pictures_that_fill_their_corners_have_none(tmp_path):
    assert find_circle(write(tmp_path, [texture(HEIGHT, WIDTH, seed=i) for i in range(3)])) is None
    assert find_circle([]) is None


def test_one_frame_that_shows_a_corner_is_enough(tmp_path):
    frames = [round_frame(index) for index in range(5)]
    frames[3] = texture(HEIGHT, WIDTH, seed=9)
    assert find_circle(write(tmp_path, frames)) is None


def test_bars_and_dark_rooms_are_no_lens():
    bars = texture(HEIGHT, WIDTH, seed=0).max(axis=2)
    bars[:40], bars[-40:] = 0, 0
    assert fit_circle(bars) is None
    box = np.zeros((HEIGHT, WIDTH), np.uint8)
    box[60:180, 80:240] = 200
    assert fit_circle(box) is None
    lamp = np.zeros((HEIGHT, WIDTH), np.uint8)
    lamp[100:108, 150:158] = 255
    assert fit_circle(lamp) is None
    assert fit_circle(np.zeros((HEIGHT, WIDTH), np.uint8)) is None


def test_frames_get_masks_that_keep_what_others_hide(tmp_path):
    class Notices:
        def __init__(self):
            self.texts = []

        def notice(self, text):
            self.texts.append(text)

    (tmp_path / "frames").mkdir()
    (tmp_path / "masks").mkdir()
    names = [path.name for path in write(
        tmp_path / "frames", [round_frame(index) for index in range(4)])]
    own = np.full((HEIGHT, WIDTH), 255, np.uint8)
    own[100:120, 150:170] = 0
    write_png(tmp_path / "masks" / names[1], own)
    told = Notices()
    hidden = hide_border(tmp_path, names, told)
    masks = [read_png(tmp_path / "masks" / name)[..., 0] for name in names]
    np.testing.assert_array_equal(masks[0] == 0, hidden)
    assert (masks[1][100:120, 150:170] == 0).all()
    assert hidden.mean() == pytest.approx(
        1 - np.pi * (0.97 * RADIUS) ** 2 / WIDTH / HEIGHT, abs=0.02)
    assert f"{hidden.mean():.0%}" in told.texts[0]


def test_a_circle_is_the_same_at_any_size():
    circle = LensCircle(0.5, 0.375, 0.3)
    small, large = circle.inside(160, 120).mean(), circle.inside(640, 480).mean()
    assert small == pytest.approx(large, rel=0.02)


def test_a_border_is_not_taken_for_darkness():
    exposures = np.array([[0.55, 0.0, 40.0], [0.9, 0.02, 10.0]])
    meter = BorderMeter()
    for index in range(4):
        meter.advance(round_frame(index).max(axis=2))
    inside = np.pi * (0.97 * RADIUS) ** 2 / WIDTH / HEIGHT
    black, blown, spread = meter.without_border(exposures).T
    np.testing.assert_allclose(black, (exposures[:, 0] - 1 + inside).clip(0) / inside, atol=0.01)
    np.testing.assert_allclose(blown, exposures[:, 1] / inside, atol=0.01)
    np.testing.assert_array_equal(spread, exposures[:, 2])
    meter.advance(texture(HEIGHT, WIDTH, seed=1)[..., 0])
    np.testing.assert_array_equal(meter.without_border(exposures), exposures)
    np.testing.assert_array_equal(BorderMeter().without_border(exposures), exposures)
