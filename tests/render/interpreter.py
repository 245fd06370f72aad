"""Where the tests run triton's kernels: on a GPU, else in triton's interpreter, on the CPU.

Kernels ask for the interpreter when they are imported, so import this module before them. What an
operation costs there is hardly numpy's work on 256 pixels, but all around it: the language patched
anew for each kernel and each function that it calls, types and shapes built anew for each result,
an overflow looked for that nothing asserts. These are spared here, and results stay the same.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import os
from types import ModuleType

import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
INTERPRETED = DEVICE == "cpu" and importlib.util.find_spec("triton") is not None


def _patch_language_once(interpreter: ModuleType) -> None:
    """Leaves the language patched: every kernel of these processes is interpreted."""
    import triton.language as tl

    original, languages_of = interpreter._patch_lang, {}

    def patch(function):
        names = function.__globals__
        if id(names) not in languages_of:
            languages_of[id(names)] = [one for one in names.values() if one is tl or one is tl.core]
        languages = languages_of[id(names)]
        if not languages or any(tl.core.is_builtin(one.load) for one in languages):
            original(function)
        return interpreter._LangPatchScope()

    def patch_attribute(obj, name, member, _builder, scope):
        member = getattr(member, "__wrapped__", member)

        def call(*args, **kwargs):
            kwargs["_semantic"] = interpreter.interpreter_semantic
            return member(*args, **kwargs)

        scope.set_attr(obj, name, call)

    interpreter._patch_lang, interpreter._patch_attr = patch, patch_attribute


def _skip_unread_overflows(interpreter: ModuleType) -> None:
    """Leaves out the int64 arithmetic of an assertion that exists with `debug` alone."""
    builder = interpreter.interpreter_builder
    if not builder.options.debug:
        builder.options = dataclasses.replace(builder.options, sanitize_overflow=False)


def _share_types(interpreter: ModuleType) -> None:
    """Builds what types and shapes are made of once for each name and shape."""
    import triton.language as tl

    get_np_dtype, np_dtypes = interpreter._get_np_dtype, {}
    init_block, blocks = tl.core.block_type.__init__, {}
    init_tensor, shapes = tl.core.tensor.__init__, {}

    def np_dtype(dtype):
        if dtype.name not in np_dtypes:
            np_dtypes[dtype.name] = get_np_dtype(dtype)
        return np_dtypes[dtype.name]

    def block(self, element_ty, shape):
        key = (element_ty.name, *shape)
        if key not in blocks:
            init_block(self, element_ty, shape)
            blocks[key] = {name: vars(self)[name] for name in ("shape", "numel", "name")}
        self.element_ty = element_ty
        vars(self).update(blocks[key])

    def tensor(self, handle, type):
        key = tuple(type.shape) if type.is_block() else ()
        if key not in shapes:
            init_tensor(self, handle, type)
            shapes[key] = self.shape, self.numel
        self.handle, self.type, self.dtype = handle, type, type.scalar
        self.shape, self.numel = shapes[key]

    interpreter._get_np_dtype = np_dtype
    tl.core.block_type.__init__, tl.core.tensor.__init__ = block, tensor


def _pass_operands_alike(interpreter: ModuleType) -> None:
    """Takes operands of one type and, by `_share_types`, one shape as they are."""
    import triton.language as tl

    semantic = interpreter.TritonSemantic
    broadcast, check = semantic.broadcast_impl_value, semantic.binary_op_type_checking_impl

    def broadcast_value(self, lhs, rhs):
        return (lhs, rhs) if lhs.shape is rhs.shape else broadcast(self, lhs, rhs)

    def check_types(self, lhs, rhs, *flags, **options):
        if (type(lhs) is type(rhs) is tl.core.tensor and lhs.dtype is rhs.dtype
                and lhs.shape is rhs.shape and lhs.dtype.name in ("fp32", "fp64", "int32")):
            return lhs, rhs
        return check(self, lhs, rhs, *flags, **options)

    semantic.broadcast_impl_value = broadcast_value
    semantic.binary_op_type_checking_impl = check_types


def _spare_the_interpreter() -> None:
    """Changes what was found in one version of triton, where a version has all of it."""
    from triton.runtime import interpreter

    if not all(hasattr(interpreter, name) for name in (
            "_patch_lang", "_patch_attr", "_LangPatchScope", "_get_np_dtype", "TritonSemantic",
            "interpreter_builder", "interpreter_semantic")):
        return
    _patch_language_once(interpreter)
    _skip_unread_overflows(interpreter)
    _share_types(interpreter)
    _pass_operands_alike(interpreter)


if DEVICE == "cpu":
    os.environ.setdefault("TRITON_INTERPRET", "1")
if INTERPRETED and os.environ["TRITON_INTERPRET"] == "1":
    _spare_the_interpreter()
