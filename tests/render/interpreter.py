"""Where the tests run triton's kernels: on a GPU, else in triton's interpreter, on the CPU.

Kernels ask for the interpreter when they are imported, so import this module before them. The
interpreter patches triton's language anew for each function that a kernel calls, which takes longer
than the function. Where the language is patched already, that is skipped here.
"""

from __future__ import annotations

import importlib.util
import os

import torch

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
INTERPRETED = DEVICE == "cpu" and importlib.util.find_spec("triton") is not None


def _skip_repeated_patches() -> None:
    """Lets calls inside a kernel skip a patch that is in place, if this version has such."""
    import triton.language as tl
    from triton.runtime import interpreter

    original = getattr(interpreter, "_patch_lang", None)
    scope = getattr(interpreter, "_LangPatchScope", None)
    if original is None or scope is None:
        return

    def patch(function):
        languages = [value for value in function.__globals__.values() if value in (tl, tl.core)]
        if languages and not any(tl.core.is_builtin(language.load) for language in languages):
            return scope()
        return original(function)

    interpreter._patch_lang = patch


if DEVICE == "cpu":
    os.environ.setdefault("TRITON_INTERPRET", "1")
if INTERPRETED and os.environ["TRITON_INTERPRET"] == "1":
    _skip_repeated_patches()
