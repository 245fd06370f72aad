"""Adam over all parameters of all Gaussians in one launch (Kingma and Ba 2015, algorithm 1).

The step count lies on the device: a step that comes to nothing there is not counted, and the host
need not know.
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
    """Moves a block of one group against its gradient.

        m <- b1 m + (1 - b1) g,  v <- b2 v + (1 - b2) g^2,
        p <- p - rate (m / c1) / (sqrt(v / c2) + epsilon)

    Args:
        value: numbers that are changed, as are the moments.
        gradient: of them.
        first: m.
        second: v.
        i: [BLOCK] which.
        here: [BLOCK] whether there is such a number; not looked at with WHOLE, which lets a lane
            take four numbers at a time.
        rate: learning rate.
        keep1: b1.
        keep2: b2.
        add1: 1 - b1, which would cancel in float32.
        add2: 1 - b2.
        root1: 1 / c1.
        root2: 1 / sqrt(c2).
        epsilon: keeps the quotient finite.
        WHOLE: all are there.
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

    Args:
        p0: [n0] values of the first group; so p1 to p5.
        g0: gradients.
        m0: first moments.
        v0: second moments.
        n0: numbers in the group that are to be moved; all or none.
        r0: its learning rate.
        taken: [1] int64, steps taken, this one included.
        counted: [1] int32; with GATED nothing moves where it is zero.
        keep1: decay of the first moments.
        keep2: of the second ones.
        add1: 1 - keep1.
        add2: 1 - keep2.
        log2_keep1: logarithm of keep1.
        log2_keep2: of keep2.
        epsilon: keeps the quotient finite.
        GATED: see `counted`.
        BLOCK: numbers in a block.
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
    values: Sequence[Tensor], gradients: Sequence[Tensor], first: Sequence[Tensor],
    second: Sequence[Tensor], rates: Sequence[float | None], *, taken: Tensor,
    counted: Tensor | None, betas: tuple[float, float], epsilon: float,
) -> None:
    """Takes one step of Adam in place; nothing waits for the device.

    Args:
        values: six contiguous float32 tensors, one for each group of parameters.
        gradients: of the same sizes.
        first: moving averages of the gradients.
        second: moving averages of their squares.
        rates: learning rate of each group; None leaves the group alone.
        taken: [1] int64, steps taken; one more where this one counts.
        counted: [1] int32, zero where the step comes to nothing; None where it counts anyway.
        betas: decay of the two averages.
        epsilon: keeps the quotient finite.
    """
    if len(values) != GROUPS:
        raise ValueError(f"{len(values)} groups of parameters, needed {GROUPS}")
    taken += 1 if counted is None else counted
    sizes = [0 if rate is None else value.numel()
             for value, rate in zip(values, rates, strict=True)]
    programs = sum(triton.cdiv(size, BLOCK) for size in sizes)
    adam[(programs,)](
        *values, *gradients, *first, *second, *sizes, *(rate or 0.0 for rate in rates), taken,
        counted, *betas, 1 - betas[0], 1 - betas[1], math.log2(betas[0]), math.log2(betas[1]),
        epsilon, GATED=counted is not None, BLOCK=BLOCK)
