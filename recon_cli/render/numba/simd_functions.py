"""Functions of lanes: choice, fused arithmetic, powers and logarithms, sums across lanes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from recon_cli.render.numba.simd import INTS, LANES, VECTOR, constant, lanes_type, mask_type, splat

# Minimax polynomials by Remez' exchange; test_numba_lanes checks the errors.
# 2^f on [-1/2, 1/2], relative error 7.5e-8.
_EXP2 = (1.0000001192092896, 0.6931469440460205, 0.24022120237350464, 0.05550713092088699,
         0.009675540961325169, 0.0013276472454890609)
# log2(1 + t) / t on [1/sqrt(2) - 1, sqrt(2) - 1], relative error 2.6e-8.
_LOG2 = (1.4426950216293335, -0.7213473320007324, 0.48091062903404236, -0.3607036769390106,
         0.28791624307632446, -0.23894481360912323, 0.21571560204029083, -0.20726975798606873,
         0.1258370578289032)
_ROUNDER = 12582912.0  # 1.5 * 2^23: a sum with it has the nearest integer in its low bits
_ROOT_HALF_BITS = 0x3F3504F3  # of sqrt(1/2)


def _call(builder: Any, name: str, *args: Any) -> Any:
    """Emits an LLVM intrinsic whose operands and result are all vectors."""
    kind = ir.FunctionType(VECTOR, [VECTOR] * len(args))
    function = cgutils.get_or_insert_function(builder.module, kind, f"{name}.v{LANES}f32")
    return builder.call(function, args)


def _cast(context: Any, builder: Any, sig: Any, args: Any) -> list[Any]:
    return [value if kind == lanes_type
            else splat(builder, context.cast(builder, value, kind, types.float32))
            for value, kind in zip(args, sig.args, strict=True)]


def _integers(value: int) -> Any:
    return ir.Constant(INTS, [value] * LANES)


@intrinsic
def fill(_typing: Any, value: Any) -> Any:
    """Returns the number `value` in every lane."""
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _cast(context, builder, sig, args)[0]

    return lanes_type(value), emit


@intrinsic
def lane_numbers(_typing: Any) -> Any:
    """Returns 0, 1, ..., LANES - 1."""
    def emit(_context: Any, _builder: Any, _sig: Any, _args: Any) -> Any:
        return ir.Constant(VECTOR, [float(i) for i in range(LANES)])

    return lanes_type(), emit


@intrinsic
def select(_typing: Any, mask: Any, yes: Any, no: Any) -> Any:
    """Returns `yes` in the lanes where the mask holds and `no` elsewhere."""
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pair = [value if kind == lanes_type
                else splat(builder, context.cast(builder, value, kind, types.float32))
                for value, kind in zip(args[1:], sig.args[1:], strict=True)]
        return builder.select(args[0], *pair)

    return lanes_type(mask_type, yes, no), emit


@intrinsic
def bits(_typing: Any, _mask: Any) -> Any:
    """Returns the mask as an integer, lane 0 in the lowest bit."""
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), ir.IntType(64))

    return types.uint64(mask_type), emit


@intrinsic
def lowest_bit(_typing: Any, number: Any) -> Any:
    """Returns the position of the lowest bit that is set in a uint64 that is not 0."""
    if number != types.uint64:
        return None

    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(number), emit


@intrinsic
def count_bits(_typing: Any, number: Any) -> Any:
    """Returns how many bits of a uint64 are set."""
    if number != types.uint64:
        return None

    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.int64(number), emit


# ---- arithmetic ----

@intrinsic
def fma(_typing: Any, a: Any, b: Any, c: Any) -> Any:
    """Returns a * b + c, rounded once where the CPU can: the same bits wherever it is called."""
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _call(builder, "llvm.fmuladd", *_cast(context, builder, sig, args))

    return lanes_type(a, b, c), emit


def _choice(sign: str) -> Any:
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = _cast(context, builder, sig, args)
        return builder.select(builder.fcmp_ordered(sign, a, b), a, b)

    return emit


@intrinsic
def minimum(_typing: Any, a: Any, b: Any) -> Any:
    """Returns the smaller of a and b, and b where one of them is NaN."""
    return lanes_type(a, b), _choice("<")


@intrinsic
def maximum(_typing: Any, a: Any, b: Any) -> Any:
    """Returns the larger of a and b, and b where one of them is NaN."""
    return lanes_type(a, b), _choice(">")


@intrinsic
def absolute(_typing: Any, value: Any) -> Any:
    """Returns |value|."""
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return _call(builder, "llvm.fabs", *args)

    return lanes_type(lanes_type), emit


@intrinsic
def square_root(_typing: Any, value: Any) -> Any:
    """Returns the square root."""
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return _call(builder, "llvm.sqrt", *args)

    return lanes_type(lanes_type), emit


@intrinsic
def floor(_typing: Any, value: Any) -> Any:
    """Returns the greatest integer that is not greater."""
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return _call(builder, "llvm.floor", *args)

    return lanes_type(lanes_type), emit


def _polynomial(builder: Any, coefficients: Sequence[float], x: Any) -> Any:
    """Emits Horner's scheme, the constant coefficient first."""
    result = constant(coefficients[-1])
    for coefficient in reversed(coefficients[:-1]):
        result = _call(builder, "llvm.fmuladd", result, x, constant(coefficient))
    return result


