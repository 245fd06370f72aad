"""The rasterizer backends: which can run here, which one `auto` takes, and the function of each."""

from __future__ import annotations

import importlib.util
import logging
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from recon_cli.errors import BackendError, name_command
from recon_cli.render.contract import (
    TRANSMITTANCE_MIN,
    Renderer,
    RenderOutput,
    check_inputs,
)
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

if TYPE_CHECKING:
    from recon_cli.render.self_check import Verdict

_SEEN = "RECON_GPU"  # environment variable of processes that see one GPU alone: its cuda:N
_OLDEST_GPU = (7, 5)  # compute capability, of Turing: what triton's kernels are compiled for

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class BackendStatus:
    """Whether a backend can run here."""

    name: str  # what --backend takes
    devices: tuple[str, ...]  # where it runs
    missing: str = ""  # why it cannot run; empty where it can


def available_backends() -> tuple[BackendStatus, ...]:
    """Returns every known backend, fastest first, each with the reason if it cannot run."""
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    missing = "" if importlib.util.find_spec("numba") else "the package numba is not installed"
    return (BackendStatus("triton", ("cuda",), _why_no_triton()),
            BackendStatus("numba", ("cpu",), missing), BackendStatus("torch", devices))


def _why_no_triton() -> str:
    """Returns why triton's kernels cannot run here; empty where they can."""
    if not torch.cuda.is_available():
        return "torch finds no CUDA device"
    if not importlib.util.find_spec("triton"):
        return "the package triton is not installed (it comes with torch for CUDA, on Linux)"
    capability = torch.cuda.get_device_capability()
    if capability < _OLDEST_GPU:
        return (f"the GPU has compute capability {'.'.join(map(str, capability))}, needed "
                f"{'.'.join(map(str, _OLDEST_GPU))}")
    return ""


def cuda_verdict() -> Verdict | None:
    """Returns the self-check of triton on this GPU, run now if it never was; None without one."""
    if _why_no_triton():
        return None
    from recon_cli.render.self_check import verdict_for

    return verdict_for("triton", torch.device("cuda"))


def resolve(backend: str, device: str) -> tuple[str, str]:
    """Returns (backend, device) with every `auto` replaced by the actual choice.

    The device is then cpu or cuda: of `cuda:N` this process, and each that it starts, sees that
    GPU alone, which must be asked for before anything else uses CUDA.

    On CUDA `auto` takes triton only where its kernels passed the self-check on this GPU. A backend
    that was named runs even where it failed, with a warning: it may be the check that is wrong.
    BackendError if the named one cannot run; nothing else is used instead.
    """
    if device.startswith("cuda:"):
        device = _see_one_gpu(device)
    if device == "cuda" and not torch.cuda.is_available():
        raise BackendError(
            "CUDA was asked for, but torch finds no CUDA device.",
            hint=f"Leave --device out, or run {name_command('doctor')}.")
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    known = {status.name: status for status in available_backends()}
    if backend == "auto":
        return _fastest(known.values(), device), device
    if backend not in known:
        raise BackendError(
            f"Unknown backend {backend!r}.", hint="Known are " + ", ".join(known) + ".")
    status = known[backend]
    if device not in status.devices or status.missing:
        reason = status.missing or f"it does not run on {device}"
        raise BackendError(
            f"Backend {backend} cannot be used: {reason}.", hint=f"See {name_command('doctor')}.")
    verdict = cuda_verdict() if backend == "triton" else None
    if verdict is not None and not verdict.passed:
        logger.warning(
            "the triton kernels failed their self-check on %s (%s): results may be wrong. "
            "`--backend torch` is slower and safe.", verdict.device, verdict.failure)
    return backend, device


def _see_one_gpu(device: str) -> str:
    """Hides all GPUs but one from CUDA and returns "cuda"; BackendError if that one is not there.

    Not by torch's current device, which other threads and the kernels in them do not have.
    """
    if os.environ.get(_SEEN) == device:  # perhaps by the process that started this one
        return "cuda"
    index, count = int(device.partition(":")[2]), torch.cuda.device_count()
    if index >= count:
        there = ", ".join(f"cuda:{number}" for number in range(count))
        raise BackendError(
            f"{device} was asked for, but torch finds {there or 'no CUDA device'}.",
            hint="Give --device one of those." if count else
            f"Leave --device out, or run {name_command('doctor')}.")
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    names = visible.split(",") if visible else [str(number) for number in range(count)]
    os.environ |= {"CUDA_VISIBLE_DEVICES": names[index].strip(), _SEEN: device}
    return "cuda"


