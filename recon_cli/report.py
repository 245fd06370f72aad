"""What the command line prints about results: one line a stage, the status table, the doctor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from recon_cli.doctor import Findings
from recon_cli.pipeline import StageStatus


def summary_line(stage: str, summary: Mapping[str, Any], seconds: float | None = None) -> str:
    """Returns a stage's summary on one line: numbers and words, no lists, nothing that is empty."""
    parts = [
        f"{name.replace('_', ' ')} {_shown(value)}" for name, value in summary.items()
        if value is not None and value != "" and not isinstance(value, (list, dict))
    ]
    text = f"{stage}: {', '.join(parts)}" if parts else stage
    return text if seconds is None else f"{text} ({duration(seconds)})"


def _shown(value: object) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def duration(seconds: float) -> str:
    """Returns seconds as a person says them: 8.2 s, 4 min 10 s, 1 h 05 min."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def megabytes(size: int) -> str:
    """Returns a number of bytes in MB."""
    return f"{size / 1e6:.1f} MB"


def status_table(stages: Sequence[StageStatus]) -> str:
    """Returns stage, state, time, and what is worth knowing, one line a stage."""
    rows = [("stage", "state", "time", "")]
    for one in stages:
        state = f"partial ({one.how_far})" if one.state == "partial" else one.state
        told = "; ".join(one.reasons)
        if not told and one.summary:
            told = summary_line("", one.summary).removeprefix(": ")
        time = "" if one.seconds is None else duration(one.seconds)
        rows.append((one.name, state, time, told))
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, [*widths, 0], strict=True))
             for row in rows]
    return "\n".join(line.rstrip() for line in lines)


def doctor_text(found: Findings) -> str:
    """Returns the doctor's findings, one line each."""
    lines = [f"{name:<13} {version}" for name, version in found.versions.items()]
    lines.append(f"{'device':<13} {found.device}")
    for backend in found.backends:
        state = f"missing: {backend.missing}" if backend.missing else (
            "runs on " + ", ".join(backend.devices))
        lines.append(f"{'backend':<13} {backend.name}: {state}")
    writable = "writable" if found.writable else "NOT writable"
    lines += [
        f"{'cores':<13} {found.cores}",
        f"{'memory':<13} {found.memory_free_bytes / 1e9:.1f} GB free of "
        f"{found.memory_total_bytes / 1e9:.1f} GB",
        f"{'disk':<13} {found.disk_free_bytes / 1e9:.1f} GB free",
        f"{'workspace':<13} {found.workspace} ({writable})",
    ]
    return "\n".join(lines)
