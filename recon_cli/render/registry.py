"""Which rasterizers there are, and which one is meant by a name."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from recon_cli.errors import BackendError
from recon_cli.render.contract import Renderer, RenderOutput, check_inputs
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

_OLDEST_GPU = (7, 5)  # compute capability, of Turing: what triton's kernels are compiled for

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class BackendStatus:
    """Whether a backend can run here.

    Attributes:
        name: what --backend takes.
        devices: where it runs.
        missing: why it cannot run; empty where it can.
    """

    name: str
    devices: tuple[str, ...]
    missing: str = ""


def available_backends() -> tuple[BackendStatus, ...]:
    """Returns every known backend, fastest first, each with the reason if it cannot run."""
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    missing = "" if importlib.util.find_spec("numba") else "the package numba is not installed"
    return (BackendStatus("triton", ("cuda",), _lacking_for_triton()),
            BackendStatus("numba", ("cpu",), missing), BackendStatus("torch", devices))


def _lacking_for_triton() -> str:
    """Returns why triton's kernels cannot run here; empty where they can."""
    if not torch.cuda.is_available():
        return "torch finds no CUDA device"
    if not importlib.util.find_spec("triton"):
        return "the package triton is not installed (it comes with torch for CUDA, on Linux)"
    found = torch.cuda.get_device_capability()
    if found < _OLDEST_GPU:
        return (f"the GPU has compute capability {'.'.join(map(str, found))}, needed "
                f"{'.'.join(map(str, _OLDEST_GPU))}")
    return ""


def resolve(backend: str, device: str) -> tuple[str, str]:
    """Returns (backend, device) with every `auto` replaced by what will run.

    Raises:
        BackendError: what was asked for by name is not there; nothing else is used in its place.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise BackendError(
            "CUDA was asked for, but torch finds no CUDA device.",
            hint="Leave --device out, or run `recon doctor`.")
    chosen_device = device
    if device == "auto":
        chosen_device = "cuda" if torch.cuda.is_available() else "cpu"
    known = {status.name: status for status in available_backends()}
    if backend == "auto":
        able = [one for one in known.values() if chosen_device in one.devices]
        backend = next(one.name for one in able if not one.missing)
        for one in able[:[other.name for other in able].index(backend)]:
            logger.warning(
                "%s is used in place of %s: %s", backend, one.name, one.missing)
        logger.info("rasterizer: %s on %s (chosen automatically)", backend, chosen_device)
    if backend not in known:
        raise BackendError(
            f"There is no backend {backend!r}.", hint="Known are " + ", ".join(known) + ".")
    status = known[backend]
    if chosen_device not in status.devices or status.missing:
        reason = status.missing or f"it does not run on {chosen_device}"
        raise BackendError(f"Backend {backend} cannot be used: {reason}.", hint="See recon doctor.")
    return backend, chosen_device


def use_threads(backend: str, threads: int) -> None:
    """Lets a backend compute with `threads` CPU threads from now on."""
    if backend == "numba":
        from recon_cli.render.numba.thread_pool import pool

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
    """Gets a backend ready and returns the seconds that it took.

    Args:
        backend: a name from `available_backends`.
        on_kernel: called after each kernel.
    """
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
    raise BackendError(f"There is no backend {backend!r}.", hint="See recon doctor.")


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
        background: [3] colour behind everything.
        sh_degree: highest spherical-harmonics degree in use, 0 to 3; what the splats have beyond
            it is left out, and what they do not have counts as zero.
        backend: a name from `available_backends`.
        scores: also gather hits, blend_sum and blend_max, and loo in the backward pass.
        mask: [H, W] bool, the pixels over which the scores are taken; None takes all. It changes
            neither the picture nor a gradient.

    Returns:
        The image, alpha, depth and statistics; see `RenderOutput`.

    Raises:
        ValueError: a shape, dtype or device does not fit.
        BackendError: there is no such backend here.
    """
    check_inputs(splats, camera, background, sh_degree, mask)
    return renderer(backend)(splats, camera, background, sh_degree, scores, mask)