def _fastest(backends: Iterable[BackendStatus], device: str) -> str:
    """Returns the first backend that can be used on a device, and logs why others cannot."""
    reasons = {}
    for status in backends:
        if device not in status.devices:
            continue
        reason = status.missing
        if not reason and status.name == "triton":
            verdict = cuda_verdict()
            if verdict is not None and not verdict.passed:
                reason = f"its self-check on {verdict.device} failed: {verdict.failure}"
        if not reason:
            break
        reasons[status.name] = reason
    for name, reason in reasons.items():
        logger.warning("%s is used in place of %s: %s", status.name, name, reason)
    logger.info("rasterizer: %s on %s (chosen automatically)", status.name, device)
    return status.name


def renders_on_cpu(backend: str, device: str) -> bool:
    """Returns whether these options, `auto` or a name, come to the numba backend."""
    by_choice = backend == "numba" or (backend == "auto" and importlib.util.find_spec("numba"))
    return bool(by_choice) and (device == "cpu" or (
        device == "auto" and not torch.cuda.is_available()))


def use_threads(backend: str, threads: int) -> None:
    """Lets a backend compute with `threads` CPU threads from now on."""
    if backend == "numba":
        from recon_cli.kernels.thread_pool import pool

        pool.threads = threads
        # torch's own threads spin after each operation and would take the cores from the kernels
        threads = 1
    torch.set_num_threads(threads)


def kernels_to_compile(backend: str) -> int:
    """Returns how many kernels a backend must compile on this machine before its first image."""
    if backend != "numba":
        return 0
    from recon_cli.render.numba import backend as numba_backend

    return 0 if numba_backend.is_warm() else numba_backend.KERNELS


def prepare(backend: str, on_kernel: Callable[[], None]) -> float:
    """Gets a backend ready and returns the seconds it took; calls `on_kernel` after each kernel."""
    if backend != "numba":
        return 0.0
    from recon_cli.render.numba.backend import warm_up

    return warm_up(on_kernel)


def renderer(backend: str) -> Renderer:
    """Returns the render function of a backend, imported only now."""
    if backend == "torch":
        from recon_cli.render.torch.tiles import render as torch_render

        return torch_render
    if backend == "numba":
        from recon_cli.render.numba.backend import render as numba_render

        return numba_render
    if backend == "triton":
        from recon_cli.render.triton.backend import render as triton_render

        return triton_render
    raise BackendError(f"Unknown backend {backend!r}.", hint=f"See {name_command('doctor')}.")


def render(
    splats: Splats,
    camera: Camera,
    background: Tensor,  # [3]
    sh_degree: int,
    *,
    backend: str = "torch",
    scores: bool = False,
    mask: Tensor | None = None,  # [H, W]
) -> RenderOutput:
    """Renders `splats` as `camera` sees them (3D Gaussian Splatting, Kerbl et al. 2023).

    Args:
        splats: N Gaussians; gradients flow to every raw parameter that requires them.
        camera: a pinhole camera, OpenCV axes, pixel centres at +0.5.
        background: colour behind everything.
        sh_degree: highest degree in use, 0 to 3; coefficients that the splats lack count as zero.
        backend: a name from `available_backends`.
        scores: also gather hits, blend_sum and blend_max, and loo in the backward pass.
        mask: bool, the pixels that the scores are taken over, None for all; it changes neither the
            image nor a gradient.

    Raises:
        ValueError: a shape, dtype or device does not fit.
        BackendError: the backend is unknown or not available here.
    """
    check_inputs(splats, camera, background, sh_degree, mask)
    return renderer(backend)(splats, camera, background, sh_degree, scores, mask)


def find_crossing(
    splats: Splats, camera: Camera, level: float = 0.5, *, backend: str = "torch"
) -> Tensor:
    """Returns which Gaussian of each pixel brings the transmittance down to `level`, [H, W] int64.

    -1 where it stays above. At 1/2 it is the Gaussian of the median depth (2D Gaussian Splatting,
    Huang et al. 2024). Fragments and their order are those of `render`; nothing is differentiable.
    With triton the torch backend answers, on the same device: no training waits for this.

    Args:
        splats: N Gaussians.
        camera: as in `render`.
        level: transmittance, above 1e-4 and below 1.
        backend: a name from `available_backends`.

    Raises:
        ValueError: a shape, dtype or device does not fit, or the level is none.
        BackendError: the backend is unknown or not available here.
    """
    check_inputs(splats, camera, splats.means.new_zeros(3), 0, None)
    if not TRANSMITTANCE_MIN < level < 1:
        raise ValueError(f"level is {level}, needed between {TRANSMITTANCE_MIN} and 1")
    with torch.no_grad():
        if backend == "numba":
            from recon_cli.render.numba.backend import find_crossing as numba_crossing

            return numba_crossing(splats, camera, level)
        renderer(backend)
        from recon_cli.render.torch.tiles import find_crossing as torch_crossing

        return torch_crossing(splats, camera, level)
