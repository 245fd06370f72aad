"""From the support of a pixel's Gaussians to the error to expect there: a small monotone model.

log E = bias + sum of weight x term, every weight at least 0, so that fewer views, a wider angle, a
larger residual or a hole never lower the expected error. Fitted to the absolute errors of the
validation views by Poisson's quasi-likelihood, whose means are right even where the errors are not
Poisson's (Gourieroux, Monfort and Trognon 1984); few views say little about what lies off their
path, so the weights are held near those that several captures agree on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize

from recon_cli.evaluation.reference_views import RenderedModel
from recon_cli.render import render
from recon_cli.render.torch.projection import colors_from_sh
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import SH_C0, Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.trust.records import PRIOR, TERMS, ErrorModel
from recon_cli.trust.support import ViewingGeometry, ViewSupport, error_image

# Pull towards PRIOR in the units of the mean deviance. AUSE on novel views changes by .003 from
# .001 to 10; the reliability gap of two rooms is least from .1 to .3.
_RIDGE = 0.1
_MAX_WEIGHT = 6.0
_PIXELS = 60_000  # that the fit looks at
_ANGLE = 0.05  # rad; smaller ones count alike, as one step of a walk
_SPREAD = 0.02  # of the depth, and of the intensity: smaller spreads along a ray count alike
_LEAST = 1e-3  # of alpha, of 1 / (1 + views), and of an error: a quarter of an 8-bit step
_EDGE = 3e-3  # intensity a pixel
MIN_BIAS_ERROR = 1e-6

Array = NDArray[np.float64]


def gaussian_terms(support: ViewSupport, sight: ViewingGeometry) -> dict[str, NDArray[np.float32]]:
    """Returns the terms [N] that are known for Gaussians without a picture."""
    return _shape_terms(
        (1 / (1 + support.count.float())).cpu().numpy(), sight.angle.cpu().numpy(),
        support.residual.cpu().numpy(), sight.nearer.cpu().numpy())


def _shape_terms(
    few: NDArray[Any], angle: NDArray[Any], residual: NDArray[Any], nearer: NDArray[Any]
) -> dict[str, NDArray[Any]]:
    return {"few": np.log(few.clip(0) + _LEAST), "angle": np.log1p(angle.clip(0) / _ANGLE),
            "residual": np.log(residual.clip(0) + _LEAST), "nearer": nearer.clip(0)}


@dataclass(frozen=True, eq=False)
class Picture:
    """A view with the terms of the expected error."""

    rgb: NDArray[np.float32]  # [H, W, 3] on the backdrop, not clamped
    alpha: NDArray[np.float32]  # [H, W]
    depth: NDArray[np.float32]  # [H, W] expected depth, in units of the scene's median depth
    terms: Mapping[str, NDArray[np.float32]]  # [H, W] by the names of TERMS


def picture_terms(model: RenderedModel, support: ViewSupport, camera: Camera) -> Picture:
    """Returns a view and the terms of its pixels, by two more passes with values for colours."""
    splats, backend = model.splats, model.backend
    device, dtype = splats.means.device, splats.means.dtype
    images = model.images(camera)
    with torch.no_grad():
        sight = support.seen_from(splats.means, camera.center)
        few = 1 / (1 + support.count.to(dtype))
        first = paint(splats, camera, [few, sight.angle, support.residual], backend)
        rotation = torch.as_tensor(camera.viewmat[2], dtype=dtype, device=device)
        depth = (splats.means @ rotation[:3] + rotation[3]).clamp_min(0)
        scale = float(depth[depth > 0].median()) if bool((depth > 0).any()) else 1.0
        bright = _brightness(splats, camera, model.sh_degree)
        second = paint(splats, camera, [(depth / scale).square(), sight.nearer, bright.square()],
                       backend)
    rgb, alpha = images.rgb, images.alpha
    covered = alpha >= _LEAST
    share = np.where(covered, alpha, 1)
    mean_depth = images.depth / share / scale
    behind = float(splats.background.mean())
    gray = (_gray(rgb) - (1 - alpha) * behind) / share  # of the Gaussians alone
    few_map, angle, residual = (np.where(covered, channel / share, empty) for channel, empty in zip(
        np.moveaxis(first, -1, 0), (1.0, np.pi, float(support.residual.max())), strict=True))
    square, nearer, brightness = (
        np.where(covered, channel / share, 0) for channel in np.moveaxis(second, -1, 0))
    spread = np.sqrt((square - mean_depth**2).clip(0)) / np.maximum(mean_depth, 1e-3)
    uneven = np.sqrt((brightness - gray**2).clip(0))
    terms = {
        "hole": 1 - alpha, **_shape_terms(few_map, angle, residual, nearer),
        "depth": np.where(covered, np.log1p(spread / _SPREAD), 0),
        "color": np.where(covered, np.log1p(uneven / _SPREAD), 0), "edges": _edges(rgb)}
    return Picture(rgb, alpha, np.asarray(mean_depth, np.float32), {
        name: np.asarray(value, np.float32) for name, value in terms.items()})


def paint(
    splats: Splats, camera: Camera, values: Sequence[torch.Tensor], backend: str
) -> NDArray[np.float32]:
    """Returns three values at least 0 of each Gaussian, [N] each, composited as colours are."""
    # as harmonics of degree 0: the rasterizer itself stays as it is
    colors = (torch.stack(list(values), 1).to(splats.means.dtype) - 0.5) / SH_C0
    plain = Splats(splats.means, splats.quats, splats.log_scales, splats.logit_opacities, colors,
                   splats.sh_rest[:0, :0])
    black = torch.zeros(3, dtype=colors.dtype, device=colors.device)
    with torch.no_grad():
        image: NDArray[np.float32] = render(
            plain, camera, black, 0, backend=backend).rgb.cpu().numpy()
    return image


def _brightness(splats: Splats, camera: Camera, sh_degree: int) -> torch.Tensor:
    """Returns the mean of the channels of each Gaussian's colour, [N]."""
    place = torch.as_tensor(camera.center, dtype=splats.means.dtype, device=splats.means.device)
    rows = torch.arange(len(splats), device=splats.means.device)
    colors: torch.Tensor = colors_from_sh(
        splats.means - place, splats.sh_dc, splats.sh_rest, rows,
        min(sh_degree, splats.sh_degree))
    return colors.mean(1)


