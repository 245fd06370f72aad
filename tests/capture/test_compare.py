import cv2
import numpy as np
import pytest
from noisy_room import noisy, plain_room

from recon_cli.capture import denoise_comparison
from recon_cli.capture.denoise_comparison import Score, edges_kept


def score(name, psnr, edges, *, noise=5.0, offered=True):
    return Score(name, 4.0, offered, noise, psnr, edges, 0.1)


def test_all_edges_of_the_truth_itself_are_kept():
    assert edges_kept(plain_room(), plain_room()) == pytest.approx(1)


def test_half_the_contrast_is_half_the_edges():
    room = plain_room() // 2 * 2
    assert edges_kept(room, room // 2) == pytest.approx(0.5, abs=0.01)


def test_noise_makes_no_edges_and_blur_takes_them():
    room = plain_room()
    assert edges_kept(room, noisy(room, 10)) == pytest.approx(1, abs=0.02)
    kept = [edges_kept(room, cv2.GaussianBlur(room, (0, 0), sigma)) for sigma in (0.5, 1, 2, 4)]
    assert kept == sorted(kept, reverse=True)
    assert kept[-1] < 0.5


def test_a_flat_picture_has_no_edges_to_lose():
    flat = np.full((40, 60, 3), 128, np.uint8)
    assert edges_kept(flat, noisy(flat, 5)) == 1


def test_halving_halves_independent_noise():
    flat = np.full((200, 300, 3), 128, np.uint8)
    assert denoise_comparison.halved(noisy(flat, 10)).std() == pytest.approx(5, rel=0.05)


def test_the_measured_level_is_compared_too_unless_it_is_one_of_the_others():
    assert denoise_comparison.levels_with(7.04) == (3.0, 5.0, 7.0, 10.0, 15.0, 20.0)
    assert denoise_comparison.levels_with(5.2) == denoise_comparison.LEVELS
    assert denoise_comparison.levels_with(0.2) == denoise_comparison.LEVELS


def test_every_filter_is_scored_at_every_level_and_each_run_is_counted():
    ran = []
    levels = (5.0, 15.0)
    scores = denoise_comparison.compare(
        [plain_room()[90:150, 40:140]], levels, step=lambda: ran.append(1))
    assert len(ran) == len(scores) == denoise_comparison.steps(levels)
    names = {one.filter for one in scores}
    assert {"none", "joint", "bilateral", "guided", "non-local means"} == names
    untouched = [one for one in scores if one.filter == "none"]
    for one, level in zip(untouched, levels, strict=True):
        assert one.psnr_db == pytest.approx(20 * np.log10(255 / level), abs=0.3)
    assert all(denoise_comparison.gain(scores, one) > 1 for one in scores if one.filter == "joint")


def test_the_same_noise_is_added_every_time():
    scores = [
        [(one.psnr_db, one.edges_kept) for one in denoise_comparison.compare(
            [plain_room()[90:150, 40:140]], (10.0,), step=lambda: None)]
        for _ in range(2)]
    assert scores[0] == scores[1]


def test_the_best_is_the_closest_that_is_offered_and_keeps_the_edges():
    scores = [
        score("none", 34, 1.0), score("joint", 39, 0.97), score("bilateral", 40, 0.9),
        score("non-local means", 41, 1.0, offered=False), score("none", 24, 1.0, noise=15.0)]
    assert denoise_comparison.best(scores, 5.1).filter == "joint"
    assert denoise_comparison.gain(scores, scores[1]) == 5


def test_doing_nothing_can_be_the_best():
    scores = [score("none", 45, 1.0), score("joint", 44, 0.99)]
    assert denoise_comparison.best(scores, 5).filter == "none"
