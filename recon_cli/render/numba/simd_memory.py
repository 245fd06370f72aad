"""Loads and stores of lanes, in flat arrays. No bounds are checked."""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from recon_cli.render.numba.simd import INTS, LANES, VECTOR, lanes_type, splat


def _flat(array: Any, dtype: Any, index: Any) -> bool:
    return (isinstance(array, types.Array) and array.dtype == dtype and array.ndim == 1
            and isinstance(index, types.Integer))


def _address(context: Any, builder: Any, sig: Any, args: Any, first: int = 0) -> Any:
    """Returns the address of array[index], two operands from number `first` on."""
    data = context.make_array(sig.args[first])(context, builder, value=args[first]).data
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
def spread(_typing: Any, array: Any, index: Any) -> Any:
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
            low = ir.Constant(INTS, [
                (i - step + LANES if i & step else i) for i in range(LANES)])
            high = ir.Constant(INTS, [
                (i + LANES if i & step else i + step) for i in range(LANES)])
            rows = _exchanged(builder, rows, step, low, high)
            step *= 2
        for k in range(LANES):
            builder.store(rows[k], row(end, k), align=4)
        return context.get_dummy_value()

    return types.void(source, at, target, to), emit


def _exchanged(builder: Any, rows: list[Any], step: int, low: Any, high: Any) -> list[Any]:
    result = list(rows)
    for k in range(LANES):
        if not k & step:
            a, b = rows[k], rows[k + step]
            result[k] = builder.shuffle_vector(a, b, low)
            result[k + step] = builder.shuffle_vector(a, b, high)
    return result


@intrinsic
def copy(_typing: Any, source: Any, at: Any, target: Any, to: Any) -> Any:
    """Copies LANES numbers from source[at] to target[to]."""
    if not (_flat(source, types.float32, at) and _flat(target, types.float32, to)):
        return None

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        begin = _as(builder, _address(context, builder, sig, args), VECTOR)
        end = _as(builder, _address(context, builder, sig, args, 2), VECTOR)
        builder.store(builder.load(begin, align=4, typ=VECTOR), end, align=4)
        return context.get_dummy_value()

    return types.void(source, at, target, to), emit
