"""`recon_cli.rasterization`: activated Gaussians in several cameras, with gsplat's signature.

Signature and meaning are those of gsplat 1.5.3 (Ye et al. 2024, "gsplat: An Open-Source Library for
Gaussian Splatting"); what differs is listed in docs/rasterization.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, MutableMapping
from functools import cache
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from recon_cli.errors import BackendError, ConfigError, InputError, name_command
from recon_cli.render.camera_batch import Batch, BatchOptions, Gaussians
from recon_cli.render.contract import DILATION
from recon_cli.render.rasterization_meta import view_meta
from recon_cli.render.registry import kernels_to_compile, prepare, resolve
from recon_cli.scene.splats import TERMS

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
_HIGHEST_DEGREE = len(TERMS) - 1
_SMALLEST_ALPHA = 1e-10  # the expected depth is divided by no smaller one, as gsplat does
_TOLERANCE = 1e-2  # of a rotation: an optimizer's steps leave a matrix off by less
logger = logging.getLogger("recon")


def rasterization(  # noqa: PLR0913  # gsplat's
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [(C,) N, D] or [(C,) N, K, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,  # [C, D]
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
    backend: str = "auto",
) -> tuple[Tensor, Tensor, MutableMapping[str, Any]]:
    """Renders N Gaussians in C cameras; gradients flow to every tensor, cameras included.

    All tensors are of one dtype, float32 or float64, and on one device.

    Args:
        means: centres in world units.
        quats: rotations, wxyz, of any length but zero.
        scales: standard deviations along the own axes, world units; not logarithms.
        opacities: in [0, 1]; not logits.
        colors: without `sh_degree` D channels, of all cameras or of each: any finite numbers.
            With it coefficients of spherical harmonics; K is at least (sh_degree + 1)^2.
        viewmats: world to camera, OpenCV axes (x right, y down, z forward).
        Ks: fx, fy, cx, cy in pixels; the centre of the first pixel lies at 0.5; no skew.
        width: pixels.
        height: pixels.
        near_plane: what is nearer is not drawn; above 0.
        far_plane: what is farther is not drawn.
        radius_clip: Gaussians whose radii (see below) are not above it are not drawn, pixels.
        eps2d: added to the diagonal of each covariance on the image, pixels^2. The torch backend
            alone takes another one than 0.3.
        sh_degree: None, or 0 to 3: the highest degree in use.
        packed: the layout of `meta`; the images are the same.
        tile_size: accepted, without effect.
        backgrounds: colours behind everything, [C, D]; with `sh_degree` [C, 3]; None for zeros.
        render_mode: RGB: colours; D: sum of alpha T z, world units; ED: D over the coverage;
            RGB+D and RGB+ED: the depth is the last channel. Nothing lies behind a depth.
        sparse_grad: accepted; gradients are dense.
        absgrad: False; see Raises.
        rasterize_mode: antialiased: opacities times sqrt(det Sigma / det(Sigma + eps2d I)).
        channel_chunk: accepted, without effect.
        distributed: False; see Raises, as for all that follow but `backend`.
        camera_model: pinhole.
        segmented: accepted, without effect.
        covars: None.
        with_ut: False.
        with_eval3d: False.
        radial_coeffs: None.
        tangential_coeffs: None.
        thin_prism_coeffs: None.
        ftheta_coeffs: None.
        rolling_shutter: None or gsplat's GLOBAL.
        viewmats_rs: None.
        backend: auto, numba (CPU), triton (CUDA) or torch. auto takes the fastest that can run; for
            float64 and for another `eps2d` that is torch. Before its first image numba compiles for
            about a minute, once for a machine.

    Returns:
        The images [C, H, W, X], not clamped; the coverages [C, H, W, 1]; and a dictionary. In its
        shapes nnz is the number of pairs of a camera and a Gaussian that it shows, ordered by
        camera and Gaussian. Without `packed` it is [C, N], with zeros for all other pairs, and the
        three rows of ids are None.

        - `camera_ids`, `gaussian_ids`, `batch_ids` [nnz] int64.
        - `means2d` [nnz, 2], pixels. After backward(), with `retain_grad()` before, its `grad` is
          that of the loss by the projected mean.
        - `depths` [nnz], z in the camera.
        - `radii` [nnz, 2] int32: half the width and height in pixels of where alpha >= 1/255.
        - `conics` [nnz, 3]: (a, b, c) of the inverse covariance [[a, b], [b, c]].
        - `opacities` [nnz], times the compensation if antialiased.
        - `width`, `height`, `n_cameras`, `n_batches` (1), `tile_size` (16), `tile_width`,
          `tile_height`.

        `radii`, `conics` and `opacities` are computed when they are first read. gsplat's
        `tiles_per_gauss`, `isect_ids`, `flatten_ids` and `isect_offsets` do not exist.

    Raises:
        InputError: a shape, dtype, device or value does not fit.
        ConfigError: an argument asks for what this rasterizer does not do.
        BackendError: the backend is unknown, or cannot run on the device of `means` or with these
            arguments.
    """
    del tile_size, sparse_grad, channel_chunk, segmented  # they change no result
    _refuse({
        "absgrad": absgrad, "distributed": distributed, "covars": covars, "with_ut": with_ut,
        "with_eval3d": with_eval3d, "radial_coeffs": radial_coeffs,
        "tangential_coeffs": tangential_coeffs, "thin_prism_coeffs": thin_prism_coeffs,
        "ftheta_coeffs": ftheta_coeffs, "viewmats_rs": viewmats_rs})
    _check_choices(render_mode, rasterize_mode, camera_model, rolling_shutter, sh_degree)
    _check_numbers(width, height, near_plane, far_plane, eps2d)
    channels = 3 if sh_degree is not None else int(colors.shape[-1])
    if backgrounds is None or "RGB" not in render_mode:
        backgrounds = means.new_zeros(viewmats.shape[0], channels)
    inputs = Gaussians(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)
    _check_tensors(inputs, channels, sh_degree)
    options = BatchOptions(
        width, height, near_plane, far_plane, radius_clip, eps2d, sh_degree,
        color="RGB" in render_mode, depth="D" in render_mode,
        antialiased=rasterize_mode == "antialiased", backend=_backend(backend, means, eps2d))
    batch = Batch(inputs, options, packed=packed)
    meta, means2d = view_meta(batch.layout, inputs, options)
    images, alphas, meta["means2d"] = batch.link(inputs, means2d)
    if render_mode.endswith("ED"):
        depths = images[..., -1:] / alphas.clamp(min=_SMALLEST_ALPHA)
        images = torch.cat([images[..., :-1], depths], dim=-1)
    return images, alphas, meta


def _refuse(arguments: Mapping[str, Any]) -> None:
    """Raises ConfigError where an argument asks for what gsplat alone does."""
    for name, value in arguments.items():
        if value is not None and value is not False:
            raise ConfigError(
                f"rasterization() does not do what `{name}` asks for.", hint=_HINTS.get(
                    name, f"Leave `{name}` out, and undistort the images: {name_command('sfm')} "
                    "does."))


_HINTS = {
    "absgrad": "Leave `absgrad` out: meta['means2d'].grad is there; thresholds for plain gradients "
               "are about a quarter of those for absolute ones.",
    "distributed": "Leave `distributed` out: every process renders all of its Gaussians.",
    "covars": "Give `quats` and `scales`: those of the eigenvectors of each covariance, and the "
              "square roots of its eigenvalues.",
}


def _check_choices(
    render_mode: str, rasterize_mode: str, camera_model: str, rolling_shutter: Any,
    sh_degree: int | None,
) -> None:
    """Raises ConfigError for a choice that is none."""
    if render_mode not in _MODES:
        raise ConfigError(f"render_mode is {render_mode!r}.", hint=f"Give one of {_MODES}.")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ConfigError(f"rasterize_mode is {rasterize_mode!r}.",
                          hint="Give 'classic' or 'antialiased'.")
    if camera_model != "pinhole":
        raise ConfigError(f"camera_model is {camera_model!r}, but only pinhole is there.",
                          hint=f"Undistort the images first: {name_command('sfm')} does.")
    if rolling_shutter is not None and getattr(rolling_shutter, "name", "") != "GLOBAL":
        raise ConfigError("rolling_shutter is not GLOBAL, and only that is there.",
                          hint="Leave `rolling_shutter` out.")
    if sh_degree is not None and not 0 <= sh_degree <= _HIGHEST_DEGREE:
        raise ConfigError(f"sh_degree is {sh_degree}, needed 0 to {_HIGHEST_DEGREE}.",
                          hint=f"Give sh_degree={_HIGHEST_DEGREE}: higher ones are not drawn.")


def _check_numbers(
    width: int, height: int, near_plane: float, far_plane: float, eps2d: float
) -> None:
    """Raises ConfigError for a number out of range."""
    if width < 1 or height < 1:
        raise ConfigError(f"an image of {width}x{height} pixels.", hint="Give at least 1x1.")
    if not 0 < near_plane < far_plane:
        raise ConfigError(f"near_plane is {near_plane:g} and far_plane {far_plane:g}.",
                          hint="Give 0 < near_plane < far_plane.")
    if not eps2d > 0:
        raise ConfigError(f"eps2d is {eps2d:g}.", hint="Give one above 0; 0.3 is usual.")


def _check_tensors(inputs: Gaussians, channels: int, sh_degree: int | None) -> None:
    """Raises InputError where a shape, dtype, device or value does not fit."""
    n, c = len(inputs.means), len(inputs.viewmats)
    needed: dict[str, tuple[int, ...]] = {
        "means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,),
        "viewmats": (c, 4, 4), "Ks": (c, 3, 3), "backgrounds": (c, channels)}
    for name, shape in needed.items():
        found = tuple(getattr(inputs, name).shape)
        if found != shape:
            raise InputError(
                f"{name} has shape {found}, needed {shape}.",
                hint="Give N Gaussians and C cameras without further dimensions: "
                     "loop over batches of scenes.")
    _check_colors(tuple(inputs.colors.shape), n, c, sh_degree)
    if c < 1 or channels < 1:
        raise InputError(f"{c} cameras and {channels} channels.", hint="Give at least one each.")
    for name, tensor in inputs._asdict().items():
        if tensor.dtype != inputs.means.dtype or tensor.device != inputs.means.device:
            raise InputError(
                f"{name} is {tensor.dtype} on {tensor.device}, but means are {inputs.means.dtype} "
                f"on {inputs.means.device}.", hint=f"Give {name}.to(means).")
    if inputs.means.dtype not in (torch.float32, torch.float64):
        raise InputError(f"the tensors are {inputs.means.dtype}, needed float32 or float64.",
                         hint="Give tensor.float() of each; autocast does not reach in here.")
    opacities = inputs.opacities.detach()
    if bool(((opacities < 0) | (opacities > 1)).any()):
        raise InputError(
            f"opacities lie between {opacities.min():g} and {opacities.max():g}, needed 0 to 1.",
            hint="Give torch.sigmoid(...) of logits.")
    _check_cameras(inputs)


def _check_colors(found: tuple[int, ...], n: int, c: int, sh_degree: int | None) -> None:
    """Raises InputError where the shape of colors does not fit."""
    if sh_degree is None:
        fits, needed = found[:-1] in ((n,), (c, n)), f"({n}, D) or ({c}, {n}, D)"
        hint = "Give sh_degree too, if these are coefficients of spherical harmonics."
    else:
        fits = found[:-2] in ((n,), (c, n)) and found[-1] == 3 and (
            found[-2] >= (sh_degree + 1) ** 2)
        needed = f"({n}, K, 3) or ({c}, {n}, K, 3) with K of at least {(sh_degree + 1) ** 2}"
        hint = "Leave sh_degree out, if these are colours."
    if not fits:
        raise InputError(f"colors has shape {found}, needed {needed}.", hint=hint)


def _check_cameras(inputs: Gaussians) -> None:
    """Raises InputError where a matrix is not that of a pinhole camera."""
    poses = inputs.viewmats.detach().double().cpu().numpy()
    intrinsics = inputs.Ks.detach().double().cpu().numpy()
    turn = poses[:, :3, :3]
    off = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    off = np.maximum(off, np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1))
    wrong = ~((off < _TOLERANCE) & np.isfinite(poses).all(axis=(1, 2)))
    if wrong.any():
        raise InputError(
            f"viewmats[{int(wrong.argmax())}] is not a rotation and a translation.",
            hint="Give the inverse of the camera's pose without scale; make a matrix that an "
                 "optimizer changes a rotation again with torch.linalg.svd.")
    fx, fy, plain = intrinsics[:, 0, 0], intrinsics[:, 1, 1], intrinsics.copy()
    plain[:, [0, 1, 0, 1], [0, 1, 2, 2]] = 0
    plain[:, 2, 2] -= 1
    wrong = ~((fx > 0) & (fy > 0) & ~plain.any(axis=(1, 2)) & np.isfinite(
        intrinsics).all(axis=(1, 2)))
    if wrong.any():
        raise InputError(
            f"Ks[{int(wrong.argmax())}] is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]].",
            hint="Give focal lengths above 0 in pixels, and no skew.")


def _backend(backend: str, means: Tensor, eps2d: float) -> str:
    """Returns the backend to use, ready; BackendError if it cannot be used."""
    torch_alone = means.dtype == torch.float64 or eps2d != DILATION
    if torch_alone and backend == "auto":
        backend = "torch"
    chosen = _resolve(backend, means.device.type)
    if torch_alone and chosen != "torch":
        raise BackendError(
            f"Backend {chosen} takes float32 and eps2d={DILATION}, not {means.dtype} and {eps2d}.",
            hint="Give backend='torch', which takes all of them and is slower, or 'auto'.")
    return chosen


@cache
def _resolve(backend: str, device: str) -> str:
    """Returns the actual backend, with its kernels compiled."""
    chosen, _ = resolve(backend, device)
    kernels = kernels_to_compile(chosen)
    if kernels:
        logger.info("compiling %d kernels, once for this machine", kernels)
        prepare(chosen, lambda: None)
    return chosen
