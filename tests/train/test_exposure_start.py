"""Gains that the colours of sparse points show, before any training."""

import json
from dataclasses import replace

import av
import numpy as np
import pytest

from recon_cli.datasets.depth_points import points_from_depth
from recon_cli.datasets.layouts import read_posed
from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView
from recon_cli.train.parts.sparse_points import estimate_gains

pytestmark = pytest.mark.integration

WIDTH, HEIGHT = 120, 90
CAMERA = Camera(WIDTH, HEIGHT, 100.0, 100.0, WIDTH / 2, HEIGHT / 2, np.eye(4))
GAINS = np.array([[1.0, 1.1, 0.9], [1.2, 1.0, 1.0], [0.8, 0.9, 1.1], [1.0, 1.0, 1.0]])
ROUNDING = 0.004  # of 8-bit pixels between 60 and 180, in log units


def wall(gain=(1.0, 1.0, 1.0)):
    """A smooth picture [H, W, 3] times a gain."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] / 20
    colors = 120 + 40 * np.stack([np.sin(u), np.cos(v), np.sin(u + v)], axis=-1)
    return np.rint(colors * gain).clip(0, 255).astype(np.uint8)


def points(count=600):
    """Points [P, 3] on that wall, three units ahead."""
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform([-1.8, -1.3], [1.8, 1.3], (count, 2)), np.full(count, 3.0)])


def views():
    return [TrainView(CAMERA, wall(gain)) for gain in GAINS]


def centered(gains):
    return np.log(gains) - np.log(gains).mean(axis=0)


def test_gains_of_one_wall_are_found_up_to_their_mean():
    found = estimate_gains(views(), points())
    assert found.log_gains == pytest.approx(centered(GAINS), abs=ROUNDING)
    assert found.spread == pytest.approx(centered(GAINS).std(axis=0).max(), abs=ROUNDING)
    assert found.drifts


def test_views_of_one_exposure_do_not_drift():
    found = estimate_gains([TrainView(CAMERA, wall())] * 4, points())
    assert (found.spread, found.drifts, found.compared) == (0.0, False, 6)


def test_what_hides_a_third_of_the_points_in_one_view_does_not_mislead():
    images = views()
    image = images[1].image.copy()
    image[:, : WIDTH // 3] = (30, 160, 90)
    images[1] = TrainView(CAMERA, image)
    assert estimate_gains(images, points()).log_gains == pytest.approx(centered(GAINS), abs=0.05)


def test_pixels_under_a_mask_and_blown_out_ones_say_nothing():
    images = views()
    image, mask = images[2].image.copy(), np.ones((HEIGHT, WIDTH), bool)
    image[: HEIGHT // 2], mask[: HEIGHT // 2] = 128, False
    image[HEIGHT // 2:, : 2 * WIDTH // 3] = 255
    images[2] = TrainView(CAMERA, image, mask)
    assert estimate_gains(images, points(2000)).log_gains == pytest.approx(
        centered(GAINS), abs=3 * ROUNDING)


def test_a_view_that_shares_no_point_has_no_gain_and_no_say():
    turned = np.diag([-1.0, 1.0, -1.0, 1.0])
    images = [*views(), TrainView(replace(CAMERA, viewmat=turned), wall((0.5, 0.5, 0.5)))]
    found = estimate_gains(images, points())
    assert not found.log_gains[-1].any()
    assert found.log_gains[:-1] == pytest.approx(centered(GAINS), abs=ROUNDING)


def along_a_wall(log_gains):
    """Views that step along the wall, each with a gain of its own."""
    images = []
    for at, log_gain in zip(np.linspace(-1.5, 1.5, len(log_gains)), log_gains, strict=True):
        viewmat = np.eye(4)
        viewmat[0, 3] = -at
        image = np.roll(wall(), -round(at / 3 * 100), axis=1) * np.exp(log_gain)
        images.append(TrainView(replace(CAMERA, viewmat=viewmat), np.rint(image).astype(np.uint8)))
    return images


def wide_points():
    rng = np.random.default_rng(0)
    return np.column_stack([
        rng.uniform([-3.3, -1.3], [3.3, 1.3], (2000, 2)), np.full(2000, 3.0)])


def test_an_exposure_that_follows_the_place_is_told_from_one_of_each_view():
    slow = 0.2 * np.sin(np.linspace(0, 2 * np.pi, 30))
    jumps = 0.2 * np.random.default_rng(1).permutation(np.linspace(-1, 1, 30))
    followed = estimate_gains(along_a_wall(slow), wide_points())
    own = estimate_gains(along_a_wall(jumps), wide_points())
    assert followed.drifts
    assert own.drifts
    assert followed.follows_place
    assert followed.local < 0.1
    assert not own.follows_place
    assert own.local > 0.6
    # whatever the order of the views
    mixed = np.random.default_rng(2).permutation(30)
    shuffled = estimate_gains([along_a_wall(slow)[i] for i in mixed], wide_points())
    assert shuffled.local == pytest.approx(followed.local, rel=0.1)


def test_without_points_nothing_is_known():
    found = estimate_gains(views(), np.zeros((0, 3)))
    assert (found.spread, found.compared) == (0.0, 0)
    assert not found.log_gains.any()


def filmed(room, name, every=4):
    """Each fourth frame of a room's video with its true camera."""
    cameras = [image.viewmat for image in read_posed(room).images if not image.held_out]
    result = []
    with av.open(str(room / name)) as container:
        for frame, viewmat in zip(container.decode(video=0), cameras, strict=True):
            image = frame.to_ndarray(format="rgb24")
            result.append(TrainView(Camera(600, 340, 300, 300, 300, 170, viewmat), image))
    return result[::every]


def test_the_gains_of_a_room_whose_exposure_drifts_are_found(shared_data):
    room = shared_data / "rooms" / "office"
    found = estimate_gains(filmed(room, "video_noisy.mp4"), points_from_depth(read_posed(room))[0])
    frames = json.loads((room / "noisy.json").read_text())["per_frame"][::4]
    truth = np.log([frame["gain"] * np.array(frame["wb_bgr"][::-1]) for frame in frames])
    # the gains act on linear light and the pixels are gamma-coded: log-gains shrink by about 2.2
    for channel in range(3):
        assert np.corrcoef(found.log_gains[:, channel], truth[:, channel])[0, 1] > 0.97
        slope = np.polyfit(truth[:, channel], found.log_gains[:, channel], 1)[0]
        assert slope == pytest.approx(1 / 2.2, abs=0.05)
    assert found.drifts


@pytest.mark.parametrize("room", ["office", "living"])
def test_a_room_of_one_exposure_does_not_drift(shared_data, room):
    folder = shared_data / "rooms" / room
    assert not estimate_gains(
        filmed(folder, "video.mp4"), points_from_depth(read_posed(folder))[0]).drifts
