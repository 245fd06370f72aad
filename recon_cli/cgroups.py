"""The limits of this process's control group and of all above it, as Linux has them.

A container, a job of SLURM and a service of systemd each have a group of their own, which need not
be the one at the top of what is mounted.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

PROC = Path("/proc/self")
_NONE = 1 << 60  # bytes; version 1 has no limit from about here on


def free_memory_bytes(proc: Path = PROC) -> int | None:
    """Returns the least that any of the groups may still take, None where nothing limits it.

    Files that are cached count as free: they are given up for the asking.
    """
    left = [
        max(0, limit - used + _cached(folder, prefix))
        for folder, version in _folders(proc, "memory")
        for name, usage, prefix in [_MEMORY[version]]
        if (limit := _number(folder / name)) is not None and limit < _NONE
        and (used := _number(folder / usage)) is not None]
    return min(left, default=None)


_MEMORY = {  # by version: limit, in use, and what the names in memory.stat begin with
    2: ("memory.max", "memory.current", ""),
    1: ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_")}


def most_cpus(proc: Path = PROC) -> int | None:
    """Returns how many CPUs' time the groups may take, rounded up; None where nothing limits it."""
    shares = [share for folder, version in _folders(proc, "cpu")
              if (share := _cpu_share(folder, version)) is not None]
    return max(1, math.ceil(min(shares))) if shares else None


def _cpu_share(folder: Path, version: int) -> float | None:
    if version == 2:
        quota, _, period = _text(folder / "cpu.max").partition(" ")
    else:
        quota = _text(folder / "cpu.cfs_quota_us")
        period = _text(folder / "cpu.cfs_period_us")
    if not quota.isdecimal() or not period.isdecimal() or int(period) == 0:  # "max", or -1
        return None
    return int(quota) / int(period)


def _cached(folder: Path, prefix: str) -> int:
    """Returns the bytes of files that a group has cached."""
    counts = dict(line.split(" ", 1) for line in _text(folder / "memory.stat").splitlines()
                  if " " in line)
    names = (f"{prefix}active_file", f"{prefix}inactive_file")
    return sum(int(counts[name]) for name in names if counts.get(name, "").isdecimal())


def _folders(proc: Path, controller: str) -> Iterator[tuple[Path, int]]:
    """Yields the folder of this process's group and of each above it, with the version."""
    mounts = list(_mounts(proc, controller))
    for line in _text(proc / "cgroup").splitlines():
        _, _, rest = line.partition(":")
        controllers, _, group = rest.partition(":")
        version = 2 if not controllers else 1
        if version == 1 and controller not in controllers.split(","):
            continue
        for root, point in (found[1:] for found in mounts if found[0] == version):
            # A container may see only the part of the tree that it lives in.
            path = PurePosixPath(group)
            below = path.relative_to(root) if path.is_relative_to(root) else PurePosixPath()
            for each in (below, *below.parents):
                yield point / each, version


def _mounts(proc: Path, controller: str) -> Iterator[tuple[int, str, Path]]:
    """Yields (version, root in the tree of groups, where that is mounted)."""
    for line in _text(proc / "mountinfo").splitlines():
        mount, _, kind = line.partition(" - ")
        fields, described = mount.split(" "), kind.split(" ")
        if len(fields) < 5 or described[0] not in ("cgroup", "cgroup2"):
            continue
        version = 2 if described[0] == "cgroup2" else 1
        if version == 2 or controller in described[-1].split(","):
            yield version, _unescape(fields[3]), Path(_unescape(fields[4]))


def _unescape(text: str) -> str:
    return re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), text)


def _number(path: Path) -> int | None:
    text = _text(path)
    return int(text) if text.isdecimal() else None


def _text(path: Path) -> str:
    """Returns the content of a file; empty without the file, as on other systems."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
