"""Overlays are found where views move under them, and nowhere else."""

import functools

import cv2
import numpy as np
import pytest

from recon_cli.capture.static_overlay import (
    CLOSE,
    GROW,
    MIN_VIEWS,
    MOVED,
    OverlayMeter,
    draw_overlay,
    mask_overlay,
)
from recon_cli.io.images import read_png, write_png

HEIGHT, WIDTH, STEP = 180, 320, 16
VIEWS = 60
NEAR = GROW + CLOSE + 2  # pixels around an overlay that may be masked with it


def scene(seed=0, *, height=HEIGHT, width=WIDTH + VIEWS * STEP):
    """Blocks of all sizes: plain areas, edges and corners."""
    random = np.random.default_rng(seed)
    canvas = np.full((height, width), 128, np.uint8)
    for _ in range(width * height // 400):
        x, y = random.uniform(0, (width, height))
        w, h = random.uniform(4, 60, 2)
        canvas[int(y):int(y + h), int(x):int(x + w)] = random.integers(20, 236)
    return canvas


def walk(views=VIEWS, step=STEP):
    wide = scene()
    return [wide[:, i * step:i * step + WIDTH] for i in range(views)]


@functools.cache
def forward():
    """Views of a walk straight ahead along a corridor of cards, to a wall that is far away."""
    random = np.random.default_rng(0)
    x, y = random.uniform(-3, 3, 1500), random.uniform(-2, 2, 1500)
    sides = np.maximum(abs(x) / 3, abs(y) / 2) > .3
    cards = np.stack([x, y, random.uniform(.5, 80, 1500), *random.uniform(.05, .5, (2, 1500)),
                      random.integers(20, 236, 1500)], axis=1)[sides]
    frames = []
    for ahead in np.arange(0, 30, .5):
        frame = np.full((HEIGHT, WIDTH), 128, np.uint8)
        for x, y, z, w, h, value in cards[np.argsort(-cards[:, 2])]:
            if z - ahead > .3:
                scale = WIDTH / (z - ahead)
                ends = [(centre + scale * offset) * 16 for centre, offset in (
                    (WIDTH / 2, x - w), (HEIGHT / 2, y - h), (WIDTH / 2, x + w),
                    (HEIGHT / 2, y + h))]
                left, top, right, bottom = np.clip(ends, -1e6, 1e6).astype(int)
                cv2.rectangle(
                    frame, (left, top), (right, bottom), value, -1, cv2.LINE_AA, 4)
        frames.append(frame)
    return frames


def noisy(frame, sigma, seed):
    noise = np.random.default_rng(seed).normal(0, sigma, frame.shape)
    return np.clip(frame + noise, 0, 255).astype(np.uint8)


def cover(frame, alpha, value):
    return (frame * (1 - alpha) + value * alpha).astype(np.uint8)


def find(frames):
    """Returns what is found where no corner is seen in two frames."""
    meter = OverlayMeter()
    for number, frame in enumerate(frames):
        meter.advance(frame, np.array([number], np.int32), np.zeros((1, 2), np.float32))
    return meter.overlay()


def text_alpha():
    drawn = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.putText(drawn, "CAM 03", (12, 165), cv2.FONT_HERSHEY_SIMPLEX, .7, 255, 2)
    return drawn / 255


def disk_alpha(alpha, sigma=0.0, radius=18):
    drawn = np.zeros((HEIGHT, WIDTH), np.float32)
    cv2.circle(drawn, (270, 40), radius, alpha, -1)
    return cv2.GaussianBlur(drawn, (0, 0), sigma) if sigma else drawn


def bonnet_alpha():
    top = 150 + 12 * np.linspace(-1, 1, WIDTH) ** 2
    return (np.arange(HEIGHT)[:, None] > top).astype(float)


@pytest.mark.parametrize(("alpha", "value"), [
    (text_alpha(), 250), (text_alpha(), 5), (disk_alpha(.5), 255), (disk_alpha(.5, 2), 20),
    (bonnet_alpha(), 30), (np.maximum(text_alpha(), bonnet_alpha()[::-1]), 250)])
# Once there is an overlay, the end of the corridor may count as one: it hardly changes.
@pytest.mark.parametrize(("views", "elsewhere"), [(walk, 0), (forward, .05)])
def test_what_is_fixed_to_the_camera_is_covered_and_little_around_it(
        alpha, value, views, elsewhere):
    overlay = find([cover(frame, alpha, value) for frame in views()])
    drawn = (alpha > .1).astype(np.uint8)
    near = cv2.dilate(drawn, np.ones((2 * NEAR + 1, 2 * NEAR + 1))) > 0
    assert overlay[drawn > 0].mean() > .98
    assert overlay[~near].mean() <= elsewhere


# drawn by the test: collecting it takes no time
@pytest.mark.parametrize("draw", [
    walk, forward, lambda: [noisy(frame, 12, i) for i, frame in enumerate(walk())],
    lambda: [cover(frame, np.arange(WIDTH) > 160, 200) for frame in walk(MIN_VIEWS - 1)]])
def test_nothing_is_found_in_a_walk_or_in_a_few_views(draw):
    assert find(draw()) is None


def test_vignetting_of_the_lens_is_no_overlay():
    y, x = np.mgrid[-1:1:HEIGHT * 1j, -1:1:WIDTH * 1j]
    assert find([cover(frame, .35 * (x * x + y * y) / 2, 0) for frame in walk()]) is None


def test_a_camera_that_does_not_move_says_nothing():
    meter, corners = OverlayMeter(), np.random.default_rng(0).random((50, 2), np.float32)
    for number, frame in enumerate(walk(1) * VIEWS):
        jitter = np.float32(.5 * MOVED * (number % 2))
        meter.advance(frame, np.arange(50, dtype=np.int32), corners + jitter)
    assert meter.views == 1
    assert meter.overlay() is None
    # Noise loses corners as motion does.
    assert find([noisy(frame, 12, i) for i, frame in enumerate(walk(1) * VIEWS)]) is None


def test_a_view_counts_when_half_of_the_corners_moved_or_are_lost():
    meter, numbers = OverlayMeter(), np.arange(10, dtype=np.int32)
    start = np.full((10, 2), .3, np.float32)
    far = start + np.float32([2 * MOVED, 0])
    frame = walk(1)[0]
    meter.advance(frame, numbers, start)
    meter.advance(frame, numbers, np.concatenate([far[:4], start[4:]]))
    assert meter.views == 1
    meter.advance(frame, numbers[1:], np.concatenate([far[1:5], start[5:]]))
    assert meter.views == 2


def test_frames_are_compared_at_a_reduced_size():
    def enlarge(frame):
        return cv2.resize(frame, (4 * WIDTH, 4 * HEIGHT), interpolation=cv2.INTER_LINEAR)

    overlay = find([enlarge(cover(frame, disk_alpha(1), 20)) for frame in walk(30)])
    assert overlay.shape == (270, 480)
    mask = mask_overlay(overlay, 4 * WIDTH, 4 * HEIGHT)
    drawn = enlarge(disk_alpha(1)) > .5
    assert mask.shape == drawn.shape
    assert set(np.unique(mask)) == {0, 255}
    assert not mask[drawn].any()
    assert (mask == 0).sum() < 2 * drawn.sum()


def test_the_picture_shows_the_masked_area_in_red(tmp_path):
    write_png(tmp_path / "frame.png", np.full((20, 30, 3), 100, np.uint8))
    mask = np.full((20, 30), 255, np.uint8)
    mask[:, 20:] = 0
    draw_overlay(tmp_path / "frame.png", mask, tmp_path / "overlay.png")
    picture = read_png(tmp_path / "overlay.png")
    assert (picture[:, :20] == 100).all()
    assert (picture[:, 20:] == (177, 50, 50)).all()
