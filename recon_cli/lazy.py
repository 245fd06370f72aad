"""Late imports: torch alone takes seconds, which `--help` and `recon status` must not wait for."""

from __future__ import annotations

from importlib import import_module
from typing import Any


def load(path: str) -> Any:
    """Returns an object by its dotted path, `recon_cli.package.module.name`; imports its module."""
    module, _, name = path.rpartition(".")
    return getattr(import_module(module), name)