def _gray(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns the mean of the channels, [H, W]; `mean` takes three times as long."""
    return np.asarray((rgb[..., 0] + rgb[..., 1] + rgb[..., 2]) / 3, np.float32)


def _edges(rgb: NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns the logarithm of the gradient of the brightness, [H, W]."""
    gray = _gray(rgb.clip(0, 1))
    across, down = (cv2.Sobel(gray, cv2.CV_32F, *order, ksize=3) / 8 for order in ((1, 0), (0, 1)))
    return np.asarray(np.log(np.hypot(across, down) + _EDGE), np.float32)


def calibrate(
    rendered: RenderedModel, support: ViewSupport, validation: Sequence[TrainView],
    train: Sequence[TrainView], *, gains: bool = False, on_view: Callable[[], None] = lambda: None,
) -> ErrorModel:
    """Returns the model fitted to the validation views, which no gradient came from.

    Without any it keeps PRIOR, with the mean error of some training views.
    """
    views = validation or train
    columns: dict[str, list[Array]] = {name: [] for name in TERMS}
    errors: list[Array] = []
    for view in views:
        picture = picture_terms(rendered, support, view.camera)
        error, counts = error_image(picture.rgb, view, gains=gains)
        used = counts > 0
        errors.append(np.asarray(error[used], np.float64))
        for name, column in columns.items():
            column.append(np.asarray(picture.terms[name][used], np.float64))
        on_view()
    real: Array = np.concatenate(errors)
    rows = slice(None, None, max(1, len(real) // _PIXELS))
    terms = np.stack([np.concatenate(columns[name])[rows] for name in TERMS], 1)
    bias, weights = fit_weights(terms, real[rows], fixed=not validation)
    return ErrorModel(
        bias=round(bias, 5), weights=dict(zip(TERMS, weights.round(5).tolist(), strict=True)),
        means=dict(zip(TERMS, terms.mean(0).round(5).tolist(), strict=True)), views=len(views),
        calibrated=bool(validation))


def fit_weights(
    terms: Array,  # [P, K], in the order of TERMS
    errors: Array,  # [P]
    *, fixed: bool = False,
) -> tuple[float, Array]:
    """Returns bias and weights [K]; with `fixed` the weights are those of PRIOR."""
    prior = np.array([PRIOR[name] for name in TERMS])
    mean = max(float(errors.mean()), MIN_BIAS_ERROR)
    start = np.log(mean) - np.log(np.exp(np.minimum(terms @ prior, 50)).mean())
    if fixed:
        return float(start), prior

    def loss(values: Array) -> tuple[float, Array]:
        log = np.minimum(values[0] + terms @ values[1:], 50)
        expected, off = np.exp(log), values[1:] - prior
        gap = (expected - errors) / mean
        return (float((expected - errors * log).mean() / mean + _RIDGE * off @ off),
                np.concatenate([[gap.mean()], (terms * gap[:, None]).mean(0) + 2 * _RIDGE * off]))

    result = minimize(loss, np.concatenate([[start], prior]), jac=True, method="L-BFGS-B",
                      bounds=[(None, None)] + [(0, _MAX_WEIGHT)] * len(prior))
    return float(result.x[0]), np.asarray(result.x[1:])