def _estrin(builder: Any, c: Sequence[float], x: Any) -> Any:
    """Emits Estrin's scheme for degree 5: one operation more than Horner's, half the latency."""
    square = builder.fmul(x, x)
    low, middle, high = (
        _call(builder, "llvm.fmuladd", x, constant(c[i + 1]), constant(c[i])) for i in (0, 2, 4))
    upper = _call(builder, "llvm.fmuladd", square, high, middle)
    return _call(builder, "llvm.fmuladd", square, upper, low)


@intrinsic
def exp2(_typing: Any, value: Any) -> Any:
    """Returns 2^value for values in [-126, 127]; some number, not a trap, outside.

    The nearest integer goes into the exponent's bits, the rest through a polynomial.
    """
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        shifted = builder.fadd(args[0], constant(_ROUNDER))
        rest = builder.fsub(args[0], builder.fsub(shifted, constant(_ROUNDER)))
        power = builder.bitcast(_estrin(builder, _EXP2, rest), INTS)
        exponent = builder.shl(builder.bitcast(shifted, INTS), _integers(23))
        return builder.bitcast(builder.add(power, exponent), VECTOR)

    return lanes_type(lanes_type), emit


@intrinsic
def log2(_typing: Any, value: Any) -> Any:
    """Returns the binary logarithm of positive normal numbers; some number elsewhere."""
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        raw = builder.bitcast(args[0], INTS)
        # the exponent that leaves a mantissa in [sqrt(1/2), sqrt(2))
        exponent = builder.ashr(builder.sub(raw, _integers(_ROOT_HALF_BITS)), _integers(23))
        mantissa = builder.bitcast(
            builder.sub(raw, builder.shl(exponent, _integers(23))), VECTOR)
        t = builder.fsub(mantissa, constant(1.0))
        whole = builder.sitofp(exponent, VECTOR)
        return _call(builder, "llvm.fmuladd", t, _polynomial(builder, _LOG2, t), whole)

    return lanes_type(lanes_type), emit


# ---- across lanes ----

@intrinsic
def total(_typing: Any, value: Any) -> Any:
    """Returns the sum of all lanes, pairwise, in an order that is always the same."""
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        value, step = args[0], LANES // 2
        while step:
            moved = builder.shuffle_vector(
                value, value, ir.Constant(INTS, [i ^ step for i in range(LANES)]))
            value, step = builder.fadd(value, moved), step // 2
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(lanes_type), emit


@intrinsic
def largest(_typing: Any, value: Any) -> Any:
    """Returns the largest lane."""
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        value, step = args[0], LANES // 2
        while step:
            moved = builder.shuffle_vector(
                value, value, ir.Constant(INTS, [i ^ step for i in range(LANES)]))
            value = builder.select(builder.fcmp_ordered(">", value, moved), value, moved)
            step //= 2
        return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))

    return types.float32(lanes_type), emit


@intrinsic
def totals(_typing: Any, values: Any) -> Any:
    """Returns a vector whose lane i is the sum of the lanes of values[i], a tuple of LANES vectors.

    LANES - 1 additions for all sums together: each level adds neighbours and halves the vectors.
    """
    if list(values) != [lanes_type] * LANES:
        return None

    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        level = [builder.extract_value(args[0], i) for i in range(LANES)]
        step = 1
        while len(level) > 1:
            # lanes whose bit `step` is clear take from the first of a pair, the others from the
            # second; each adds the two lanes that differ in that bit
            low = [(i & ~step) + (LANES if i & step else 0) for i in range(LANES)]
            high = [i + step for i in low]
            level = [builder.fadd(
                builder.shuffle_vector(a, b, ir.Constant(INTS, low)),
                builder.shuffle_vector(a, b, ir.Constant(INTS, high)))
                for a, b in zip(level[::2], level[1::2], strict=True)]
            step *= 2
        return level[0]

    return lanes_type(values), emit
