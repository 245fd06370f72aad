"""The hot loops of the kernels consist of vector instructions: read from the machine code.

A compiler that gives up vectorizing does so in silence, and a kernel is several times slower. No
time is measured here: the loops are counted, and a message names kernel and loop that lost theirs.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np
import pytest
from facts import assert_facts
from machine_code import Loop, loops

REGISTER = {8: "ymm", 16: "zmm"}  # of AVX2 and AVX-512, by LANES
# Addresses, broadcasts and the number of an instance are computed one by one, which takes a few
# instructions beside those of the vectors. Measured: at most 2 of 14.
MOST_SCALAR = 0.2
MATHEMATICS = ("exp", "log", "pow", "sqrt", "floor", "ceil", "fma", "svml", "_ZGV")


@dataclass(frozen=True)
class Hot:
    """A loop that must be vectorized.

    Attributes:
        kernel: its name.
        loop: what passes by in it.
        least: vector operations on floats that it has at least, some two thirds of those counted
            when this was written: unrolled and rearranged loops pass.
        powers: it holds exp2 or log2, which shift vectors by the 23 bits of a mantissa.
    """

    kernel: str
    loop: str
    least: int
    powers: bool = False

    def __str__(self) -> str:
        return f"{self.kernel}: {self.loop}"


HOT = [
    Hot("cull", "Gaussians against the image", 20, powers=True),
    Hot("project", "a block of Gaussians", 160, powers=True),
    Hot("project", "spherical harmonics", 8),
    Hot("composite", "colour in a patch of pixels", 13, powers=True),
    Hot("composite", "patches of a batch", 13),
    Hot("composite_backward", "gradients in a patch of pixels", 28, powers=True),
    Hot("project_backward", "a block of Gaussians", 280, powers=True),
    Hot("project_backward", "gradients of spherical harmonics", 8),
    Hot("similarity", "blur along the row, and SSIM", 45),
    Hot("similarity", "blur down the columns", 6),
    Hot("loss_gradient", "blur along the row, and the slope", 27),
    Hot("adam", "moments and values", 6),
]


def check(hot: Hot, found: list[Loop], register: str) -> Loop:
    """Fails unless one of the loops is the hot one, in vectors; returns that loop."""
    fitting = [loop for loop in found if loop.shifts_by_23 or not hot.powers]
    best = max(fitting, key=lambda loop: loop.packed[register], default=Loop("none"))
    busiest = max(found, key=lambda loop: loop.arithmetic, default=Loop("none"))
    seen = f"{best.packed[register]} operations on {register} registers, {best.scalar} scalar ones"
    if best.packed[register] < hot.least:
        pytest.fail(
            f"{hot} lost its vector instructions: {seen} in the best loop ({best.label}), needed "
            f"{hot.least}; the busiest one ({busiest.label}) has {dict(busiest.packed)} and "
            f"{busiest.scalar} scalar ones and calls {sorted(busiest.calls) or 'nothing'}")
    narrow = best.arithmetic - best.packed[register]
    if narrow > MOST_SCALAR * best.arithmetic:
        pytest.fail(f"{hot} computes one by one or in narrow vectors: {seen}, {narrow} in all are "
                    f"not on {register}, in {best.label}")
    slow = sorted(name for name in best.calls if any(word in name for word in MATHEMATICS))
    if slow:
        pytest.fail(f"{hot} calls {', '.join(slow)} for one number at a time, in {best.label}")
    return best


def check_kernel(name, run):
    found = loops((run.folder / f"{name}.s").read_text(encoding="utf-8"))
    wanted = [hot for hot in HOT if hot.kernel == name]
    for hot in sorted(wanted, key=lambda hot: (not hot.powers, -hot.least)):
        found.remove(check(hot, found, REGISTER[run.report["lanes"]]))


@pytest.fixture
def host_features(cpu_features):
    if not cpu_features.get("avx2"):
        pytest.skip("this CPU has no AVX2: its registers are narrower than LANES")


@pytest.fixture
def cpu_features():
    from llvmlite.binding import get_host_cpu_features

    return get_host_cpu_features()


KERNELS = sorted({hot.kernel for hot in HOT})


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.usefixtures("host_features")
def test_hot_loops_are_vectorized_for_this_cpu(kernel, damaged_run):
    check_kernel(kernel, damaged_run)


@pytest.mark.parametrize("kernel", KERNELS)
def test_hot_loops_are_vectorized_for_avx2(kernel, avx2_run):
    check_kernel(kernel, avx2_run)


# ---- the guard can fail ----

def assembler(function, *arguments):
    compiled = numba.njit(error_model="numpy")(function)
    compiled(*arguments)
    return "\n".join(compiled.inspect_asm().values())


def scalar_exponentials(values):
    """The plain loop that a kernel must not become: each step needs the one before."""
    result = np.float32(0)
    for i in range(len(values)):
        result = result * np.float32(0.5) + np.float32(math.exp(values[i]))
        values[i] = result
    return result


@pytest.mark.usefixtures("host_features")
@pytest.mark.parametrize("register", ["zmm", "ymm"])
def test_a_scalar_kernel_is_named_with_its_loop_and_its_calls(register):
    found = loops(assembler(scalar_exponentials, np.ones(64, np.float32)))
    with pytest.raises(pytest.fail.Exception) as failure:
        check(Hot("composite", "colour in a patch of pixels", 8, powers=True), found, register)
    message = str(failure.value)
    assert_facts(message, "composite", "colour", "instructions")
    assert "0 operations" in message
    assert "exp" in message.split("calls")[1]


@pytest.mark.usefixtures("host_features")
@pytest.mark.parametrize(("loop", "vectors", "fact"), [
    (Loop(".LBB0_1", calls={"expf"}), "zmm", "expf"),
    (Loop(".LBB0_1", scalar=20), "ymm", "narrow")])
def test_a_loop_that_calls_a_scalar_function_or_is_half_scalar_is_named(loop, vectors, fact):
    loop.packed[vectors] = 40
    with pytest.raises(pytest.fail.Exception) as caught:
        check(Hot("adam", "moments", 6), [loop], vectors)
    assert_facts(str(caught.value), "adam", "moments", fact)


def test_loops_are_found_whatever_the_order_of_their_blocks():
    text = """
\t.type\tf,@function
f:
\tjmp\t.LBB0_3
.LBB0_2:
\tvmulps\t%zmm0, %zmm1, %zmm1
\tvpslld\t$23, %zmm1, %zmm1
\tjmp\t.LBB0_4
.LBB0_3:
\tvaddss\t%xmm0, %xmm1, %xmm1
\tmovabsq\t$expf, %rbx
.LBB0_5:
\tcallq\t*%rbx
\tvfmadd213ps\t%zmm0, %zmm1, %zmm1
\tjne\t.LBB0_2
\tretq
.LBB0_4:
\tvaddps\t%ymm0, %ymm1, %ymm1
\tjmp\t.LBB0_5
"""
    (loop,) = loops(text)
    assert loop.label == ".LBB0_5"
    assert loop.packed == {"zmm": 2, "ymm": 1}
    assert (loop.scalar, loop.shifts_by_23, loop.calls) == (0, 1, {"expf"})
