"""The backends that the rasterizer's tests run on, and how they are compared with the oracle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from interpreter import INTERPRETED
from oracle import composited
from scenes import leaves
from torch import Tensor

from recon_cli.render import RenderOutput, available_backends, render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

BLACK = torch.zeros(3, dtype=torch.float64)
GREENISH = torch.tensor([0.2, 0.5, 0.1], dtype=torch.float64)

# A backend adds up the 256 pixels of a tile where the oracle sums in float64. In whatever order a
# library does that, 256 random roundings come to sqrt(256) of one; four sigmas leave no luck.
SUMMED = 4 * 256 ** 0.5
# The formulas around the sums round some eight times: float64 that is narrowed to float32 after
# each of them (`rounded` of activated_oracle) comes to 4 to 50 roundings, 8 on the mean.
_STEPS = 8
_ROUNDING = 2.0 ** -24
# float32 holds 7 digits; a pixel sums some hundred fragments and the exponential amplifies the
# rounding of q by up to q / 2 < 6. Measured: 2e-6 for images, 4e-6 for gradients.
IMAGE_TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}
GRADIENT_TOLERANCE = {torch.float32: SUMMED * _STEPS * _ROUNDING, torch.float64: 1e-12}
# The oracle differentiates the spherical harmonics by central differences.
ORACLE_SH_TOLERANCE = 1e-10
# A fragment whose alpha lies so close (relative) to 1/255, or the transmittance behind it to 1e-4,
# may be in or out by rounding: such a pixel is a lottery in float32. It is left out of the
# comparison, and `Comparison.doubtful` says how many there were.
MARGIN = {torch.float32: 1e-4, torch.float64: 0.0}


@dataclass(frozen=True)
class Case:
    """A backend on a device in a precision."""

    backend: str
    device: str
    dtype: torch.dtype

    def __str__(self) -> str:
        return f"{self.backend}-{self.device}-{str(self.dtype).removeprefix('torch.')}"

    @property
    def interpreted(self) -> bool:
        """Whether Python runs the kernels step by step."""
        return (self.backend, self.device) == ("triton", "cpu")

    def rounded(self, splats: Splats) -> Splats:
        """The same in float64, with values that the precision holds: the input's rounding is
        no error of the backend."""
        return splats.map(lambda tensor: tensor.detach().to(self.dtype).double())

    def leaves(self, splats: Splats) -> Splats:
        """A copy for this backend whose every parameter collects gradients."""
        return leaves(self.cast(splats))

    def cast(self, splats: Splats) -> Splats:
        """The splats as this backend takes them."""
        return splats.map(lambda tensor: tensor.to(device=self.device, dtype=self.dtype))

    def render(
        self, splats: Splats, camera: Camera, background: Tensor = BLACK, degree: int = 0, *,
        scores: bool = False, mask: Tensor | None = None,
    ) -> RenderOutput:
        """Renders splats of any precision on this backend; gradients reach them."""
        color = background.to(device=self.device, dtype=self.dtype)
        return render(
            self.cast(splats), camera, color, degree, backend=self.backend, scores=scores,
            mask=mask)


def _cases() -> list[Case]:
    found = []
    for status in available_backends():
        if status.missing:
            continue
        for device in status.devices:
            # the torch backend alone takes both
            dtypes = [torch.float32, torch.float64] if status.name == "torch" else [torch.float32]
            found += [Case(status.name, device, dtype) for dtype in dtypes]
    if INTERPRETED:
        found.append(Case("triton", "cpu", torch.float32))
    return found


CASES = _cases()
every_backend = pytest.mark.parametrize("case", CASES, ids=str)


def at_size(cases: Sequence[Case]) -> list[Any]:
    """The cases for tests that take an interpreter minutes: there they are marked slow."""
    return [pytest.param(case, marks=pytest.mark.slow if case.interpreted else ())
            for case in cases]


every_backend_at_size = pytest.mark.parametrize("case", at_size(CASES), ids=str)


@dataclass(frozen=True)
class Comparison:
    """How far a backend lies from the oracle.

    Attributes:
        rgb: greatest error in the pixels that are no lottery, relative to max(1, truth).
        alpha: the same of the coverage.
        depth: the same of the depth.
        gradients: for each parameter the norm of the error over the norm of the gradient; the
            norm of the error itself where the truth is zero.
        doubtful: how many pixels were left out.
    """

    rgb: float
    alpha: float
    depth: float
    gradients: dict[str, float]
    doubtful: int

    @property
    def image(self) -> float:
        """The worst of the three images."""
        return max(self.rgb, self.alpha, self.depth)

    @property
    def gradient(self) -> float:
        """The worst of the parameters."""
        return max(self.gradients.values())


def compared(
    case: Case, splats: Splats, camera: Camera, background: Tensor = GREENISH, degree: int = 0, *,
    margin: float | None = None,
) -> Comparison:
    """Renders with the backend and the oracle, and carries the same loss back through both.

    The loss is a random combination of all three images, zero where a pixel is a lottery.
    """
    exact = case.rounded(splats)
    margin = MARGIN[case.dtype] if margin is None else margin
    truth = _truth(exact, camera, background, degree, margin)
    ours = case.leaves(exact)
    out = case.render(ours, camera, background, degree)
    loss, errors = torch.zeros((), device=case.device), []
    for reference, weights, image in zip(
            truth.images, truth.weights, (out.rgb, out.alpha, out.depth), strict=True):
        assert torch.isfinite(image).all()
        mask = truth.sure[..., None].expand_as(reference) if reference.dim() == 3 else truth.sure
        error = ((image.detach().cpu() - reference).abs() * mask).max()
        errors.append(error.item() / max(1.0, reference.abs().max().item()))
        loss = loss + (weights.to(image) * image).sum()
    loss.backward()
    gradients = {
        name: _relative(parameter.grad, truth.gradients[name])
        for name, parameter in ours.parameters().items()}
    return Comparison(*errors, gradients, int((~truth.sure).sum()))


@dataclass(frozen=True)
class _Truth:
    """The oracle's results for a scene: three images, the weights of a loss, its gradients."""

    images: list[Tensor]
    weights: list[Tensor]
    sure: Tensor
    gradients: dict[str, Tensor | None]


