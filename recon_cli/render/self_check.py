"""Checks the kernels of a backend against the torch backend on this device, and keeps the verdict.

Triton compiles for a GPU on which nobody may have tried these kernels. So before their first use
with a GPU, driver and version, they render small scenes and take training steps: images,
statistics, gradients, loss and Adam are compared with float64. The verdict is kept as JSON in
recon's cache folder. The camera's gradient is not compared: with triton, torch computes it.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import logging
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon_cli import machine
from recon_cli.errors import BackendError
from recon_cli.render.contract import Renderer, StepOptions, TargetImage
from recon_cli.render.response import Response, ResponseTensors
from recon_cli.render.torch.tiles import render as torch_render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import TERMS, Splats

logger = logging.getLogger("recon")

# Rounding alone stays under a tenth of these. A fragment within rounding of a threshold may change
# a pixel by up to 1/255: images are compared by their rms and loosely by their worst pixel.
_IMAGE_RMS, _IMAGE_WORST = 1e-4, 2e-2  # in units of max(1, greatest value)
_RELATIVE = 1e-3  # norm of the error over the norm, of gradients and statistics
_LOSS = 1e-5
_ADAM = 1e-2  # of the learning rate
_NOT_FINITE = 1e30  # stands for an error that is not finite: JSON has no number for it
_RATE, _BETAS, _EPSILON = 1e-3, (0.9, 0.999), 1e-15
_SSIM_WEIGHT = 0.2
_DEGREE = len(TERMS) - 1
_REPEATS = 4  # of a step: CUDA graphs are recorded at the third time and replayed from then on
_STATISTICS = "radii", "blend_sum", "means2d_grad", "loo"
_AdamGroups = tuple[
    list[Tensor], list[Tensor], tuple[list[Tensor], list[Tensor]], list[float | None]]
_DRIVER = Path("/proc/driver/nvidia/version")


@dataclass(frozen=True)
class Verdict:
    """The result of a self-check, as it is kept on disk."""

    backend: str
    device: str  # name of the GPU, or "cpu"
    failure: str  # the difference, or the exception; empty where all is well
    errors: dict[str, float]  # every comparison, as a multiple of the allowed difference
    seconds: float  # that the check took

    @property
    def passed(self) -> bool:
        """Whether the kernels may be used."""
        return not self.failure


@dataclass(frozen=True, eq=False)
class StepOutcome:
    """A training step: the loss, its gradients, and the parameters after one step of Adam."""

    loss: float
    gradients: Splats
    moved: Splats


@dataclass(frozen=True)
class BackendCandidate:
    """A backend that is to be checked."""

    name: str
    render: Renderer
    # by its own loss and optimizer; leaves the splats alone
    train_step: Callable[[Splats, Camera, TargetImage, StepOptions], StepOutcome]


def numba_candidate() -> BackendCandidate:
    """Returns the numba backend."""
    from recon_cli.render.numba.backend import render
    from recon_cli.render.numba.optimizer import step as adam
    from recon_cli.render.numba.step import PhotometricStep

    def train_step(
        splats: Splats, camera: Camera, target: TargetImage, options: StepOptions
    ) -> StepOutcome:
        gradients, moved = splats.map(torch.zeros_like), splats.map(torch.clone)
        loss = PhotometricStep()(splats, gradients, camera, target, options)
        adam(*_adam_groups(moved, gradients), count=1, betas=_BETAS, epsilon=_EPSILON)
        return StepOutcome(loss, gradients, moved)

    return BackendCandidate("numba", render, train_step)


def triton_candidate() -> BackendCandidate:
    """Returns the triton backend."""
    from recon_cli.render.triton.backend import render
    from recon_cli.render.triton.optimizer import step as adam
    from recon_cli.render.triton.step import PhotometricStep

    def train_step(
        splats: Splats, camera: Camera, target: TargetImage, options: StepOptions
    ) -> StepOutcome:
        gradients, moved = splats.map(torch.zeros_like), splats.map(torch.clone)
        step, steps = PhotometricStep(splats.means.device), 0
        while steps < _REPEATS:
            step(splats, gradients, camera, target, options)
            report = step.close()
            steps += report.stopped is None  # else there is room for it now
        adam(*_adam_groups(moved, gradients), counted=step.counted, betas=_BETAS,
             taken=torch.zeros(1, dtype=torch.int64, device=splats.means.device), epsilon=_EPSILON)
        return StepOutcome(report.loss, gradients, moved)

    return BackendCandidate("triton", render, train_step)


CANDIDATES = {"numba": numba_candidate, "triton": triton_candidate}


def _adam_groups(moved: Splats, gradients: Splats) -> _AdamGroups:
    """Returns values, gradients, moments and rates as the optimizers take them."""
    values, slopes = ([tensor.reshape(-1) for tensor in splats.parameters().values()]
                      for splats in (moved, gradients))
    first, second = ([torch.zeros_like(tensor) for tensor in values] for _ in range(2))
    return values, slopes, (first, second), [_RATE] * len(values)


def check(
    candidate: BackendCandidate, device: torch.device, *, count: int = 300, width: int = 80,
    height: int = 60,
) -> Verdict:
    """Compares a backend with the torch backend in float64 and returns the verdict.

    Whatever the backend raises is a verdict too. Scenes have `count` Gaussians.
    """
    start, errors = time.perf_counter(), {}
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    failure = ""
    try:
        for label, splats, camera in _scenes(count, width, height):
            splats = splats.map(lambda tensor: tensor.to(device))
            for quantity, error in _compare(candidate, splats, camera):
                errors[f"{quantity}, {label} scene"] = (
                    error if math.isfinite(error) else _NOT_FINITE)
        wrong = [f"{quantity}: error {error:.3g} times the allowed difference"
                 for quantity, error in errors.items() if error > 1]
        failure = "; ".join(wrong[:3]) + (f"; {len(wrong) - 3} more" if len(wrong) > 3 else "")
    except Exception as error:  # compilers and drivers raise many types
        failure = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return Verdict(candidate.name, name, failure, errors, time.perf_counter() - start)


def _scenes(count: int, width: int, height: int) -> Iterator[tuple[str, Splats, Camera]]:
    """Yields an ordinary scene and one of hard cases, float32 on the CPU: the same everywhere."""
    camera = Camera(width, height, 0.8 * width, 0.9 * width, width / 2 + 1.3, height / 2 - 0.7,
                    np.eye(4))
    yield "ordinary", _random_splats(count, seed=0), camera
    hard = _random_splats(count, seed=1)
    hard.log_scales[::7, 0] += 4.0  # needles
    hard.log_scales[1::7] -= 3.0  # smaller than a pixel
    hard.log_scales[2] = 1.5  # covers every tile
    hard.logit_opacities[::3] = 9.0  # alpha is clamped, pixels stop early
    hard.logit_opacities[4::9] = -7.0  # fainter than 1/255
    hard.means[5::11, 2] *= -1.0  # behind the camera
    hard.quats[6] = 0.0  # no rotation
    hard.means[8] = hard.means[7]  # a tie in depth
    hard.means[9, 0] = math.nan
    yield "hard", replace(hard, sh_rest=hard.sh_rest[: count // 2]), camera


def _random_splats(count: int, seed: int) -> Splats:
    rng = np.random.default_rng(seed)
    values = (
        rng.uniform([-1.8, -1.4, 1.0], [1.8, 1.4, 5.0], (count, 3)), rng.normal(size=(count, 4)),
        rng.normal(-2.3, 0.6, (count, 3)), rng.normal(0.5, 2.0, count),
        rng.normal(0, 0.8, (count, 3)), rng.normal(0, 0.1, (count, 15, 3)))
    return Splats(*(torch.from_numpy(value.astype(np.float32)) for value in values))


def _compare(
    candidate: BackendCandidate, splats: Splats, camera: Camera
) -> Iterator[tuple[str, float]]:
    """Yields each comparison with its error as a multiple of the allowed one."""
    ours, again = (_render_backward(candidate.render, splats, camera) for _ in range(2))
    truth = _render_backward(torch_render, splats.map(torch.Tensor.double), camera)
    for name, value in truth.items():
        if name in ("rgb", "alpha", "depth"):
            error = (ours[name] - value).abs() / max(1.0, float(value.abs().max()))
            yield name, max(float(error.square().mean().sqrt()) / _IMAGE_RMS,
                            float(error.max()) / _IMAGE_WORST)
        elif name == "radii":  # one backend may cull what another finds no pixel of
            both = (ours[name] > 0) & (value > 0)
            yield name, _relative(ours[name][both], value[both]) / _RELATIVE
        else:
            yield name, _relative(ours[name], value) / _RELATIVE
    yield "bits of a second run", float(sum(
        not torch.equal(value, again[name]) for name, value in ours.items())) * 2
    yield from _compare_steps(candidate, splats, camera)


def _compare_steps(
    candidate: BackendCandidate, splats: Splats, camera: Camera
) -> Iterator[tuple[str, float]]:
    """Yields the comparisons of plain training steps of each degree, and of one with all else.

    A run begins at degree 0: kernels of all degrees are compiled by now.
    """
    rng, shape = np.random.default_rng(2), (camera.height, camera.width)
    pixels = rng.integers(0, 256, (*shape, 3), np.uint8)
    masked = TargetImage(pixels, rng.random(shape) < 0.7, Response(
        np.array([0.8, 1.1, 1.3], np.float32), vignette=(-0.2, -0.1)))
    scores = StepOptions(_DEGREE, _SSIM_WEIGHT, details=True, scores=True, loo=True)
    for label, target, options in (
        ("step", TargetImage(pixels), StepOptions(_DEGREE, _SSIM_WEIGHT)),
        *((f"step of degree {degree}", TargetImage(pixels), StepOptions(degree, _SSIM_WEIGHT))
          for degree in range(_DEGREE)),
        ("masked step", masked, scores),
    ):
        result = candidate.train_step(splats, camera, target, options)
        loss, gradients = _reference_step(splats, camera, target, options.sh_degree)
        yield f"loss of a {label}", abs(result.loss - loss) / _LOSS
        for name, value in result.gradients.parameters().items():
            yield (f"gradient of {name} in a {label}",
                   _relative(value, getattr(gradients, name)) / _RELATIVE)
            slope = value.double()  # Adam is compared by itself: it turns signs of noise into steps
            expected = getattr(splats, name).double() - _RATE * slope / (slope.abs() + _EPSILON)
            # float32 rounds the sum
            error = (getattr(result.moved, name) - expected).abs() / (
                _ADAM * _RATE + 2**-22 * expected.abs())
            yield f"Adam of {name} in a {label}", float(error[expected.isfinite()].max())


def _render_backward(render: Renderer, splats: Splats, camera: Camera) -> dict[str, Tensor]:
    """Returns images, statistics and gradients of a random combination of the images."""
    leaves = splats.map(lambda tensor: tensor.clone().requires_grad_())
    background = splats.means.new_tensor([0.2, 0.5, 0.1]).requires_grad_()
    output = render(leaves, camera, background, _DEGREE, True)
    images = {"rgb": output.rgb, "alpha": output.alpha, "depth": output.depth}
    generator = torch.Generator().manual_seed(0)
    loss = sum((torch.randn(image.shape, generator=generator).to(image) * image).sum()
               for image in images.values())
    parameters = {**leaves.parameters(), "background": background}
    gradients = torch.autograd.grad(loss, list(parameters.values()))  # type: ignore[arg-type]
    return {
        **{name: image.detach() for name, image in images.items()},
        **{f"gradient of {name}": value for name, value in zip(parameters, gradients, strict=True)},
        **{name: getattr(output.statistics, name) for name in _STATISTICS},
        "broken": output.statistics.radii.new_tensor([float(output.statistics.broken > 0)])}


def _reference_step(
    splats: Splats, camera: Camera, target: TargetImage, degree: int
) -> tuple[float, Splats]:
    """Returns the loss (1 - w) L1 + w (1 - SSIM) and its gradients in float64, by autograd."""
    leaves = splats.map(lambda tensor: tensor.double().requires_grad_())
    device = splats.means.device
    rgb = torch_render(leaves, camera, leaves.means.new_zeros(3), degree, False).rgb
    truth = torch.from_numpy(target.pixels).to(device).double() / 255
    if target.response is not None:
        rgb = ResponseTensors(target.response, camera, rgb).apply(rgb)
    if target.mask is not None:
        rgb = torch.where(torch.from_numpy(target.mask).to(device)[..., None], rgb, truth)
    shift = torch.arange(-5, 6, device=device, dtype=torch.float64)
    window = torch.exp(-0.5 * (shift / 1.5) ** 2)
    window = (window[:, None] * window / window.sum() ** 2)[None, None]

    def blur(image: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(image.permute(2, 0, 1)[:, None], window, padding=5)

    x, y = blur(rgb), blur(truth)
    square = blur(rgb * rgb) + blur(truth * truth)
    product = blur(rgb * truth)
    ssim = ((2 * x * y + 1e-4) * (2 * (product - x * y) + 9e-4)
            / ((x * x + y * y + 1e-4) * (square - x * x - y * y + 9e-4)))
    loss = (1 - _SSIM_WEIGHT) * (rgb - truth).abs().mean() + _SSIM_WEIGHT * (1 - ssim.mean())
    gradients = torch.autograd.grad(
        loss, list(leaves.parameters().values()), materialize_grads=True)
    return float(loss.detach()), Splats(*gradients)


def _relative(ours: Tensor, truth: Tensor) -> float:
    """Returns the norm of the error over the norm of the truth."""
    return float((ours.double() - truth).norm() / truth.norm().clamp_min(1e-30))


# ---- the verdict on disk ----

_verdicts: dict[Path, Verdict] = {}  # of this process, also where nothing can be written


def verdict_for(backend: str, device: torch.device) -> Verdict:
    """Returns the kept verdict of a backend; checks it now where there is none.

    BackendError if the check left the device unusable for this process.
    """
    key = _key(backend, device)
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:16]
    path = machine.cache_root() / "self-check" / f"{backend}-{digest}.json"
    verdict = _verdicts.get(path) or _read(path, key)
    if verdict is None:
        logger.info("checking the %s kernels on this device, once", backend)
        verdict = check(CANDIDATES[backend](), device)
        _write(path, key, verdict)
        _require_usable(device, verdict)
    _verdicts[path] = verdict
    return verdict


def _key(backend: str, device: torch.device) -> dict[str, str]:
    """Returns everything that a verdict depends on."""
    here = Path(__file__).parent
    sources = hashlib.sha256()
    for path in sorted([*(here / backend).glob("*.py"), *here.glob("*.py")]):
        sources.update(path.name.encode() + b"\0" + path.read_bytes())
    key = {"backend": backend, "torch": torch.__version__, "cuda": str(torch.version.cuda),
           "recon": machine.versions()["recon"], "sources": sources.hexdigest()}
    try:
        key[backend] = importlib.metadata.version(backend)
    except importlib.metadata.PackageNotFoundError:
        key[backend] = "unknown"
    if device.type == "cuda":
        key["gpu"] = torch.cuda.get_device_name(device)
        key["capability"] = str(torch.cuda.get_device_capability(device))
        key["driver"] = _driver_version()
    return key


def _driver_version() -> str:
    """Returns the version of NVIDIA's driver as Linux tells it; empty elsewhere."""
    try:
        return _DRIVER.read_text(encoding="utf-8").splitlines()[0]
    except (OSError, IndexError):
        return ""


def _read(path: Path, key: dict[str, str]) -> Verdict | None:
    """Returns the verdict in a file; None where there is none that can be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["key"] != key:
            return None
        verdict = Verdict(**content["verdict"])
        return verdict if isinstance(verdict.failure, str) else None
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None


def _write(path: Path, key: dict[str, str], verdict: Verdict) -> None:
    """Keeps a verdict; other processes see the whole file or none."""
    partial = path.with_suffix(f".{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        partial.write_text(
            json.dumps({"key": key, "verdict": asdict(verdict)}, indent=1), encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        logger.warning("the self-check's verdict cannot be kept (%s); it is repeated in every run. "
                       "Set RECON_CACHE_DIR to a folder that can be written.", error)


def _require_usable(device: torch.device, verdict: Verdict) -> None:
    """Raises BackendError where a kernel's fault made CUDA unusable for this process."""
    if verdict.passed or device.type != "cuda":
        return
    try:
        torch.zeros(1, device=device).add(1).tolist()
    except RuntimeError as error:
        raise BackendError(
            f"The {verdict.backend} kernels fail on {verdict.device} ({verdict.failure}), and CUDA "
            "cannot be used by this process any more.",
            hint="Run the same command again: it will use torch instead.") from error
