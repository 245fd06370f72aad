"""The passes of one view through the kernels, and the buffers that the backward pass reads.

Buffers are reused from view to view: fresh pages cost as much as the arithmetic.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.render.contract import (
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    EllipseGradients,
    Statistics,
)
from recon_cli.render.numba import binning
from recon_cli.render.numba.composite_backward import BACKWARD_FLOATS, composite_backward
from recon_cli.render.numba.compositing import FORWARD_FLOATS, composite, tally
from recon_cli.render.numba.crossing import find_crossing
from recon_cli.render.numba.project_backward import GRADIENT_FLOATS, project_backward
from recon_cli.render.numba.projection import compact, cull, project
from recon_cli.render.numba.soa import (
    BLOCK, GRAD_BLUE, GRAD_DEPTH, GRAD_RED, LOG2_E, PROJECTION_FLOATS, RECORD, S_U, S_VV, SLOT,
    TILE_HEIGHT, TILE_PIXELS, TILE_WIDTH)
from recon_cli.kernels.viewpoint import viewpoint
from recon_cli.kernels.thread_pool import SCRATCH_FLOATS, empty_aligned, pool
from recon_cli.scene.camera import Camera

if TYPE_CHECKING:  # without gradients a view is drawn without it
    from torch import Tensor

assert max(PROJECTION_FLOATS, GRADIENT_FLOATS, FORWARD_FLOATS, BACKWARD_FLOATS) <= SCRATCH_FLOATS

@dataclass(frozen=True)
class PackedSplats:
    """The raw parameters of N Gaussians, or their gradients, as flat float32 arrays.

    `sh_rest` holds the first M Gaussians, `stride` numbers each: 0, 9, 24 or 45.
    """

    means: NDArray[np.float32]  # [N * 3]
    quats: NDArray[np.float32]  # [N * 4]
    log_scales: NDArray[np.float32]  # [N * 3]
    logit_opacities: NDArray[np.float32]  # [N]
    sh_dc: NDArray[np.float32]  # [N * 3]
    sh_rest: NDArray[np.float32]  # [M * stride]
    stride: int

    @staticmethod
    def from_tensors(tensors: Iterable[Tensor | NDArray[np.float32]]) -> PackedSplats:
        """Packs the raw parameters of splats: the same memory where they are contiguous."""
        *tensors, sh_rest = tensors
        means, quats, log_scales, logits, sh_dc = (flat(tensor) for tensor in tensors)
        return PackedSplats(means, quats, log_scales, logits, sh_dc, flat(sh_rest),
                            stride=3 * sh_rest.shape[1])


@dataclass(frozen=True)
class ImageBuffers:
    """The images of a view, or the gradients by them.

    Depth may be empty: it is not wanted. So may gradients of alpha and depth: zeros.
    """

    rgb: NDArray[np.float32]  # [H * W * 3]
    alpha: NDArray[np.float32]  # [H * W]
    depth: NDArray[np.float32]  # [H * W]


@dataclass(frozen=True)
class RenderSettings:
    """How a view is rendered."""

    background: NDArray[np.float32]  # [3]
    sh_degree: int  # in use; at most what the splats have is used
    scores: bool = False  # fill hits and blend weights of `Statistics` in the forward pass
    counting: NDArray[np.bool_] | None = None  # [H, W] pixels in the scores of both passes


def flat(tensor: Tensor | NDArray[np.float32]) -> NDArray[np.float32]:
    """Returns a CPU tensor, or an array, as a flat array: the same memory where contiguous."""
    if isinstance(tensor, np.ndarray):
        return tensor.reshape(-1)
    array: NDArray[np.float32] = tensor.detach().contiguous().numpy().reshape(-1)
    return array


class ViewPass:
    """Runs the passes of one view in its own buffers."""

    def __init__(self) -> None:
        self._buffers: dict[str, NDArray[Any]] = {}

    def take(self, name: str, size: int, dtype: Any = np.float32) -> NDArray[Any]:
        """Returns the buffer of a name with room for `size`, uninitialised."""
        buffer = self._buffers.get(name)
        if buffer is None or len(buffer) < size:
            buffer = self._buffers[name] = empty_aligned(size + size // 4 + 64, dtype)
        return buffer[:size]

    @property
    def bytes(self) -> int:
        """Memory of all buffers."""
        return sum(buffer.nbytes for buffer in self._buffers.values())

    def forward(
        self, splats: PackedSplats, camera: Camera, settings: RenderSettings, image: ImageBuffers,
        statistics: Statistics,
    ) -> None:
        """Renders into `image` and writes the statistics of the forward pass."""
        self.view = viewpoint(camera)
        stored = splats.stride // 3 if len(splats.sh_rest) else 0
        self.terms = min((settings.sh_degree + 1) ** 2 - 1, stored)
        self.background = settings.background
        self.cutoff = np.float32(np.log2(ALPHA_MIN))
        self._project(splats, statistics)
        self._bin()
        self._composite(settings, image)
        if settings.scores:
            totals = statistics.hits, statistics.blend_sum, statistics.blend_max
            for total in totals:
                total[:] = 0
            tally(self.ids, self.slot_start, self.hits, self.weights, self.peaks,
                  *(np.asarray(total) for total in totals))

    def crossing(
        self, splats: PackedSplats, camera: Camera, level: float, rows: NDArray[np.int32],
        statistics: Statistics,
    ) -> None:
        """Writes into `rows` [H * W] which Gaussian brings T down to `level`, -1 where none does.

        No backward pass may follow.
        """
        self.view, self.terms = viewpoint(camera), 0
        self.cutoff = np.float32(np.log2(ALPHA_MIN))
        self._project(splats, statistics)
        self._bin()
        pool.run(find_crossing, self.tile_start, self.members, self.records, self.ids,
                 self.view.width, self.view.height, self.tiles_x, self.cutoff, np.float32(level),
                 rows)

    def _project(self, splats: PackedSplats, statistics: Statistics) -> None:
        n = len(splats.logit_opacities)
        candidates = self.take("candidates", n, np.int32)
        counts, broken = np.empty(-(-n // BLOCK), np.int64), np.zeros(1, np.int64)
        pool.run(cull, splats.means, splats.log_scales, splats.logit_opacities, self.view,
                 ALPHA_MIN, candidates, counts, broken)
        self.block_starts = np.concatenate([[0], np.cumsum(counts)])
        m = int(self.block_starts[-1])
        self.ids = self.take("ids", m, np.int32)
        compact(candidates, counts, self.ids)
        self.records = self.take("records", m * RECORD)
        self.depths = self.take("depths", m, np.float64)
        self.rows = self.take("rows", 2 * m, np.int32)
        statistics.radii[:] = 0
        pool.run(project, self.ids, splats.means, splats.quats, splats.log_scales,
                 splats.logit_opacities, splats.sh_dc, splats.sh_rest, splats.stride, self.terms,
                 self.view, ALPHA_MIN, self.records, self.depths, self.rows,
                 flat(statistics.radii), broken)
        statistics.broken = int(broken[0])

    def _bin(self) -> None:
        m = len(self.ids)
        self.tiles_x = -(-self.view.width // TILE_WIDTH)
        tiles = self.tiles_x * -(-self.view.height // TILE_HEIGHT)
        span_starts = self.take("span_starts", m + 1, np.int64)
        binning.row_starts(self.rows, span_starts)
        spans = self.take("spans", 2 * int(span_starts[-1]), np.int32)
        per_gaussian = self.take("tiles", m, np.int32)
        order, visible = self.take("order", m, np.int32), np.zeros(1, np.int64)
        pool.run(binning.find_spans, self.records, self.rows, span_starts, self.tiles_x,
                 spans, per_gaussian, self.depths.view(np.uint64), order,
                 self.take("spare", m, np.int32), visible, scratch=False)
        self.slot_start = self.take("slot_start", m + 1, np.int64)
        binning.slot_starts(per_gaussian, self.slot_start)
        instances = int(self.slot_start[-1])
        parts = min(pool.size, 1 + int(visible[0]) // 1000)
        cuts = np.linspace(0, visible[0], parts + 1).astype(np.int64)
        places = np.zeros((parts, tiles), np.int64)
        pool.run(binning.count_tiles, cuts, order, self.rows, span_starts, spans, self.tiles_x,
                 places, scratch=False)
        self.tile_start = self.take("tile_start", tiles + 1, np.int64)
        binning.tile_starts(places, self.tile_start)
        self.members = self.take("members", instances, np.int32)
        self.slots = self.take("slots", instances, np.int32)
        pool.run(binning.fill_tiles, cuts, order, self.rows, span_starts, spans, self.tiles_x,
                 self.slot_start, places, self.members, self.slots, scratch=False)

    def _composite(self, settings: RenderSettings, image: ImageBuffers) -> None:
        tiles = len(self.tile_start) - 1
        self.final = self.take("final", tiles * TILE_PIXELS)
        self.last = self.take("last", tiles * TILE_PIXELS)
        self.met = self.take("met", len(self.members), np.uint32)
        scored = len(self.members) if settings.scores else 0
        self.hits = self.take("hits", scored, np.int32)
        self.weights, self.peaks = self.take("weights", scored), self.take("peaks", scored)
        self.hits[:], self.weights[:], self.peaks[:] = 0, 0, 0
        mask = settings.counting
        self.counting = self.take("counting", 0 if mask is None else mask.size, np.bool_)
        if mask is not None:  # a copy: writeable, or kernels would be compiled once more
            self.counting[:] = mask.reshape(-1)
        pool.run(
            composite, self.tile_start, self.members, self.records, self.view.width,
            self.view.height, self.tiles_x, self.cutoff,
            np.float32(TRANSMITTANCE_MIN), self.background, image.rgb,
            image.alpha, image.depth, self.final, self.last, self.met, settings.scores,
            self.counting, self.slots, self.hits, self.weights, self.peaks)

    def backward(
        self, splats: PackedSplats, gradients: PackedSplats, image: ImageBuffers,
        statistics: Statistics, *, loo: bool, harmonics: bool = True,
    ) -> None:
        """Writes gradients and statistics of all N Gaussians for the last forward pass.

        `image` holds the gradients of the loss; sh_rest of `gradients` is left alone at degree 0
        and without `harmonics`. With `loo` that is written too, over the pixels that counted in
        the forward pass.
        """
        sums = self.take("sums", len(self.members) * SLOT)
        pool.run(
            composite_backward, self.tile_start, self.members, self.slots, self.records,
            self.view.width, self.view.height, self.tiles_x, self.cutoff, self.background,
            self.final, self.last, self.met, image.rgb, image.alpha, image.depth, loo,
            self.counting, sums)
        pool.run(
            project_backward, self.ids, self.block_starts, self.slot_start, sums, self.depths,
            splats.means, splats.quats, splats.log_scales, splats.logit_opacities, splats.sh_dc,
            splats.sh_rest, splats.stride, self.terms, harmonics, self.view, self.records,
            gradients.means, gradients.quats, gradients.log_scales, gradients.logit_opacities,
            gradients.sh_dc, gradients.sh_rest, flat(statistics.means2d_grad),
            flat(statistics.variance), flat(statistics.loo))


    def ellipse_gradients(self) -> EllipseGradients:
        """Returns what the last backward pass summed over the pixels of each Gaussian."""
        import torch

        m = len(self.ids)
        sums = self.take("sums", len(self.members) * SLOT).reshape(-1, SLOT)[:, :S_VV + 1]
        totals = torch.segment_reduce(  # in order: the same bits every time
            torch.from_numpy(np.ascontiguousarray(sums)), "sum", axis=0, unsafe=True, initial=0,
            lengths=torch.from_numpy(np.diff(self.slot_start[:m + 1])))
        # u and v of the kernels hold a factor of sqrt(log2(e) / 2)
        factors = totals.new_tensor([2 / LOG2_E] * 5).pow(totals.new_tensor([0.5, 0.5, 1, 1, 1]))
        return EllipseGradients(
            torch.from_numpy(self.ids.astype(np.int64)), totals[:, S_U:S_VV + 1] * factors,
            totals[:, GRAD_RED:GRAD_BLUE + 1].clone(), totals[:, GRAD_DEPTH].clone())


_MOST_FREE = 8  # passes that are kept for their next use: of views that are drawn together
_free: list[ViewPass] = []
_free_lock = threading.RLock()  # a Lease may be collected while one is made


class Lease:
    """Holds a `ViewPass` of its own and returns it for reuse when the last reference goes."""

    def __init__(self) -> None:
        with _free_lock:
            self.view_pass = _free.pop() if _free else ViewPass()

    def __del__(self) -> None:
        with _free_lock:
            if len(_free) < _MOST_FREE:
                _free.append(self.view_pass)
