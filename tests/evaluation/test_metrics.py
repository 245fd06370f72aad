"""PSNR, SSIM and LPIPS in closed form and against scikit-image."""

import pickle
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from facts import assert_facts, raises
from skimage.metrics import structural_similarity

from recon_cli.evaluation import metrics
from recon_cli.evaluation.metrics import both_ssim, load_lpips, psnr, ssim
from recon_cli.io.images import to_uint8
from recon_cli.machine import install_command
from recon_cli.scene.train_view import leaves_enough
from recon_cli.train.fit.gradient import photometric_loss

pytestmark = pytest.mark.floors

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
    with raises(ValueError, 11):
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
    with raises(ValueError, "mask", "border"):
        ssim(as_image(TRUTH), TRUTH, mask)
    mask[10:21, 10:21] = True
    assert leaves_enough(mask)


def test_ssim_with_zeros_around_is_what_the_loss_of_the_reference_computes():
    rng = np.random.default_rng(1)
    noisy = (as_image(TRUTH) + rng.normal(0, 0.1, TRUTH.shape)).clip(0, 1).astype(np.float32)
    loss = photometric_loss(
        torch.from_numpy(noisy).double(), torch.from_numpy(TRUTH / 255.0), ssim_weight=1.0)
    assert ssim(noisy, TRUTH, padded=True) == pytest.approx(1 - float(loss), abs=1e-6)
    assert abs(ssim(noisy, TRUTH, padded=True) - ssim(noisy, TRUTH)) > 1e-4  # they do differ


def test_with_zeros_around_the_border_counts():
    image = as_image(TRUTH)
    image[0] = 1 - image[0]
    assert ssim(image, TRUTH, padded=True) < 0.99
    mask = np.ones((32, 40), bool)
    mask[0] = False
    assert ssim(image, TRUTH, mask, padded=True) == pytest.approx(1.0, abs=1e-6)


def test_a_picture_of_8_bits_is_scored_as_the_file_holds_it():
    truth = np.full((16, 16, 3), 100, np.uint8)
    image = np.full((16, 16, 3), 100.4 / 255, np.float32)
    assert psnr(to_uint8(image), truth) == 100.0
    assert psnr(image, truth) == pytest.approx(-20 * np.log10(0.4 / 255), abs=1e-3)


def test_lpips_is_left_out_with_its_reason_where_package_or_weights_are_missing(
    monkeypatch, tmp_path
):
    monkeypatch.setitem(sys.modules, "lpips", None)
    distance, reason = load_lpips()
    assert distance is None
    assert install_command("lpips") in reason
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace())
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    distance, reason = load_lpips()
    assert distance is None
    assert str(tmp_path) in reason


def test_lpips_beside_the_torchvision_of_another_torch_is_left_out_with_its_reason(
    monkeypatch, tmp_path
):
    monkeypatch.delitem(sys.modules, "lpips", raising=False)
    (tmp_path / "lpips.py").write_text(
        'raise RuntimeError("operator torchvision::nms does not exist\\nat 1")\n')
    monkeypatch.syspath_prepend(tmp_path)
    distance, reason = load_lpips()
    assert distance is None
    assert "(operator torchvision::nms does not exist)" in reason
    assert torch.__version__ in reason


@pytest.fixture
def backbone(monkeypatch, tmp_path):
    """A cache of torchvision with weights of the right digest, and a package lpips on them."""
    (tmp_path / "checkpoints").mkdir()
    path = tmp_path / "checkpoints" / "alexnet-owt-7be5be79.pth"
    torch.save({"features.0.weight": torch.full((1,), 4.0)}, path)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(
        metrics, "digest_file", lambda _: SimpleNamespace(sha256="7be5be79" + 56 * "0"))

    class Network(torch.nn.Module):
        def __init__(self, net, pnet_rand, verbose):
            super().__init__()
            assert (net, pnet_rand, verbose) == ("alex", True, False)  # it loads no backbone
            self.net = torch.nn.Module()
            self.net.slice1 = torch.nn.Sequential()
            self.net.slice1.add_module("0", torch.nn.Linear(1, 1, bias=False))

        def forward(self, a, b):
            return a.min() + b.max() / self.net.slice1[0].weight[0]

    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=Network))
    return path


@pytest.mark.usefixtures("backbone")
def test_lpips_gets_both_pictures_between_minus_one_and_one_and_its_backbone_from_the_cache():
    distance, reason = load_lpips()
    assert reason == ""
    image, truth = np.zeros((16, 20, 3), np.float32), np.full((16, 20, 3), 255, np.uint8)
    assert distance(image, truth) == pytest.approx(-1 + 1 / 4)


def test_a_backbone_that_would_run_code_is_not_loaded(backbone):
    class Harm:
        def __reduce__(self):
            return (print, ("harm",))

    torch.save({"features.0.weight": Harm()}, backbone)
    with pytest.raises(pickle.UnpicklingError):
        load_lpips()


def test_a_backbone_that_is_damaged_is_named(backbone, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(backbone.parents[1]))
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace())
    distance, reason = load_lpips()
    assert distance is None
    assert_facts(reason, backbone)
    assert "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth" in reason


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_both_forms_of_ssim_from_one_map_are_the_same_to_the_last_bit(masked, weighted):
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (37, 50, 3), dtype=np.uint8)
    image = (0.8 * truth / 255 + 0.2 * rng.random(truth.shape)).astype(np.float32)
    mask = rng.random(truth.shape[:2]) < 0.7 if masked else None
    weights = rng.random(truth.shape[:2]) * (1 if mask is None else mask) if weighted else None
    assert both_ssim(image, truth, mask, weights=weights) == (
        ssim(image, truth, mask, weights=weights),
        ssim(image, truth, mask, weights=weights, padded=True))


def test_ssim_is_that_of_scikit_image_to_the_last_bit():
    rng = np.random.default_rng(1)
    truth = rng.integers(0, 256, (37, 50, 3), dtype=np.uint8)
    image = rng.random(truth.shape).astype(np.float32)
    expected = structural_similarity(
        image.astype(np.float64), truth / 255.0, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, data_range=1.0, channel_axis=-1)
    assert both_ssim(image, truth)[0] == expected
