"""Adam over all parameters of all Gaussians in one launch (Kingma and Ba 2015, algorithm 1).

The step count lies on the device: a step that comes to nothing there is not counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import triton
import triton.language as tl
from torch import Tensor

BLOCK = 1024  # numbers a program
GROUPS = 6  # means, quats, log_scales, logit_opacities, sh_dc, sh_rest


@triton.jit
def move(value, gradient, first, second, i, here, rate, keep1, keep2, add1, add2, root1, root2,
         epsilon, WHOLE: tl.constexpr):
    """Moves numbers i [BLOCK] of one group against its gradient; changes the moments, too.

        m <- b1 m + (1 - b1) g,  v <- b2 v + (1 - b2) g^2,
        p <- p - rate (m / c1) / (sqrt(v / c2) + epsilon)

    `keep` are b1 and b2, `add` 1 - b1 and 1 - b2, which would cancel in float32, `root1` 1 / c1 and
    `root2` 1 / sqrt(c2). With WHOLE all numbers are there, and a lane takes four at a time.
    """
    mask = None if WHOLE else here
    g = tl.load(gradient + i, mask=mask)
    m = tl.load(first + i, mask=mask) * keep1 + g * add1
    v = tl.load(second + i, mask=mask) * keep2 + g * g * add2
    p = tl.load(value + i, mask=mask)
    tl.store(first + i, m, mask=mask)
    tl.store(second + i, v, mask=mask)
    tl.store(value + i, p - m * (rate * root1) / (tl.sqrt(v) * root2 + epsilon), mask=mask)


@triton.jit
def move_block(value, gradient, first, second, block, count, rate, keep1, keep2, add1, add2,
               root1, root2, epsilon, BLOCK: tl.constexpr):
    """Moves block `block` of `count` numbers; see `move`."""
    i = block.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    if (block + 1) * BLOCK <= count:
        move(value, gradient, first, second, i, i < count, rate, keep1, keep2, add1, add2, root1,
             root2, epsilon, WHOLE=True)
    else:
        move(value, gradient, first, second, i, i < count, rate, keep1, keep2, add1, add2, root1,
             root2, epsilon, WHOLE=False)


@triton.jit(do_not_specialize=("n0", "n1", "n2", "n3", "n4", "n5"))
def adam(p0, p1, p2, p3, p4, p5, g0, g1, g2, g3, g4, g5, m0, m1, m2, m3, m4, m5,
         v0, v1, v2, v3, v4, v5, n0, n1, n2, n3, n4, n5, r0, r1, r2, r3, r4, r5,
         taken, counted, keep1, keep2, add1, add2, log2_keep1, log2_keep2, epsilon,
         GATED: tl.constexpr, BLOCK: tl.constexpr):
    """Moves six groups; a program has a block of one of them.

    For each group: values `p`, gradients `g`, moments `m` and `v`, how many numbers `n` move (all
    or none) and the learning rate `r`. `taken` [1] int64 counts the steps, this one included. With
    GATED nothing moves where `counted` [1] int32 is zero. The rest is as in `move`.
    """
    going = 1
    if GATED:
        going = tl.load(counted)
    if going != 0:
        steps = tl.load(taken).to(tl.float64)
        # in float64: 1 - b^t cancels
        root1 = (1.0 / (1.0 - tl.exp2(steps * log2_keep1))).to(tl.float32)
        root2 = (1.0 / tl.sqrt(1.0 - tl.exp2(steps * log2_keep2))).to(tl.float32)
        b = tl.program_id(0)
        b1 = b - tl.cdiv(n0, BLOCK)
        b2 = b1 - tl.cdiv(n1, BLOCK)
        b3 = b2 - tl.cdiv(n2, BLOCK)
        b4 = b3 - tl.cdiv(n3, BLOCK)
        b5 = b4 - tl.cdiv(n4, BLOCK)
        if b1 < 0:
            move_block(p0, g0, m0, v0, b, n0, r0, keep1, keep2, add1, add2, root1,
                       root2, epsilon, BLOCK)
        elif b2 < 0:
            move_block(p1, g1, m1, v1, b1, n1, r1, keep1, keep2, add1, add2, root1,
                       root2, epsilon, BLOCK)
        elif b3 < 0:
            move_block(p2, g2, m2, v2, b2, n2, r2, keep1, keep2, add1, add2, root1,
                       root2, epsilon, BLOCK)
        elif b4 < 0:
            move_block(p3, g3, m3, v3, b3, n3, r3, keep1, keep2, add1, add2, root1,
                       root2, epsilon, BLOCK)
        elif b5 < 0:
            move_block(p4, g4, m4, v4, b4, n4, r4, keep1, keep2, add1, add2, root1,
                       root2, epsilon, BLOCK)
        else:
            move_block(p5, g5, m5, v5, b5, n5, r5, keep1, keep2, add1, add2, root1,
                       root2, epsilon, BLOCK)


def step(
    values: Sequence[Tensor], gradients: Sequence[Tensor],
    moments: tuple[Sequence[Tensor], Sequence[Tensor]], rates: Sequence[float | None], *,
    taken: Tensor, counted: Tensor | None, betas: tuple[float, float], epsilon: float,
) -> None:
    """Takes one step of Adam in place; nothing waits for the device.

    Args:
        values: six contiguous float32 tensors, one for each group of parameters.
        gradients: of the same sizes.
        moments: moving averages of the gradients, and of their squares, with the decays `betas`.
        rates: learning rate of each group; None leaves the group alone.
        taken: [1] int64, steps taken; one more where this one counts.
        counted: [1] int32, zero where the step comes to nothing; None where it counts anyway.
    """
    if len(values) != GROUPS:
        raise ValueError(f"{len(values)} groups of parameters, needed {GROUPS}")
    taken += 1 if counted is None else counted
    sizes = [0 if rate is None else value.numel()
             for value, rate in zip(values, rates, strict=True)]
    programs = sum(triton.cdiv(size, BLOCK) for size in sizes)
    adam[(programs,)](
        *values, *gradients, *moments[0], *moments[1], *sizes, *(rate or 0.0 for rate in rates),
        taken, counted, *betas, 1 - betas[0], 1 - betas[1], math.log2(betas[0]),
        math.log2(betas[1]), epsilon, GATED=counted is not None, BLOCK=BLOCK)
