"""PSNR, SSIM and LPIPS of one rendered view against its photo, by the conventions of papers.

LPIPS is optional: it needs an extra package and weights, and neither is ever downloaded here.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from recon_cli.machine import install_command
from recon_cli.scene.train_view import BORDER, MIN_SIDE, without_border
from recon_cli.workspace.digests import digest_file

PSNR_CONVENTION = "mean of per-image dB, float render clamped to [0, 1] against 8-bit truth"
GAIN_CONVENTION = (
    "the same after the factor of each view and channel that fits its truth best, as the exposure "
    "of a view that was not trained on is not known")
VIGNETTE_CONVENTION = (
    "Renders have the vignette of their lens, as training found it; the scene and its files do not")
PSNR_8BIT_CONVENTION = "the same of the render rounded to 8 bits, as a picture file holds it"
SSIM_CONVENTION = (
    "scikit-image: 11x11 Gaussian window, sigma 1.5, 5 px border cropped, mean of channels")
SSIM_PADDED_CONVENTION = (
    "INRIA: the same window, zeros around the image, mean of all pixels; its borders score higher")
MASK_CONVENTION = (
    "ignored pixels have no part in the squared error; the map of SSIM is averaged over the others")
FACES_CONVENTION = (
    "faces of panoramas or wide lenses, scored by frame, each direction once: squared errors and "
    "the map of SSIM are averaged by solid angle")
LPIPS_CONVENTION = "LPIPS 0.1 with AlexNet, of the float render, lower is better"
CONVENTIONS: dict[str, Any] = {  # as JSON files hold them
    "psnr_convention": PSNR_CONVENTION, "psnr_8bit_convention": PSNR_8BIT_CONVENTION,
    "ssim_convention": SSIM_CONVENTION, "ssim_padded_convention": SSIM_PADDED_CONVENTION}
CONVENTION_LINES = (  # below tables in Markdown
    f"PSNR: {PSNR_CONVENTION}\nafter gain: {GAIN_CONVENTION}\n8-bit: {PSNR_8BIT_CONVENTION}\n"
    f"SSIM: {SSIM_CONVENTION}\nSSIM 0-pad: {SSIM_PADDED_CONVENTION}\n"
    f"LPIPS: {LPIPS_CONVENTION}\n")
EXPLANATION = (  # of all that tables may hold
    f"{CONVENTION_LINES}masks: {MASK_CONVENTION}\npanoramas: {FACES_CONVENTION}\n"
    f"vignette: {VIGNETTE_CONVENTION}")
_MAX_DB = 100.0  # of equal images, which JSON cannot hold
_LPIPS_WEIGHTS = "alexnet-owt-7be5be79.pth"  # as torchvision names them: ends in their SHA-256
_LPIPS_ADDRESS = f"https://download.pytorch.org/models/{_LPIPS_WEIGHTS}"

Perceptual = Callable[[NDArray[np.float32], NDArray[Any]], float]


def psnr(
    image: NDArray[Any], truth: NDArray[Any], mask: NDArray[np.bool_] | None = None
) -> float:
    """Returns 10 log10(1 / MSE) in dB of an image [H, W, 3], at most 100 dB.

    Both are of 8 bits, or float and clamped to [0, 1]; `mask` [H, W] is True where used.
    """
    error = _unit(image) - _unit(truth)
    if mask is not None:
        error = error[mask]
    return to_decibels(float(np.mean(error**2)))


def to_decibels(mean_square: float) -> float:
    """Returns the PSNR in dB of a mean squared error of values in [0, 1], at most 100 dB."""
    return float(-10 * np.log10(max(mean_square, 1e-10)))


def weighted_error(
    image: NDArray[Any], truth: NDArray[Any], weights: NDArray[np.float64]
) -> float:
    """Returns the sum of squared errors, means of the channels, times weights [H, W]."""
    error = _unit(image) - _unit(truth)
    return float(((error**2).mean(axis=2) * weights).sum())


def corrected_psnr(
    image: NDArray[np.float32], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> float:
    """Returns the PSNR in dB after the least-squares gain per channel; arguments as of `psnr`."""
    rendered, true = image.astype(np.float64).reshape(-1, 3), truth.reshape(-1, 3) / 255.0
    if mask is not None:
        rendered, true = rendered[mask.reshape(-1)], true[mask.reshape(-1)]
    energy = (rendered * rendered).sum(axis=0)
    gain = np.where(energy > 0, (rendered * true).sum(axis=0) / np.maximum(energy, 1e-30), 1.0)
    error = float(np.mean((np.clip(rendered * gain, 0, 1) - true) ** 2))
    return float(-10 * np.log10(max(error, 10 ** (-_MAX_DB / 10))))


def ssim(
    image: NDArray[np.float32], truth: NDArray[Any], mask: NDArray[np.bool_] | None = None,
    *, padded: bool = False, weights: NDArray[np.float64] | None = None,
) -> float:
    """Returns the structural similarity of an image [H, W, 3] clamped to [0, 1].

    With a mask [H, W]: the mean of the map over the pixels that count, of an image that is the
    truth elsewhere. `weights` [H, W], zero where the mask is, make it a weighted one. `padded` puts
    zeros around both images and scores every pixel, as INRIA's scripts do; otherwise a border of
    half a window is left out. ValueError if the image is smaller than the 11-pixel window, or the
    mask leaves nothing.
    """
    similarity = _similarity(image, truth, mask, padded=padded)
    return _mean_inside(similarity, *_padded(mask, weights) if padded else (mask, weights))


def both_ssim(
    image: NDArray[np.float32], truth: NDArray[Any], mask: NDArray[np.bool_] | None = None,
    *, weights: NDArray[np.float64] | None = None,
) -> tuple[float, float]:
    """Returns `ssim` and its padded form at half the cost: inside the border they have one map."""
    similarity = _similarity(image, truth, mask, padded=True)
    return (_mean_inside(without_border(similarity), mask, weights),
            _mean_inside(similarity, *_padded(mask, weights)))


_AROUND = ((BORDER, BORDER), (BORDER, BORDER))


def _similarity(
    image: NDArray[np.float32], truth: NDArray[Any], mask: NDArray[np.bool_] | None, *, padded: bool
) -> NDArray[np.float64]:
    """Returns the map of the structural similarity, [H, W, 3]; `padded`, with a border of zeros."""
    if min(truth.shape[:2]) < MIN_SIDE:
        raise ValueError(f"SSIM needs {MIN_SIDE} pixels a side, the image has {truth.shape[:2]}")
    rendered, true = _unit(image), _unit(truth)
    if mask is not None:
        if not without_border(mask).any():
            raise ValueError("SSIM of a mask that leaves no pixel off the border")
        rendered = np.where(mask[..., None], rendered, true)
    if padded:
        rendered, true = (np.pad(pixels, (*_AROUND, (0, 0))) for pixels in (rendered, true))
    return np.asarray(structural_similarity(
        rendered, true, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=-1, full=True)[1])


def _padded(
    mask: NDArray[np.bool_] | None, weights: NDArray[np.float64] | None
) -> tuple[NDArray[np.bool_] | None, NDArray[np.float64] | None]:
    """Returns mask and weights for a map that has a border of zeros."""
    return (None if mask is None else np.pad(mask, _AROUND),
            None if weights is None else np.pad(weights, _AROUND))


def _mean_inside(
    similarity: NDArray[np.float64], mask: NDArray[np.bool_] | None,
    weights: NDArray[np.float64] | None,
) -> float:
    """Returns the mean of a map without its border, where the mask counts or by weight."""
    inside = without_border(similarity)
    if weights is not None:
        inner = without_border(weights)
        return float((inside.mean(axis=2) * inner).sum() / inner.sum())
    if mask is not None:
        return float(inside[without_border(mask)].mean())
    # channel by channel, as scikit-image does
    return float(np.mean([inside[..., channel].mean() for channel in range(inside.shape[2])]))


def load_lpips() -> tuple[Perceptual | None, str]:
    """Returns LPIPS of an image [H, W, 3] in [0, 1] and a truth, or None and why there is none.

    (Zhang et al. 2018.) The weights of its backbone must be in torchvision's cache.
    """
    try:
        import lpips
    except ModuleNotFoundError:
        return None, f"the package lpips is not installed (`{install_command('lpips')}`)"
    except (ImportError, OSError, RuntimeError) as error:  # torchvision was built for another torch
        cause = str(error).partition("\n")[0]
        return None, (f"the package lpips cannot be imported ({cause}); it needs the torchvision "
                      f"that belongs to torch {torch.__version__}")
    weights = Path(torch.hub.get_dir()) / "checkpoints" / _LPIPS_WEIGHTS
    if not weights.is_file():
        return None, f"its weights are not at {weights}; save {_LPIPS_ADDRESS} (244 MB) there"
    if not digest_file(weights).sha256.startswith(weights.stem[-8:]):
        return None, f"{weights} is damaged; save {_LPIPS_ADDRESS} there again"
    # without its backbone, which the package would unpickle with whatever code it holds
    network = lpips.LPIPS(net="alex", pnet_rand=True, verbose=False).eval()
    backbone = torch.load(weights, map_location="cpu", weights_only=True)
    for name, parameter in network.net.named_parameters():  # slice1.0.weight is features.0.weight
        parameter.data = backbone["features." + name.split(".", 1)[1]]

    def distance(image: NDArray[np.float32], truth: NDArray[Any]) -> float:
        with torch.no_grad():  # of [1, 3, H, W] in [-1, 1]
            return float(network(*(
                torch.from_numpy(pixels.astype(np.float32)).permute(2, 0, 1)[None] * 2 - 1
                for pixels in (np.clip(image, 0, 1), _unit(truth)))))

    return distance, ""


def _unit(image: NDArray[Any]) -> NDArray[np.float64]:
    """Returns an image in [0, 1]."""
    unit = image / 255.0 if image.dtype == np.uint8 else np.clip(image, 0, 1)
    return np.asarray(unit, np.float64)
