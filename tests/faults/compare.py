"""Which files of a workspace differ from those of a run without a fault, times left out."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from recon_cli.stages import STAGES

VOLATILE = {row.name: row.volatile for row in STAGES}
# Files that hold times beside results; of JSON the rest is compared.
_TIMED = ("*/manifest.json", "evaluate/metrics.*", "evaluate/table.txt", "render/*/render.json",
          "render/*/steps.jsonl")
_MINUTE = re.compile(rb"report, \d{4}-\d\d-\d\d \d\d:\d\d")
_TIMES = {"render_ms", "train_seconds", "seconds", "cpu_seconds"}


def differing(right: Path, workspace: Path, names: Iterable[str], *, made: Path) -> list[str]:
    """Returns the relative paths of what differs below `names`, or is there on one side only.

    The report on the right was written for the workspace `made`, which it names.
    """
    found: list[str] = []
    for top in names:
        paths = {path.relative_to(root).as_posix()
                 for root in (right, workspace) for path in _files(root / top)}
        found += [name for name in sorted(paths)
                  if not is_volatile(name) and not _same(name, right, workspace, made)]
    return found


def is_volatile(name: str) -> bool:
    """Returns whether a file of a stage takes no part in what follows from it."""
    stage, _, inner = name.partition("/")
    return any(fnmatchcase(inner, pattern) for pattern in VOLATILE.get(stage, ()))


def _files(path: Path) -> list[Path]:
    files = [path] if path.is_file() else [one for one in path.rglob("*") if not one.is_dir()]
    return [one for one in files if one.name != ".lock"]


def _same(name: str, right: Path, workspace: Path, made: Path) -> bool:
    one, other = right / name, workspace / name
    if not (one.is_file() and other.is_file()):
        return False
    first, second = one.read_bytes(), other.read_bytes()
    if name == "report.html":
        return (_MINUTE.sub(b"", first.replace(os.fsencode(made), b"@"))
                == _MINUTE.sub(b"", second.replace(os.fsencode(workspace), b"@")))
    if first == second:
        return True
    if not any(fnmatchcase(name, pattern) for pattern in _TIMED):
        return False
    if not name.endswith(".json"):
        return True
    manifest = name.endswith("/manifest.json")
    try:
        return _timeless(json.loads(first), manifest) == _timeless(json.loads(second), manifest)
    except (ValueError, KeyError, TypeError, RecursionError):
        return False


def _timeless(value: Any, manifest: bool = False) -> Any:
    """Returns JSON without the times in it; of a manifest the fingerprint and names alone."""
    if manifest:
        return value["fingerprint"], sorted(value["outputs"])
    if isinstance(value, dict):
        return {key: _timeless(inner) for key, inner in value.items() if key not in _TIMES}
    return [_timeless(inner) for inner in value] if isinstance(value, list) else value