_truths: dict[Any, _Truth] = {}  # the last few; a test asks again for each backend


def _truth(
    splats: Splats, camera: Camera, background: Tensor, degree: int, margin: float
) -> _Truth:
    key = (
        tuple((tuple(parameter.shape), parameter.numpy().tobytes())
              for parameter in splats.parameters().values()),
        camera.viewmat.tobytes(),
        (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
        background.numpy().tobytes(), degree, margin)
    if key not in _truths:
        if len(_truths) == 16:
            del _truths[next(iter(_truths))]
        _truths[key] = _compute_truth(splats, camera, background, degree, margin)
    return _truths[key]


def _compute_truth(
    splats: Splats, camera: Camera, background: Tensor, degree: int, margin: float
) -> _Truth:
    exact = leaves(splats)
    truth = composited(exact, camera, background, degree)
    sure = truth.margin > margin
    generator = torch.Generator().manual_seed(0)
    loss, all_weights = torch.zeros(()), []
    for reference in (truth.rgb, truth.alpha, truth.depth):
        mask = sure[..., None].expand_as(reference) if reference.dim() == 3 else sure
        weights = torch.randn(reference.shape, generator=generator, dtype=torch.float64) * mask
        all_weights.append(weights)
        loss = loss + (weights * reference).sum()
    if loss.requires_grad:
        loss.backward()
    return _Truth(
        [truth.rgb.detach(), truth.alpha.detach(), truth.depth.detach()], all_weights, sure,
        {name: parameter.grad for name, parameter in exact.parameters().items()})


def _relative(ours: Tensor | None, truth: Tensor | None) -> float:
    """The norm of the error over the norm of the truth; None counts as zero."""
    if ours is None:
        return 0.0 if truth is None else float(truth.norm())
    ours = ours.double().cpu()
    assert torch.isfinite(ours).all()
    truth = torch.zeros_like(ours) if truth is None else truth
    norm = float(truth.norm())
    return float((ours - truth).norm()) / (norm if norm > 0 else 1.0)
