"""Scores in closed form, and tables that hold them."""

import csv

import numpy as np
import pytest
from skimage.metrics import structural_similarity

from recon_cli.metrics import (
    ModelScore,
    ViewScore,
    csv_table,
    leaves_enough,
    markdown_table,
    psnr,
    ssim,
    text_table,
)

TRUTH = np.random.default_rng(0).integers(0, 256, (32, 40, 3), dtype=np.uint8)


def as_image(pixels):
    return (pixels / 255.0).astype(np.float32)


def test_psnr_of_a_constant_error_is_its_closed_form():
    truth = np.full((8, 8, 3), 100, np.uint8)
    image = np.full((8, 8, 3), 100 / 255 + 0.1, np.float32)
    assert psnr(image, truth) == pytest.approx(20.0, abs=1e-4)


def test_colours_beyond_one_are_clamped_before_they_are_scored():
    truth = np.full((8, 8, 3), 255, np.uint8)
    assert psnr(np.full((8, 8, 3), 7.0, np.float32), truth) == 100.0


def test_a_perfect_image_scores_one_and_stays_finite():
    assert ssim(as_image(TRUTH), TRUTH) == pytest.approx(1.0, abs=1e-6)
    assert np.isfinite(psnr(as_image(TRUTH), TRUTH))


def test_noise_lowers_both_scores():
    rng = np.random.default_rng(1)
    noisy = as_image(TRUTH) + rng.normal(0, 0.1, TRUTH.shape).astype(np.float32)
    assert ssim(noisy, TRUTH) < 0.99
    assert 19 < psnr(noisy, TRUTH) < 22


def test_an_image_smaller_than_the_window_is_refused():
    with pytest.raises(ValueError, match="11 pixels"):
        ssim(as_image(TRUTH[:5]), TRUTH[:5])


def some_mask():
    mask = np.ones((32, 40), bool)
    mask[8:20, 10:25] = False
    return mask


def test_the_psnr_of_a_masked_view_is_over_the_pixels_that_count():
    truth = np.full((32, 40, 3), 100, np.uint8)
    image = np.full((32, 40, 3), 100 / 255 + 0.1, np.float32)
    image[~some_mask()] = 1.0
    assert psnr(image, truth, some_mask()) == pytest.approx(20.0, abs=1e-4)


def test_a_mask_where_all_counts_changes_no_score():
    noisy = as_image(TRUTH) + np.random.default_rng(1).normal(0, 0.1, TRUTH.shape)
    noisy = noisy.astype(np.float32)
    whole = np.ones((32, 40), bool)
    assert psnr(noisy, TRUTH, whole) == pytest.approx(psnr(noisy, TRUTH), rel=1e-12)
    assert ssim(noisy, TRUTH, whole) == pytest.approx(ssim(noisy, TRUTH), rel=1e-12)


def test_a_render_that_is_wrong_under_the_mask_alone_scores_one():
    image = as_image(TRUTH)
    image[~some_mask()] = np.nan
    assert ssim(image, TRUTH, some_mask()) == pytest.approx(1.0, abs=1e-6)
    assert psnr(image, TRUTH, some_mask()) == 100.0


def test_the_ssim_of_a_masked_view_is_the_mean_of_the_map_where_pixels_count():
    noisy = as_image(TRUTH) + np.random.default_rng(1).normal(0, 0.1, TRUTH.shape)
    mask = np.zeros((32, 40), bool)
    mask[5:27, 5:18] = True  # the left part: what lies right of it must not be scored
    composite = np.where(mask[..., None], noisy.clip(0, 1), TRUTH / 255.0).astype(np.float32)
    _, similarity = structural_similarity(
        composite.astype(np.float64), TRUTH / 255.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1.0, channel_axis=-1, full=True)
    assert ssim(noisy.astype(np.float32), TRUTH, mask) == pytest.approx(
        similarity[5:27, 5:18].mean(), abs=1e-6)


def test_a_mask_must_leave_a_window_off_the_border():
    mask = np.zeros((32, 40), bool)
    mask[:5] = True  # 200 pixels, all of them cropped
    assert not leaves_enough(mask)
    with pytest.raises(ValueError, match="off the border"):
        ssim(as_image(TRUTH), TRUTH, mask)
    mask[10:21, 10:21] = True
    assert leaves_enough(mask)


def scores():
    views = (ViewScore("a.png", 30.0, 0.9), ViewScore("b.png", 32.0, 0.8))
    return {"base": ModelScore("3DGS", views, 1234, 5_000_000, 12.0, 60.0),
            "pruned": ModelScore("ours", views[::-1][::-1], 600, 2_000_000, 6.0, 65.0)}


def test_means_are_over_views():
    assert scores()["base"].psnr_db == 31.0
    assert scores()["base"].ssim == pytest.approx(0.85)


def test_every_table_holds_the_same_figures():
    text = text_table(list(scores().values()))
    assert "31.00" in text
    assert "1,234" in text
    markdown = markdown_table(list(scores().values()))
    assert "| 3DGS | 31.00 | 0.8500 | 1,234 | 5.0 |" in markdown
    assert "| a.png | 30.00 | 30.00 | 0.9000 | 0.9000 |" in markdown
    rows = list(csv.DictReader(csv_table(scores()).splitlines()))
    assert [row["view"] for row in rows] == ["a.png", "b.png", "mean"] * 2
    assert float(rows[2]["psnr_db"]) == 31.0
