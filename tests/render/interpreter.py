"""Triton's interpreter without what it does over and over.

It patches triton's language anew for each function that a kernel calls, which takes longer than the
function. Where the language is patched already, that is left out here, if this version works so.
"""

from __future__ import annotations

import os


def quicken() -> None:
    """Lets calls inside a kernel skip a patch that is in place; without triton does nothing."""
    if os.environ.get("TRITON_INTERPRET") != "1":
        return
    try:
        import triton.language as tl
        from triton.runtime import interpreter
    except ImportError:
        return
    original = getattr(interpreter, "_patch_lang", None)
    scope = getattr(interpreter, "_LangPatchScope", None)
    if original is None or scope is None:
        return

    def patch(function):
        languages = [value for value in function.__globals__.values() if value in (tl, tl.core)]
        if languages and not any(tl.core.is_builtin(one.load) for one in languages):
            return scope()
        return original(function)

    interpreter._patch_lang = patch
