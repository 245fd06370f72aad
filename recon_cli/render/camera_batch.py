"""Activated Gaussians in several cameras through any backend, as one differentiable operation.

The backends take raw parameters, a near plane of 0.05 and three channels. So scales go through the
logarithm, opacities through the logit, features through three channels at a time, and the world is
enlarged by a power of two where the near plane is nearer, which changes no digit of the image.
The views are rendered in a graph of their own, which the backward pass of `_Link` runs: it is known
only afterwards which Gaussians were drawn, and their projected means have a gradient too.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.render.contract import ALPHA_MIN, DILATION, NEAR, RenderOutput, Statistics
from recon_cli.render.registry import renderer
from recon_cli.render.torch.projection import project_rows
from recon_cli.render.view_gradient import TensorCamera, view_gradient
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import LEAST_OPACITY, SH_C0, Splats

_SCALE_MIN = 1e-37  # world units; kernels take no smaller one, and no float32 image shows it
_COMPENSATION_MIN = 1e-20  # of its square: a Gaussian so thin is not drawn
_EXTENT = 3.33  # standard deviations; gsplat's ellipse where 2 ln(255 o) is larger


class Gaussians(NamedTuple):
    """What gradients flow to: N activated Gaussians and C cameras."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    colors: Tensor  # [N, D], [C, N, D], [N, K, 3] or [C, N, K, 3]
    viewmats: Tensor  # [C, 4, 4]
    Ks: Tensor  # [C, 3, 3]
    backgrounds: Tensor  # [C, D]


@dataclass(frozen=True)
class BatchOptions:
    """How the cameras see them; the names are those of `rasterization`."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    sh_degree: int | None
    color: bool
    depth: bool
    antialiased: bool
    backend: str

    @property
    def enlargement(self) -> float:
        """The power of two by which the world grows, so that no Gaussian lies before NEAR."""
        return 2.0 ** max(0, math.ceil(math.log2(NEAR / self.near_plane)))


@dataclass(eq=False)
class View:
    """One camera's images, and the Gaussians that it shows."""

    image: Tensor  # [H, W, X] channels, and behind them sum of alpha T z if depth is asked for
    alpha: Tensor  # [H, W]
    ids: Tensor  # [M] int64, ascending
    taps: list[Tap]


@dataclass(frozen=True, eq=False)
class BatchLayout:
    """The pairs of a camera and a Gaussian that it shows, and how the caller gets their rows."""

    camera_ids: Tensor  # [nnz] int64, ascending
    gaussian_ids: Tensor  # [nnz] int64, ascending for each camera
    shape: tuple[int, int]  # C, N
    packed: bool

    def arrange(self, rows: Tensor) -> Tensor:
        """Returns rows [nnz, ...] as they are if packed, else as [C, N, ...] with zeros."""
        if self.packed:
            return rows
        filled = rows.new_zeros(*self.shape, *rows.shape[1:])
        return filled.index_put((self.camera_ids, self.gaussian_ids), rows)

    def ids(self) -> list[Tensor]:
        """Returns the Gaussians of each camera."""
        counts = torch.bincount(self.camera_ids, minlength=self.shape[0])
        return list(torch.split(self.gaussian_ids, counts.tolist()))


