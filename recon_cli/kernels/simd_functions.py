"""Functions of SIMD lanes; loads and stores address flat arrays and check no bounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from recon_cli.kernels.simd import INTS, LANES, VECTOR, constant, lanes_type, mask_type, splat

# Minimax polynomials by Remez' exchange; test_numba_simd checks the errors.
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


def _cast(context: Any, builder: Any, kinds: Any, args: Any) -> list[Any]:
    """Emits casts of numbers to vectors; vectors stay as they are."""
    return [value if kind == lanes_type
            else splat(builder, context.cast(builder, value, kind, types.float32))
            for value, kind in zip(args, kinds, strict=True)]


def _integers(value: int) -> Any:
    return ir.Constant(INTS, [value] * LANES)


@intrinsic
def fill(_typing: Any, value: Any) -> Any:
    """Returns the number `value` in every lane."""
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _cast(context, builder, sig.args, args)[0]

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
        return builder.select(args[0], *_cast(context, builder, sig.args[1:], args[1:]))

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
        return _call(builder, "llvm.fmuladd", *_cast(context, builder, sig.args, args))

    return lanes_type(a, b, c), emit


def _choice(sign: str) -> Any:
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        a, b = _cast(context, builder, sig.args, args)
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


def _unary(name: str) -> Any:
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return _call(builder, name, *args)

    return lanes_type(lanes_type), emit


@intrinsic
def absolute(_typing: Any, value: Any) -> Any:
    """Returns |value|."""
    return _unary("llvm.fabs")


@intrinsic
def square_root(_typing: Any, value: Any) -> Any:
    """Returns the square root."""
    return _unary("llvm.sqrt")


@intrinsic
def floor(_typing: Any, value: Any) -> Any:
    """Returns the greatest integer that is not greater."""
    return _unary("llvm.floor")


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
        mantissa = builder.bitcast(builder.sub(raw, builder.shl(exponent, _integers(23))), VECTOR)
        t = builder.fsub(mantissa, constant(1.0))
        whole = builder.sitofp(exponent, VECTOR)
        return _call(builder, "llvm.fmuladd", t, _polynomial(builder, _LOG2, t), whole)

    return lanes_type(lanes_type), emit


# ---- across lanes ----

def _butterfly(builder: Any, value: Any, combine: Any) -> Any:
    """Emits the reduction of all lanes, pairwise, in an order that is always the same."""
    step = LANES // 2
    while step:
        moved = builder.shuffle_vector(
            value, value, ir.Constant(INTS, [i ^ step for i in range(LANES)]))
        value, step = combine(value, moved), step // 2
    return builder.extract_element(value, ir.Constant(ir.IntType(32), 0))


@intrinsic
def total(_typing: Any, value: Any) -> Any:
    """Returns the sum of all lanes."""
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return _butterfly(builder, args[0], builder.fadd)

    return types.float32(lanes_type), emit


@intrinsic
def largest(_typing: Any, value: Any) -> Any:
    """Returns the largest lane."""
    def emit(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        def larger(a: Any, b: Any) -> Any:
            return builder.select(builder.fcmp_ordered(">", a, b), a, b)

        return _butterfly(builder, args[0], larger)

    return types.float32(lanes_type), emit


@intrinsic
def totals(_typing: Any, values: Any) -> Any:
    """Returns a vector whose lane i is the sum of the lanes of values[i], a tuple of LANES vectors.

    LANES - 1 additions in all: each level adds neighbours and halves the number of vectors.
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


# ---- memory ----

def _flat(array: Any, dtype: Any, index: Any) -> bool:
    return (isinstance(array, types.Array) and array.dtype == dtype and array.ndim == 1
            and isinstance(index, types.Integer))


def _address(context: Any, builder: Any, sig: Any, args: Any, first: int = 0) -> Any:
    """Returns the address of array[index], two operands from number `first` on."""
    # the pointer alone: a proxy of the array would write all its fields to the stack
    data = context.data_model_manager[sig.args[first]].get(builder, args[first], "data")
    index = context.cast(builder, args[first + 1], sig.args[first + 1], types.int64)
    return builder.gep(data, [index])


def _as(builder: Any, address: Any, kind: Any) -> Any:
    return builder.bitcast(address, kind.as_pointer())


@intrinsic
def load(_typing: Any, array: Any, index: Any) -> Any:
    """Returns array[index : index + LANES] of float32."""
    if not _flat(array, types.float32, index):
        return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = _as(builder, _address(context, builder, sig, args), VECTOR)
        return builder.load(at, align=4, typ=VECTOR)

    return lanes_type(array, index), emit


@intrinsic
def load_bytes(_typing: Any, array: Any, index: Any) -> Any:
    """Returns array[index : index + LANES] of uint8 as float32."""
    if not _flat(array, types.uint8, index):
        return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        kind = ir.VectorType(ir.IntType(8), LANES)
        at = _as(builder, _address(context, builder, sig, args), kind)
        return builder.uitofp(builder.load(at, align=1, typ=kind), VECTOR)

    return lanes_type(array, index), emit


@intrinsic
def store(_typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Writes `value` to array[index : index + LANES] of float32."""
    if not (_flat(array, types.float32, index) and value == lanes_type):
        return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at = _as(builder, _address(context, builder, sig, args), VECTOR)
        builder.store(args[2], at, align=4)
        return context.get_dummy_value()

    return types.void(array, index, value), emit


@intrinsic
def broadcast(_typing: Any, array: Any, index: Any) -> Any:
    """Returns array[index] of float32 in every lane."""
    if not _flat(array, types.float32, index):
        return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return splat(builder, builder.load(_address(context, builder, sig, args)))

    return lanes_type(array, index), emit


@intrinsic
def fetch_add(_typing: Any, array: Any, index: Any, amount: Any) -> Any:
    """Adds to array[index] of int64 in one step that no other thread can split; returns before."""
    if not _flat(array, types.int64, index):
        return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        value = context.cast(builder, args[2], sig.args[2], types.int64)
        return builder.atomic_rmw("add", _address(context, builder, sig, args), value, "monotonic")

    return types.int64(array, index, amount), emit


@intrinsic
def transpose(_typing: Any, source: Any, at: Any, target: Any, to: Any) -> Any:
    """Writes the LANES x LANES block source[at : at + LANES^2] transposed to target[to : ...]."""
    if not (_flat(source, types.float32, at) and _flat(target, types.float32, to)):
        return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        def row(base: Any, k: int) -> Any:
            shifted = builder.gep(base, [ir.Constant(ir.IntType(64), k * LANES)])
            return _as(builder, shifted, VECTOR)

        begin = _address(context, builder, sig, args)
        end = _address(context, builder, sig, args, 2)
        rows = [builder.load(row(begin, k), align=4, typ=VECTOR) for k in range(LANES)]
        step = 1
        while step < LANES:  # exchanges the off-diagonal squares of every 2 step x 2 step block
            low = ir.Constant(INTS, [(i - step + LANES if i & step else i) for i in range(LANES)])
            high = ir.Constant(INTS, [(i + LANES if i & step else i + step) for i in range(LANES)])
            for k in range(LANES):
                if not k & step:
                    a, b = rows[k], rows[k + step]
                    rows[k] = builder.shuffle_vector(a, b, low)
                    rows[k + step] = builder.shuffle_vector(a, b, high)
            step *= 2
        for k in range(LANES):
            builder.store(rows[k], row(end, k), align=4)
        return context.get_dummy_value()

    return types.void(source, at, target, to), emit
