"""One view on its way through the kernels: what the forward pass leaves for the backward pass.

A frame owns its memory and is used again: fresh pages cost as much as the arithmetic.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.render.contract import EXACT, Approximation, Statistics
from recon_cli.render.numba import binning
from recon_cli.render.numba.composite_backward import BACKWARD_FLOATS, decompose
from recon_cli.render.numba.composite_forward import FORWARD_FLOATS, composite, tally
from recon_cli.render.numba.project_backward import GRADIENT_FLOATS, unproject
from recon_cli.render.numba.projection import compact, cull, project
from recon_cli.render.numba.soa import (
    BLOCK,
    PROJECTION_FLOATS,
    RECORD,
    SLOT,
    TILE_HEIGHT,
    TILE_PIXELS,
    TILE_WIDTH,
    Viewpoint,
)
from recon_cli.render.numba.thread_pool import SCRATCH_FLOATS, aligned, crew
from recon_cli.scene.camera import Camera

assert max(PROJECTION_FLOATS, GRADIENT_FLOATS, FORWARD_FLOATS, BACKWARD_FLOATS) <= SCRATCH_FLOATS

_MARGIN = 0.15  # of the image on each side, within which x/z and y/z are held


@dataclass(frozen=True)
class Parameters:
    """The raw parameters (or their gradients) of N Gaussians as flat float32 arrays.

    Attributes:
        means: [N * 3].
        quats: [N * 4].
        log_scales: [N * 3].
        logit_opacities: [N].
        sh_dc: [N * 3].
        sh_rest: [M * stride] of the first M Gaussians.
        stride: higher SH coefficients of such a Gaussian: 0, 9, 24 or 45.
    """

    means: NDArray[np.float32]
    quats: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    logit_opacities: NDArray[np.float32]
    sh_dc: NDArray[np.float32]
    sh_rest: NDArray[np.float32]
    stride: int

    @staticmethod
    def of(tensors: Iterable[Tensor]) -> Parameters:
        """Returns the raw parameters of splats; the same memory where they are contiguous."""
        means, quats, log_scales, logits, sh_dc, sh_rest = tensors
        return Parameters(
            flat(means), flat(quats), flat(log_scales), flat(logits), flat(sh_dc), flat(sh_rest),
            stride=3 * sh_rest.shape[1])


def flat(tensor: Tensor) -> NDArray[np.float32]:
    """Returns a CPU tensor as a flat array: the same memory where it is contiguous."""
    array: NDArray[np.float32] = tensor.detach().contiguous().numpy().reshape(-1)
    return array


def viewpoint(camera: Camera) -> Viewpoint:
    """Returns a camera as kernels take it."""
    wide, high = _MARGIN * camera.width, _MARGIN * camera.height
    return Viewpoint(
        np.ascontiguousarray(camera.viewmat[:3, :3], np.float64).reshape(-1),
        np.ascontiguousarray(camera.viewmat[:3, 3], np.float64),
        np.ascontiguousarray(camera.center, np.float64),
        float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy),
        int(camera.width), int(camera.height),
        (-camera.cx - wide) / camera.fx, (camera.width - camera.cx + wide) / camera.fx,
        (-camera.cy - high) / camera.fy, (camera.height - camera.cy + high) / camera.fy)


class Frame:
    """The buffers of one view, and the passes that fill them."""

    def __init__(self) -> None:
        self._buffers: dict[str, NDArray[Any]] = {}
        self.pairs_forward = 0
        self.pairs_backward = 0
        self.broken = 0

    def take(self, name: str, size: int, dtype: Any = np.float32) -> NDArray[Any]:
        """Returns the buffer of a name with room for `size`, uninitialised."""
        held = self._buffers.get(name)
        if held is None or len(held) < size:
            held = self._buffers[name] = aligned(size + size // 4 + 64, dtype)
        return held[:size]

    @property
    def bytes(self) -> int:
        """Memory of all buffers."""
        return sum(buffer.nbytes for buffer in self._buffers.values())

    def forward(
        self, splats: Parameters, camera: Camera, background: NDArray[np.float32],
        sh_degree: int, *, rgb: NDArray[np.float32], alpha: NDArray[np.float32],
        depth: NDArray[np.float32], radii: NDArray[np.float32],
        approximation: Approximation = EXACT, scores: bool = False,
        counting: NDArray[np.bool_] | None = None,
    ) -> None:
        """Renders into rgb [H*W*3], alpha [H*W] and depth [H*W]; radii [N] must hold zeros.

        Of `sh_degree` is used what the splats have. The scores, in this pass and the next backward
        one, are taken over the pixels where counting [H, W] is True; over all where it is None.
        """
        self.view = viewpoint(camera)
        stored = splats.stride // 3 if len(splats.sh_rest) else 0
        self.terms = min((sh_degree + 1) ** 2 - 1, stored)
        self.background = background
        self.cutoff = np.float32(np.log2(approximation.alpha_min))
        self._project(splats, radii, approximation)
        self._bin(approximation.square)
        tiles = len(self.tile_start) - 1
        self.final = self.take("final", tiles * TILE_PIXELS)
        self.last = self.take("last", tiles * TILE_PIXELS)
        evaluated = np.zeros(1, np.int64)
        scored = len(self.members) if scores else 0
        self.hits = self.take("hits", scored, np.int32)
        self.weights, self.peaks = self.take("weights", scored), self.take("peaks", scored)
        self.hits[:], self.weights[:], self.peaks[:] = 0, 0, 0
        self.counting = self.take("counting", 0 if counting is None else counting.size, np.bool_)
        if counting is not None:  # a copy: writeable, or kernels would be compiled once more
            self.counting[:] = counting.reshape(-1)
        crew.run(
            composite, self.tile_start, self.members, self.records, self.view.width,
            self.view.height, self.tiles_x, self.cutoff,
            np.float32(approximation.transmittance_min), background, rgb, alpha, depth,
            self.final, self.last, scores, self.counting, self.slots, self.hits, self.weights,
            self.peaks, evaluated)
        self.pairs_forward = int(evaluated[0])

    def _project(
        self, splats: Parameters, radii: NDArray[np.float32], approximation: Approximation
    ) -> None:
        n = len(splats.logit_opacities)
        candidates = self.take("candidates", n, np.int32)
        counts, broken = np.empty(-(-n // BLOCK), np.int64), np.zeros(1, np.int64)
        crew.run(cull, splats.means, splats.log_scales, splats.logit_opacities, self.view,
                 approximation.alpha_min, candidates, counts, broken)
        self.block_starts = np.concatenate([[0], np.cumsum(counts)])
        m = int(self.block_starts[-1])
        self.ids = self.take("ids", m, np.int32)
        compact(candidates, counts, self.ids)
        self.records = self.take("records", m * RECORD)
        self.depths = self.take("depths", m, np.float64)
        self.rows = self.take("rows", 2 * m, np.int32)
        crew.run(project, self.ids, splats.means, splats.quats, splats.log_scales,
                 splats.logit_opacities, splats.sh_dc, splats.sh_rest, splats.stride, self.terms,
                 self.view, approximation.alpha_min, approximation.square, self.records,
                 self.depths, self.rows, radii, broken)
        self.broken = int(broken[0])

    def _bin(self, square: bool) -> None:
        m = len(self.ids)
        self.tiles_x = -(-self.view.width // TILE_WIDTH)
        tiles = self.tiles_x * -(-self.view.height // TILE_HEIGHT)
        span_starts = self.take("span_starts", m + 1, np.int64)
        binning.row_starts(self.rows, span_starts)
        spans = self.take("spans", 2 * int(span_starts[-1]), np.int32)
        per_gaussian = self.take("tiles", m, np.int32)
        crew.run(binning.find_spans, self.records, self.rows, span_starts, self.tiles_x,
                 square, spans, per_gaussian, scratch=False)
        order = self.take("order", m, np.int32)
        visible = binning.order_by_depth(
            self.depths.view(np.uint64), per_gaussian, order, self.take("spare", m, np.int32))
        self.slot_start = self.take("slot_start", m + 1, np.int64)
        binning.slot_starts(per_gaussian, self.slot_start)
        instances = int(self.slot_start[-1])
        parts = min(crew.size, 1 + visible // 1000)
        cuts = np.linspace(0, visible, parts + 1).astype(np.int64)
        places = np.zeros((parts, tiles), np.int64)
        crew.run(binning.count_tiles, cuts, order, self.rows, span_starts, spans, self.tiles_x,
                 places, scratch=False)
        self.tile_start = self.take("tile_start", tiles + 1, np.int64)
        binning.tile_starts(places, self.tile_start)
        self.members = self.take("members", instances, np.int32)
        self.slots = self.take("slots", instances, np.int32)
        crew.run(binning.fill_tiles, cuts, order, self.rows, span_starts, spans, self.tiles_x,
                 self.slot_start, places, self.members, self.slots, scratch=False)

    def tally(self, statistics: Statistics) -> None:
        """Writes the scores of the last forward pass over those of `statistics`."""
        found = statistics.hits, statistics.blend_sum, statistics.blend_max
        for values in found:
            values.zero_()
        tally(self.ids, self.slot_start, self.hits, self.weights, self.peaks,
              *(values.numpy() for values in found))

    def backward(
        self, splats: Parameters, gradients: Parameters, *, grad_rgb: NDArray[np.float32],
        grad_alpha: NDArray[np.float32], grad_depth: NDArray[np.float32],
        details: bool, scores: bool,
        means2d_grad: NDArray[np.float32], absolute_grad: NDArray[np.float32],
        variance: NDArray[np.float32], loo: NDArray[np.float32],
    ) -> None:
        """Writes gradients and statistics of all N Gaussians for the last forward pass.

        Args:
            splats: as in the forward pass.
            gradients: out; sh_rest is left alone at degree 0.
            grad_rgb: [H * W * 3].
            grad_alpha: [H * W], or empty for zeros.
            grad_depth: [H * W], or empty for zeros.
            details: fill absolute_grad and variance.
            scores: fill loo, over the pixels that counted in the forward pass.
            means2d_grad: [N * 2] out.
            absolute_grad: [N * 2] out.
            variance: [N] out.
            loo: [N] out.
        """
        sums = self.take("sums", len(self.members) * SLOT)
        evaluated = np.zeros(1, np.int64)
        crew.run(
            decompose, self.tile_start, self.members, self.slots, self.records, self.view.width,
            self.view.height, self.tiles_x, self.cutoff, self.background,
            self.final, self.last, grad_rgb, grad_alpha, grad_depth, details, scores,
            self.counting, sums, evaluated)
        self.pairs_backward = int(evaluated[0])
        crew.run(
            unproject, self.ids, self.block_starts, self.slot_start, sums, self.depths,
            splats.means, splats.quats, splats.log_scales, splats.logit_opacities, splats.sh_dc,
            splats.sh_rest, splats.stride,
            self.terms, self.view, self.records, gradients.means, gradients.quats,
            gradients.log_scales, gradients.logit_opacities, gradients.sh_dc, gradients.sh_rest,
            means2d_grad, absolute_grad, variance, loo)


_KEPT = 2  # frames that wait for their next use


class _Pool:
    """Frames that nobody uses now."""

    def __init__(self) -> None:
        self._free: list[Frame] = []
        self._lock = threading.Lock()

    def take(self) -> Frame:
        with self._lock:
            return self._free.pop() if self._free else Frame()

    def give_back(self, frame: Frame) -> None:
        with self._lock:
            if len(self._free) < _KEPT:
                self._free.append(frame)


pool = _Pool()


class Lease:
    """Holds a frame and gives it back when the last reference goes."""

    def __init__(self) -> None:
        self.frame = pool.take()

    def __del__(self) -> None:
        pool.give_back(self.frame)