class Batch:
    """The views of one call, in a graph of their own."""

    def __init__(self, inputs: Gaussians, options: BatchOptions, *, packed: bool) -> None:
        self._differentiable = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
        self._leaves = Gaussians(*(
            x.detach().requires_grad_(self._differentiable and x.requires_grad) for x in inputs))
        # asks for the gradients of projected means even where those of means are not wanted
        self._anchor = inputs.means.new_zeros(()).requires_grad_(self._differentiable)
        poses = inputs.viewmats.detach().double().cpu().numpy()
        intrinsics = inputs.Ks.detach().double().cpu().numpy()
        self._backend = options.backend
        with torch.set_grad_enabled(self._differentiable), _one_torch_thread(self._backend):
            shared = _Shared.from_leaves(self._leaves, options)
            self.views = [
                _render_view(self._leaves, shared, c, numbers, options, self._anchor)
                for c, numbers in enumerate(zip(poses, intrinsics, strict=True))]
            self._images = torch.stack([view.image for view in self.views])
            self._alphas = torch.stack([view.alpha for view in self.views])[..., None]
        self.layout = BatchLayout(
            torch.cat([torch.full_like(view.ids, c) for c, view in enumerate(self.views)]),
            torch.cat([view.ids for view in self.views]), (len(poses), len(inputs.means)), packed)

    @property
    def images(self) -> tuple[Tensor, Tensor]:
        """The images [C, H, W, X] and coverages [C, H, W, 1], without a graph."""
        return self._images.detach(), self._alphas.detach()

    def link(self, inputs: Gaussians, means2d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the images as functions of the inputs, and of projected means, as arranged.

        The projected means come back as a tensor that gathers the gradient of the images. That
        gradient reaches the Gaussians through the images; only what else comes to the projected
        means goes back through them.
        """
        if not self._differentiable:
            return *self.images, means2d
        if means2d.requires_grad:
            source = _PassOn.apply(means2d)  # type: ignore[no-untyped-call]
            gathering = source.view_as(source)
        else:
            source, gathering = means2d, means2d.detach().requires_grad_()
        images, alphas = _Link.apply(  # type: ignore[no-untyped-call]
            self, gathering, source, *inputs)
        return images, alphas, gathering

    def backward(
        self, grad_images: Tensor, grad_alphas: Tensor
    ) -> tuple[Tensor, list[Tensor | None]]:
        """Returns the gradients of the projected means, as arranged, and of the inputs."""
        wanted = [x for x in self._leaves if x.requires_grad]
        with _one_torch_thread(self._backend):
            *found, _ = torch.autograd.grad(
                [self._images, self._alphas], [*wanted, self._anchor], [grad_images, grad_alphas],
                retain_graph=True, allow_unused=True)
        by_means2d = torch.cat([
            torch.stack([tap.means2d_grad[view.ids] for tap in view.taps]).sum(0)
            for view in self.views])
        gradients = iter(found)
        arranged = self.layout.arrange(by_means2d)
        return arranged, [next(gradients) if x.requires_grad else None for x in self._leaves]


@contextmanager
def _one_torch_thread(backend: str) -> Iterator[None]:
    """Leaves the cores to the threads of numba's kernels: those of torch spin while they wait."""
    threads = torch.get_num_threads()
    if backend != "numba" or threads == 1:
        yield
        return
    from recon_cli.kernels.thread_pool import pool

    before, pool.threads = pool.threads, pool.size
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        pool.threads = before


class _Link(torch.autograd.Function):
    """The images of a batch, with the graph of the caller."""

    @staticmethod
    def forward(
        ctx: Any, batch: Batch, _gathering: Tensor, _source: Tensor, *_inputs: Tensor
    ) -> tuple[Tensor, Tensor]:
        ctx.batch = batch
        return batch.images

    @staticmethod
    def backward(ctx: Any, grad_images: Tensor, grad_alphas: Tensor) -> tuple[Tensor | None, ...]:
        by_means2d, gradients = ctx.batch.backward(grad_images, grad_alphas)
        # what `gathering` passes on to its source is taken back there
        return None, by_means2d, -by_means2d, *gradients


class _PassOn(torch.autograd.Function):
    """Stops a gradient of zeros."""

    @staticmethod
    def forward(_ctx: Any, means2d: Tensor) -> Tensor:
        return means2d.view_as(means2d)

    @staticmethod
    def backward(_ctx: Any, gradient: Tensor) -> Tensor | None:
        return gradient if bool(gradient.any()) else None


@dataclass(eq=False)
class Tap:
    """What one pass through a backend leaves for the gradients of its camera."""

    camera: TensorCamera
    dilation: float
    splats: Splats | None = None
    sh_degree: int = 0
    statistics: Statistics | None = None
    means2d_grad: Tensor = field(default_factory=lambda: torch.zeros(0))  # [N, 2]


class _Tap(torch.autograd.Function):
    """Centres as a backend gets them; its backward pass runs after the backend's."""

    @staticmethod
    def forward(
        ctx: Any, tap: Tap, means: Tensor, _viewmat: Tensor, _K: Tensor, _anchor: Tensor
    ) -> Tensor:
        ctx.tap = tap
        return means.view_as(means)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        tap: Tap = ctx.tap
        assert tap.statistics is not None
        assert tap.splats is not None
        tap.means2d_grad = tap.statistics.means2d_grad.clone()
        by_view: tuple[Tensor | None, Tensor | None] = None, None
        if ctx.needs_input_grad[2] or ctx.needs_input_grad[3]:
            assert tap.statistics.ellipses is not None
            pose, K = view_gradient(
                tap.splats, tap.camera, tap.sh_degree, tap.statistics.ellipses, tap.dilation)
            by_view = pose.to(gradient.dtype), K.to(gradient.dtype)
        return None, gradient, *by_view, torch.zeros_like(gradient[:0].sum())


@dataclass(frozen=True, eq=False)
class _Channels:
    """Up to three channels in the form that backends take."""

    sh_dc: Tensor  # [N, 3]
    sh_rest: Tensor  # [N, T, 3]; [0, 0, 3] of plain colours
    degree: int
    count: int
    shift: Tensor  # [count] that the image has too much
    start: int  # the first of them among all channels


@dataclass(frozen=True, eq=False)
class _Shared:
    """What all cameras have in common, in the form that backends take."""

    means: Tensor  # [N, 3] in the enlarged world
    log_scales: Tensor  # [N, 3] likewise
    logits: Tensor | None  # [N]; None where each camera has its own
    channels: list[_Channels] | None  # likewise

    @staticmethod
    def from_leaves(leaves: Gaussians, options: BatchOptions) -> _Shared:
        """Computes them: once, not once for each camera."""
        grown, plain = options.enlargement, 2 if options.sh_degree is None else 3
        log_scales = _Log.apply(leaves.scales)  # type: ignore[no-untyped-call]
        return _Shared(
            leaves.means * grown, log_scales + math.log(grown),
            None if options.antialiased
            else _Logit.apply(leaves.opacities),  # type: ignore[no-untyped-call]
            _split(leaves.colors, options) if leaves.colors.dim() == plain else None)


def _render_view(
    leaves: Gaussians, shared: _Shared, c: int,
    numbers: tuple[NDArray[np.float64], NDArray[np.float64]], options: BatchOptions, anchor: Tensor,
) -> View:
    """Returns what camera `c` sees; `numbers` are its viewmat and K."""
    camera = TensorCamera(options.width, options.height, leaves.viewmats[c], leaves.Ks[c])
    logits = _logits(leaves, shared, camera, options)
    grown = options.enlargement
    growth = leaves.viewmats.new_ones(4, 4)  # a similarity on both sides: the last row shrinks
    growth[:3, 3], growth[3, :3] = grown, 1 / grown
    scaled = TensorCamera(camera.width, camera.height, camera.viewmat * growth, camera.intrinsics)
    seen_by = _ViewCamera.from_numbers(*numbers, options.width, options.height, grown)
    images, taps, first = [], [], None
    for part in shared.channels or _split(leaves.colors[c], options):
        tap = Tap(scaled, options.eps2d, sh_degree=part.degree)
        means = _Tap.apply(  # type: ignore[no-untyped-call]
            tap, shared.means, scaled.viewmat, scaled.intrinsics, anchor)
        splats = Splats(
            means, leaves.quats, shared.log_scales, logits, part.sh_dc, part.sh_rest)
        behind = leaves.backgrounds[c, part.start:part.start + part.count] + part.shift
        output = _render(splats, seen_by, torch.nn.functional.pad(behind, (0, 3 - part.count)),
                         part.degree, options)
        tap.splats, tap.statistics = splats.map(torch.Tensor.detach), output.statistics
        output.statistics.keep_ellipses = (
            leaves.viewmats.requires_grad or leaves.Ks.requires_grad)
        images.append(output.rgb[..., :part.count] - part.shift)
        taps.append(tap)
        first = first or output
    assert first is not None
    if options.depth:
        images.append(first.depth[..., None] / grown)
    ids = torch.nonzero(first.statistics.radii)[:, 0]
    return View(torch.cat(images, dim=-1), first.alpha, ids, taps)


def _logits(
    leaves: Gaussians, shared: _Shared, camera: TensorCamera, options: BatchOptions
) -> Tensor:
    """Returns the opacities as one camera sees them, [N], before the sigmoid."""
    opacities = leaves.opacities
    if options.antialiased:
        opacities = opacities * compensations(leaves, camera, options.eps2d)
    hidden = _hidden(leaves, camera, opacities, options)
    if hidden is not None:
        opacities = torch.where(hidden, 0.0, opacities)
    elif shared.logits is not None:
        return shared.logits
    logits: Tensor = _Logit.apply(opacities)  # type: ignore[no-untyped-call]
    return logits


def _split(colors: Tensor, options: BatchOptions) -> list[_Channels]:
    """Returns the passes for colours [N, D] or coefficients [N, K, 3]."""
    none, rest = colors.new_zeros(0), colors.new_zeros(0, 0, 3)
    if not options.color:  # the depth alone
        return [_Channels(colors.new_zeros(len(colors), 3), rest, 0, 0, none, 0)]
    if options.sh_degree is not None:
        dc, used = colors[:, 0], colors[:, 1:(options.sh_degree + 1) ** 2]
        return [_Channels(
            dc.contiguous(), used.contiguous(), options.sh_degree, 3, colors.new_zeros(3), 0)]
    passes = []
    for start in range(0, colors.shape[1], 3):
        part = colors[:, start:start + 3]
        shift, count = _shift(part), part.shape[1]
        dc = torch.nn.functional.pad((part + (shift - 0.5)) / SH_C0, (0, 3 - count))
        passes.append(_Channels(dc, rest, 0, count, shift, start))
    return passes


def _shift(colors: Tensor) -> Tensor:
    """Returns what to add to each channel of [N, D], so that all are well above 0.

    Backends clamp colours at 0 and have no gradient there; features may be negative.
    """
    if not len(colors):
        return colors.new_full((colors.shape[1],), 0.5)
    values = colors.detach()
    lowest = torch.where(torch.isfinite(values), values, 0.0).amin(0)
    return 0.5 + (-lowest).clamp_min(0)


def _render(
    splats: Splats, camera: Camera, background: Tensor, degree: int, options: BatchOptions
) -> RenderOutput:
    """Renders one pass."""
    if options.eps2d == DILATION:
        return renderer(options.backend)(splats, camera, background, degree, False)
    from recon_cli.render.torch.tiles import render as torch_render  # the others have a fixed one

    return torch_render(splats, camera, background, degree, False, dilation=options.eps2d)


class _ViewCamera(Camera):
    """A camera whose matrix may be off a rotation by rounding, or by a step of an optimizer."""

    @property
    def center(self) -> NDArray[np.float64]:
        """The optical centre in world coordinates, [3]."""
        return np.asarray(-np.linalg.solve(self.viewmat[:3, :3], self.viewmat[:3, 3]))

    @staticmethod
    def from_numbers(
        viewmat: NDArray[np.float64], K: NDArray[np.float64], width: int, height: int, grown: float
    ) -> _ViewCamera:
        """Returns the camera in a world that is `grown` times as large."""
        enlarged = viewmat.copy()
        enlarged[:3, 3] *= grown
        return _ViewCamera(width, height, float(K[0, 0]), float(K[1, 1]), float(K[0, 2]),
                           float(K[1, 2]), enlarged)


@torch.no_grad()
def _hidden(
    leaves: Gaussians, camera: TensorCamera, opacities: Tensor, options: BatchOptions
) -> Tensor | None:
    """Returns which Gaussians the planes and radius_clip take away, [N] bool; None: none."""
    depths = leaves.means @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
    hidden = (depths < options.near_plane) | (depths > options.far_plane)
    if options.radius_clip > 0:
        _, cov2d, _ = ellipses(leaves, camera, options.eps2d)
        hidden |= (radii(cov2d, opacities) <= options.radius_clip).all(-1)
    return hidden if bool(hidden.any()) else None


def ellipses(
    inputs: Gaussians, camera: TensorCamera, eps2d: float, ids: Tensor | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Returns what Gaussians (all, or those at `ids`) are projected to, by autograd in float64.

    These are the share [M] of the determinant that is not of the low-pass filter, the covariances
    (a, b, c) [M, 3] in pixels^2 and their determinants [M]. In float32 the gradient of a needle's
    share would lose digits by the ratio of its axes.
    """
    means, quats, scales = (
        (x if ids is None else x[ids]).double()
        for x in (inputs.means, inputs.quats, inputs.scales))
    exact = TensorCamera(
        camera.width, camera.height, camera.viewmat.double(), camera.intrinsics.double())
    _, directions, _ = project_rows(means, quats, exact)
    vx, vy = (directions * scales[:, None]).unbind(1)
    a, b, c = (vx * vx).sum(-1), (vx * vy).sum(-1), (vy * vy).sum(-1)
    cross = torch.linalg.cross(vx, vy)  # a c - b^2 cancels for needles, this does not
    own = (cross * cross).sum(-1)
    det = own + eps2d * (a + c + eps2d)
    return own / det, torch.stack([a + eps2d, b, c + eps2d], dim=-1), det


def compensations(
    inputs: Gaussians, camera: TensorCamera, eps2d: float, ids: Tensor | None = None
) -> Tensor:
    """Returns sqrt(det Sigma / det(Sigma + eps2d I)) [M] (Mip-Splatting, Yu et al. 2024)."""
    share, _, _ = ellipses(inputs, camera, eps2d, ids)
    return share.clamp_min(_COMPENSATION_MIN).sqrt().to(inputs.means.dtype)


@torch.no_grad()
def radii(cov2d: Tensor, opacities: Tensor) -> Tensor:
    """Returns gsplat's radii [M, 2] along x and y: whole pixels, to where alpha is 1/255."""
    reach = (2 * (opacities / ALPHA_MIN).log().clamp_min(0)).sqrt().clamp_max(_EXTENT)
    return (reach[:, None] * cov2d[:, [0, 2]].sqrt()).ceil()


class _Log(torch.autograd.Function):
    """The logarithm of |scale|: the covariance is even in each scale, and flat at 0."""

    @staticmethod
    def forward(ctx: Any, scales: Tensor) -> Tensor:
        ctx.save_for_backward(scales)
        return scales.abs().clamp_min(_SCALE_MIN).log()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (scales,) = ctx.saved_tensors
        drawn = scales.abs() > _SCALE_MIN
        return torch.where(drawn, gradient / scales.where(drawn, 1.0), 0.0)


class _Logit(torch.autograd.Function):
    """The logit, held where the sigmoid gives the opacity back to the last digit.

    The slope is that at the held value, so that an opacity of 1 has its gradient.
    """

    @staticmethod
    def forward(ctx: Any, opacities: Tensor) -> Tensor:
        high = 1 - torch.finfo(opacities.dtype).eps / 2  # the greatest number below 1
        held = opacities.clamp(LEAST_OPACITY, high)
        ctx.save_for_backward(held.nan_to_num(0.5))  # a NaN is not drawn, and gets a zero
        return held.log() - (-held).log1p()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (held,) = ctx.saved_tensors
        slope: Tensor = gradient / (held * (1 - held))
        return slope
