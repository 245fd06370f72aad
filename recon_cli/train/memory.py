"""How much memory a training run will take, told before it starts.

The figures per Gaussian and per pixel are counted from what the code allocates and rounded up;
`recon bench` prints what a step really holds.
"""

from __future__ import annotations

from dataclasses import dataclass

from recon_cli.errors import TrainingError

# values, gradients and two moments of 59 float32, and a copy of the values and of one moment
# while densification rebuilds them
_PER_GAUSSIAN = 4 * 4 * 59 + 4 * 59 + 4 * 45
# a record, indices and the gradient sums of about six tiles
_BUFFERS_PER_GAUSSIAN = 128 + 6 * 72
_BUFFERS_PER_PIXEL = 96  # image, its gradient, three maps of the loss, transmittance
_PROGRAM = 350 << 20  # Python, torch and the kernels
_TORCH_FACTOR = 4  # autograd keeps what the fused kernels compute again


@dataclass(frozen=True)
class MemoryEstimate:
    """The bytes that a run needs at its peak.

    Attributes:
        images: all views as uint8, and their masks.
        pixel_buffers: of one step, for each pixel of a view.
        gaussians: parameters, gradients, moments at the largest count.
        gaussian_buffers: of one step, for each Gaussian.
        program: everything else.
    """

    images: int
    pixel_buffers: int
    gaussians: int
    gaussian_buffers: int
    program: int

    @property
    def total(self) -> int:
        """Sum of all parts."""
        return (self.images + self.pixel_buffers + self.gaussians + self.gaussian_buffers
                + self.program)

    def described(self) -> str:
        """Returns the estimate in words."""
        buffers = self.pixel_buffers + self.gaussian_buffers
        return (f"about {_megabytes(self.total)} (images {_megabytes(self.images)}, Gaussians "
                f"{_megabytes(self.gaussians)}, buffers {_megabytes(buffers)})")


def estimate(
    *, views: int, width: int, height: int, gaussians: int, fused: bool, masks: int = 0
) -> MemoryEstimate:
    """Returns the memory that training takes.

    Args:
        views: held in memory.
        width: of the largest view in pixels.
        height: of the largest view in pixels.
        gaussians: the most that there will be.
        fused: the backend computes gradients without autograd.
        masks: held in memory.
    """
    pixels = width * height
    factor = 1 if fused else _TORCH_FACTOR
    return MemoryEstimate(
        images=pixels * (3 * views + masks), pixel_buffers=factor * pixels * _BUFFERS_PER_PIXEL,
        gaussians=gaussians * _PER_GAUSSIAN,
        gaussian_buffers=factor * gaussians * _BUFFERS_PER_GAUSSIAN, program=_PROGRAM)


def room(needed: MemoryEstimate, free: int, *, fused: bool) -> int:
    """Returns the most Gaussians that fit into `free` bytes; 0 where not even the rest does.

    Args:
        needed: estimate without any Gaussian.
        free: bytes.
        fused: as in `estimate`.
    """
    factor = 1 if fused else _TORCH_FACTOR
    each = _PER_GAUSSIAN + factor * _BUFFERS_PER_GAUSSIAN
    return max(0, (free - needed.total) // each)


def refuse_what_does_not_fit(needed: MemoryEstimate, free: int) -> None:
    """Raises TrainingError, saying what to lower, unless the estimate fits into `free` bytes."""
    if needed.total <= free:
        return
    by_size = needed.images + needed.pixel_buffers
    by_count = needed.gaussians + needed.gaussian_buffers
    lower = "--max-size" if by_size > by_count else "--max-gaussians"
    raise TrainingError(
        f"Training needs {needed.described()}, but {_megabytes(free)} are free.",
        hint=f"Lower {lower}, or close other programs.")


def _megabytes(count: int) -> str:
    return f"{count / 1e6:,.0f} MB"
