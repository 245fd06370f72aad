"""Indoor 3D reconstruction by Gaussian Splatting that anyone can run.

Public names are loaded when they are first used, so that `import recon_cli` takes milliseconds.
"""

from __future__ import annotations

import sys

# pycolmap's wheel exports a zlib of its own. Where it loads first, and Python's zlib is a library
# beside it, the two get mixed up: compressing aborts with "free(): invalid pointer".
import zlib as zlib
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for type checkers; at run time `__getattr__` does the same
    from recon_cli.api import (
        Camera,
        ReconError,
        Splats,
        Workspace,
        evaluate,
        look_at,
        make_camera,
        read_cameras,
    )
    from recon_cli.render.rasterization import rasterization

__version__ = "0.1.0"

# Each public name and the module that it is loaded from. A name that is also a folder of the
# package, as `render` is, cannot stand here: importing the folder would replace it.
_PUBLIC = {
    "rasterization": "recon_cli.render.rasterization",
    "Camera": "recon_cli.api",
    "ReconError": "recon_cli.api",
    "Splats": "recon_cli.api",
    "Workspace": "recon_cli.api",
    "evaluate": "recon_cli.api",
    "look_at": "recon_cli.api",
    "make_camera": "recon_cli.api",
    "read_cameras": "recon_cli.api",
}

__all__ = ["Camera", "ReconError", "Splats", "Workspace", "__version__", "evaluate", "look_at",
           "make_camera", "rasterization", "read_cameras"]


def _check_import_order() -> None:
    """Raises BackendError where compressing anything would end the process."""
    order = [name for name in sys.modules if name in ("zlib", "pycolmap._core")]
    if (order == ["pycolmap._core", "zlib"] and sys.platform == "linux"
            and "zlib" not in sys.builtin_module_names):
        raise import_module("recon_cli.errors").BackendError(
            "pycolmap was imported before zlib, so that Python aborts when it compresses anything.",
            hint="Import recon_cli, or zlib, before pycolmap.")


_check_import_order()


def __getattr__(name: str) -> Any:
    """Loads a public name; AttributeError for any other."""
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_PUBLIC[name]), name)
    globals()[name] = value  # the next use does not come here
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
