"""Which Gaussians may be seen: a cheap bound for all, so that the rest works on those alone."""

from __future__ import annotations

import math

import numpy as np

from recon_cli.render.contract import DILATION, NEAR
from recon_cli.render.numba.kernel import kernel
from recon_cli.render.numba.lane_functions import (
    absolute,
    bits,
    count_bits,
    exp2,
    lane_numbers,
    lowest_bit,
    maximum,
    minimum,
    square_root,
)
from recon_cli.render.numba.lane_memory import fetch_add, load
from recon_cli.render.numba.lanes import LANES
from recon_cli.render.numba.layout import LOG2_E
from recon_cli.render.numba.planes import BLOCK

INFINITE = np.float32(3e38)
_SLACK = 1e-3  # culling keeps what rounding leaves in doubt
_F = np.float32


@kernel
def cull(counter, means, log_scales, logits, view, alpha_min, candidates, counts, broken, scratch):
    """Writes the ids that may be seen, block by block, and how many each block has.

    The largest axis bounds the ellipse: its half extent is at most
    sqrt(2 ln(1 / alpha_min) (s_max^2 |J|^2 + 0.3)). What is not finite is not seen and counts as
    broken.
    """
    n = len(logits)
    blocks = (n + BLOCK - 1) // BLOCK
    f = _F(max(view.fx, view.fy))
    logit_min = _F(math.log(alpha_min / (1 - alpha_min)) - _SLACK)
    reach = _F(-2 * math.log(alpha_min) * (1 + _SLACK) + _SLACK)  # greatest 2 ln(o / alpha_min)
    R, bad = view.R, 0
    while True:
        block = fetch_add(counter, 0, 1)
        if block >= blocks:
            break
        to = block * BLOCK
        for first in range(block * BLOCK, min((block + 1) * BLOCK, n), LANES):
            count = min(LANES, n - first)
            for k in range(count):
                i = first + k
                x, y, z = means[3 * i], means[3 * i + 1], means[3 * i + 2]
                scratch[k] = _F(R[0] * x + R[1] * y + R[2] * z + view.t[0])
                scratch[LANES + k] = _F(R[3] * x + R[4] * y + R[5] * z + view.t[1])
                scratch[2 * LANES + k] = _F(R[6] * x + R[7] * y + R[8] * z + view.t[2])
                scratch[3 * LANES + k] = max(
                    log_scales[3 * i], max(log_scales[3 * i + 1], log_scales[3 * i + 2]))
                scratch[4 * LANES + k] = logits[i]
                scratch[5 * LANES + k] = (
                    log_scales[3 * i] + log_scales[3 * i + 1] + log_scales[3 * i + 2])
            x, y, z = load(scratch, 0), load(scratch, LANES), load(scratch, 2 * LANES)
            per_z = 1.0 / z
            u, v = x * per_z, y * per_z
            tan_x = minimum(maximum(u, _F(view.tan_left)), _F(view.tan_right))
            tan_y = minimum(maximum(v, _F(view.tan_top)), _F(view.tan_bottom))
            scale = exp2(minimum(maximum(load(scratch, 3 * LANES) * LOG2_E, -60.0), 60.0))
            jacobian = f * per_z * scale
            radius = square_root(reach * (
                jacobian * jacobian * (2.0 + tan_x * tan_x + tan_y * tan_y) + DILATION)) + 1.0
            mean_x, mean_y = u * _F(view.fx) + _F(view.cx), v * _F(view.fy) + _F(view.cy)
            given = lane_numbers() < count
            finite = (absolute(x) + absolute(y) + absolute(z) + absolute(
                load(scratch, 4 * LANES)) + absolute(load(scratch, 5 * LANES)) < INFINITE)
            bad += count - count_bits(bits(finite & given))
            seen = ((z > NEAR) & (load(scratch, 4 * LANES) >= logit_min)
                    & (mean_x + radius > 0.0) & (mean_x - radius < _F(view.width))
                    & (mean_y + radius > 0.0) & (mean_y - radius < _F(view.height))
                    & given & finite)
            found = bits(seen)
            while found != 0:
                candidates[to] = first + lowest_bit(found)
                found &= found - np.uint64(1)
                to += 1
        counts[block] = to - block * BLOCK
    fetch_add(broken, 0, bad)


@kernel
def compact(candidates, counts, ids):
    """Writes the candidates of all blocks in a row, ascending."""
    to = 0
    for block in range(len(counts)):
        for k in range(counts[block]):
            ids[to] = candidates[block * BLOCK + k]
            to += 1
