"""A stage's summary as pairs of words and figures with their units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from recon_cli.report import duration, megabytes

_UNITS = {"_db": "dB", "_px": "px", "_deg": "degrees", "_255": "of 255"}
_NAMES = {"psnr": "PSNR", "ssim": "SSIM", "gaussians": "Gaussians", "cuda": "CUDA"}


def facts(summary: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Returns (what, figure) for everything in a summary that is one number or word.

    Nothing is told of memory that was not used: a CPU has no peak of a GPU.
    """
    return tuple(
        _fact(name, value) for name, value in summary.items()
        if value is not None and value != "" and not isinstance(value, (list, dict))
        and not (name.endswith("bytes") and value == 0))


def _fact(name: str, value: Any) -> tuple[str, str]:
    if isinstance(value, bool):
        return _named(name), "yes" if value else "no"
    if name.endswith("seconds"):
        return f"{_named(name.removesuffix('_seconds'))} time", duration(float(value))
    if name.endswith("bytes"):
        return _named(name.removesuffix("_bytes")).replace("bytes", "size"), megabytes(int(value))
    for ending, unit in _UNITS.items():
        if ending in name:
            return _named(name.replace(ending, "")), f"{value:.4g} {unit}"
    if isinstance(value, int):
        return _named(name), f"{value:,}"
    return _named(name), f"{value:.4g}" if isinstance(value, float) else str(value)


def _named(name: str) -> str:
    return " ".join(_NAMES.get(word, word) for word in name.split("_"))
