"""A float32 vector as a numba type, so that kernels are vectorized by construction.

LLVM's loop vectorizer, which numba relies on, gives up in silence and costs five times the speed.
`Lanes` is LANES numbers in one register, the operators work on all of them at once, and `Mask` is
the outcome of a comparison. LANES is 16 where the CPU has AVX-512 and 8 elsewhere; LLVM splits a
vector that is wider than the CPU's registers. Loads and stores check no bounds.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
from llvmlite import ir
from numba.core import config, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import lower_builtin, lower_cast, models, register_model


def vector_width() -> int:
    """Returns how many float32 a kernel computes at once on the CPU that numba compiles for."""
    if config.CPU_FEATURES is not None:  # the user compiles for another CPU
        return 16 if "+avx512f" in config.CPU_FEATURES else 8
    return 16 if llvm.get_host_cpu_features().get("avx512f", False) else 8


LANES = vector_width()
_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
VECTOR = ir.VectorType(_FLOAT, LANES)
INTS = ir.VectorType(_INT, LANES)
BITS = ir.VectorType(ir.IntType(1), LANES)
# a * b + c may become one fused operation; nothing else is relaxed: NaN and Inf keep their meaning
_FLAGS = ("contract",)


class LanesType(types.Type):
    """The numba type of LANES float32."""

    def __init__(self) -> None:
        super().__init__(name=f"lanes{LANES}")


class MaskType(types.Type):
    """The numba type of LANES booleans."""

    def __init__(self) -> None:
        super().__init__(name=f"mask{LANES}")


lanes_type, mask_type = LanesType(), MaskType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, BITS)


def splat(builder: Any, value: Any) -> Any:
    """Returns the vector whose every lane is the float `value`."""
    first = builder.insert_element(ir.Constant(VECTOR, ir.Undefined), value, ir.Constant(_INT, 0))
    return builder.shuffle_vector(
        first, ir.Constant(VECTOR, ir.Undefined), ir.Constant(INTS, [0] * LANES))


def constant(value: float) -> Any:
    """Returns the constant vector of a float."""
    return ir.Constant(VECTOR, [float(value)] * LANES)


@lower_cast(types.Float, LanesType)
@lower_cast(types.Integer, LanesType)
def _broadcast_cast(context: Any, builder: Any, source: Any, _target: Any, value: Any) -> Any:
    return splat(builder, context.cast(builder, value, source, types.float32))


# ---- operators ----

_ARITHMETIC = {
    operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
_COMPARISON = {
    operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">=", operator.eq: "=="}
_LOGIC = {operator.and_: "and_", operator.or_: "or_"}
_SCALARS = (LanesType, types.Float, types.Integer)


def _declare(function: Any, operand: Any, result: Any) -> None:
    """Tells numba's typing that `function` takes two operands, one of them at least `operand`."""
    allowed = _SCALARS if operand is lanes_type else (MaskType,)

    class _Template(AbstractTemplate):  # type: ignore[misc]
        key = function

        def generic(self, args: Any, kws: Any) -> Any:  # noqa: ARG002
            if len(args) == 2 and operand in args and all(isinstance(a, allowed) for a in args):
                return signature(result, operand, operand)
            return None

    infer_global(function)(_Template)


def _lower(function: Any, operand: Any, emit: Callable[[Any, Any, Any], Any]) -> None:
    """Gives numba the code of `function` for two operands of a type."""
    def lower(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
        return emit(builder, *args)

    lower_builtin(function, operand, operand)(lower)


def _arithmetic(name: str) -> Callable[[Any, Any, Any], Any]:
    return lambda builder, a, b: getattr(builder, name)(a, b, flags=_FLAGS)


def _comparison(sign: str) -> Callable[[Any, Any, Any], Any]:
    # ordered: false where a NaN takes part
    return lambda builder, a, b: builder.fcmp_ordered(sign, a, b)


def _logic(name: str) -> Callable[[Any, Any, Any], Any]:
    return lambda builder, a, b: getattr(builder, name)(a, b)


for _function, _name in _ARITHMETIC.items():
    _declare(_function, lanes_type, lanes_type)
    _lower(_function, LanesType, _arithmetic(_name))
for _function, _name in _COMPARISON.items():
    _declare(_function, lanes_type, mask_type)
    _lower(_function, LanesType, _comparison(_name))
for _function, _name in _LOGIC.items():
    _declare(_function, mask_type, mask_type)
    _lower(_function, MaskType, _logic(_name))


@infer_global(operator.neg)
class _Negate(AbstractTemplate):  # type: ignore[misc]
    key = operator.neg

    def generic(self, args: Any, kws: Any) -> Any:  # noqa: ARG002
        return signature(lanes_type, lanes_type) if args == (lanes_type,) else None


@lower_builtin(operator.neg, LanesType)
def _lower_negate(_context: Any, builder: Any, _sig: Any, args: Any) -> Any:
    return builder.fneg(args[0])
