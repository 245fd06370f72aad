"""PSNR and SSIM of one rendered view against the truth, by the conventions that papers use."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

PSNR_CONVENTION = "mean of per-image dB, float render clamped to [0, 1] against 8-bit truth"
PSNR_8BIT_CONVENTION = "the same of the render rounded to 8 bits, as a picture file holds it"
SSIM_CONVENTION = (
    "scikit-image: 11x11 Gaussian window, sigma 1.5, 5 px border cropped, mean of channels")
SSIM_PADDED_CONVENTION = (
    "INRIA: the same window, zeros around the image, mean of all pixels; its borders score higher")
MASK_CONVENTION = (
    "ignored pixels have no part in the squared error; the map of SSIM is averaged over the others")
MIN_SIDE = 11  # pixels; the window of SSIM
MIN_PIXELS = MIN_SIDE**2  # that a mask must leave: one window of SSIM
_MOST_DB = 100.0  # of equal images, which JSON cannot hold
_BORDER = MIN_SIDE // 2  # pixels; what scikit-image crops, where the window reaches outside


def leaves_enough(mask: NDArray[np.bool_]) -> bool:
    """Tells whether at least MIN_PIXELS pixels of a mask [H, W] count off the border."""
    return int(np.count_nonzero(_cropped(mask))) >= MIN_PIXELS


def psnr(
    image: NDArray[Any], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> float:
    """Returns 10 log10(1 / MSE) in dB of an image [H, W, 3], clamped to [0, 1].

    Equal images would be infinite, which JSON cannot hold: they give 100 dB, less than one part
    in 10^5 of an 8-bit step.

    Args:
        image: [H, W, 3], in [0, 1] or of 8 bits.
        truth: [H, W, 3].
        mask: [H, W], True where a pixel counts; None where all do.
    """
    error = _unit(image) - truth / 255.0
    if mask is not None:
        error = error[mask]
    return float(-10 * np.log10(max(float(np.mean(error**2)), 1e-10)))


def ssim(
    image: NDArray[np.float32], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None,
    *, padded: bool = False,
) -> float:
    """Returns the structural similarity of an image [H, W, 3] clamped to [0, 1].

    With a mask: the mean of the map over the pixels that count, of an image that is the truth
    elsewhere. The truth under the mask lies in their windows; `io.images.painted` makes it neutral.

    Args:
        image: [H, W, 3].
        truth: [H, W, 3].
        mask: [H, W], True where a pixel counts; None where all do.
        padded: zeros lie around both images and every pixel counts, as INRIA's scripts score it;
            otherwise the border that windows reach over is left out.

    Raises:
        ValueError: the image is smaller than the 11-pixel window, or the mask leaves nothing.
    """
    if min(truth.shape[:2]) < MIN_SIDE:
        raise ValueError(f"SSIM needs {MIN_SIDE} pixels a side, the image has {truth.shape[:2]}")
    shown, true = _unit(image), truth / 255.0
    if mask is not None:
        if not _cropped(mask).any():
            raise ValueError("SSIM of a mask that leaves no pixel off the border")
        shown = np.where(mask[..., None], shown, true)
    if padded:  # what is cropped below is then the padding
        around = ((_BORDER, _BORDER), (_BORDER, _BORDER))
        shown, true = (np.pad(one, (*around, (0, 0))) for one in (shown, true))
        mask = None if mask is None else np.pad(mask, around)
    value, similarity = structural_similarity(
        shown, true, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1.0,
        channel_axis=-1, full=True)
    return float(value if mask is None else _cropped(similarity)[_cropped(mask)].mean())


def _unit(image: NDArray[Any]) -> NDArray[np.float64]:
    """Returns an image in [0, 1]."""
    unit = image / 255.0 if image.dtype == np.uint8 else np.clip(image, 0, 1)
    return np.asarray(unit, np.float64)


def _cropped(pixels: NDArray[Any]) -> NDArray[Any]:
    """Returns [H, W, ...] without the border that SSIM leaves out."""
    return pixels[_BORDER:-_BORDER, _BORDER:-_BORDER]


def corrected_psnr(
    image: NDArray[np.float32], truth: NDArray[np.uint8], mask: NDArray[np.bool_] | None = None
) -> float:
    """Returns the PSNR in dB of an image after the gain per channel that fits it best.

    The gain is that of least squares; the result is clamped to [0, 1] as in the plain score.

    Args:
        image: [H, W, 3] rendered.
        truth: [H, W, 3].
        mask: [H, W], True where a pixel counts; None where all do.
    """
    shown, true = image.astype(np.float64).reshape(-1, 3), truth.reshape(-1, 3) / 255.0
    if mask is not None:
        shown, true = shown[mask.reshape(-1)], true[mask.reshape(-1)]
    energy = (shown * shown).sum(axis=0)
    gain = np.where(energy > 0, (shown * true).sum(axis=0) / np.maximum(energy, 1e-30), 1.0)
    error = float(np.mean((np.clip(shown * gain, 0, 1) - true) ** 2))
    return float(-10 * np.log10(max(error, 10 ** (-_MOST_DB / 10))))

