"""How well the time of sfm is told before it starts: told against took, of finished workspaces.

    python tests/bench/bench_sfm_estimate.py WORKSPACE... [--fit]

Nothing is run: manifests record the CPU seconds of each step. Those of all steps together are told
from the frames, their size, tracks and segments, by the costs in `time_estimate.py`;
the seconds on two idle cores follow from the same costs. A row that needed a later mapper is
marked: that the first falls short cannot be known before. --fit prints costs that fit the rows that
are not marked, in relative least squares with none below zero; one that no row pays keeps its
value.

CPU seconds of a busy machine are up to twice those of an idle one, so workspaces to fit with should
be mapped one at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
from scipy.optimize import lsq_linear
from workbench import print_head, print_row, read_json, workspaces_argument

from recon_cli.errors import FormatError, ManifestError
from recon_cli.io.tracks import TRACKS, Tracks
from recon_cli.sfm.features.keyframes import choose_keyframes
from recon_cli.time_estimate import COSTS, Cost, TimeEstimator, Work, list_mapping
from recon_cli.workspace.records import read_frame_list
from recon_cli.workspace.summaries import SfmSummary

HEADINGS = (
    "workspace", "frames", "keyframes", "MP", "kind", "segments", "told, CPU s", "took",
    "told / took", "told, s on 2 cores", "s of the clock", "later mappers")
TOLERANCE = 1 / 3  # of what it took
MAPPING = ("walk", "keyframe", "walk_mapping", "photo", "photo_mapping", "split", "join")
STAY = 0.1  # how strongly costs keep their values in a fit


@dataclass(frozen=True)
class Row:
    """A finished workspace."""

    name: str
    facts: dict[str, Any]  # of `list_mapping`
    cpu_seconds: float
    seconds: float
    later: tuple[str, ...]  # mappers that were run after the first

    @property
    def ratio(self) -> float:
        """Told over took, in CPU seconds."""
        return TimeEstimator(COSTS).total(self.work) / self.cpu_seconds

    @property
    def work(self) -> list[Work]:
        """What is told."""
        return list_mapping(**self.facts)


def read_row(workspace: Path) -> Row | None:
    """Returns the row of a workspace; None without an sfm that was mapped here and timed."""
    try:
        manifest = read_json(workspace / "sfm" / "manifest.json")
        frames = read_frame_list(workspace / "ingest")
        summary = SfmSummary.from_json(manifest["summary"])
    except (OSError, FormatError, ManifestError):  # unfinished, or of another version
        return None
    if summary.poses or not summary.cpu_seconds or not summary.attempts:
        return None
    group = max(frames.groups, key=lambda each: each.width * each.height)
    tracks = workspace / "ingest" / TRACKS
    facts = {
        "frames": summary.frames, "megapixels": group.width * group.height / 1e6,
        "tracked": tracks.exists(), "segments": summary.segments,
        "keyframes": len(choose_keyframes(Tracks.read(tracks))) if tracks.exists() else None}
    return Row(
        workspace.name, facts, sum(summary.cpu_seconds.values()), manifest["seconds"],
        tuple(attempt.name for attempt in summary.attempts[1:] if not attempt.skipped))


def fit(rows: list[Row]) -> dict[str, Cost]:
    """Returns the costs that tell these rows best, of the work of sfm before a later mapper."""
    names = [(kind, part) for kind in MAPPING for part in ("fixed", "each")
             if getattr(COSTS[kind], part)]
    known = np.array([getattr(COSTS[kind], part) for kind, part in names])
    paid = np.array([[sum(
        work.count * (work.size if part == "each" else 1) for work in row.work if work.kind == kind
    ) / row.cpu_seconds for kind, part in names] for row in rows])
    keep = STAY * np.diag(1 / known)
    found = lsq_linear(np.vstack([paid, keep]), np.concatenate([
        np.ones(len(rows)), np.full(len(names), STAY)]), bounds=(0, np.inf)).x
    values = {name: round(float(value), 3) for name, value in zip(names, found, strict=True)}
    return {kind: Cost(*(values.get((kind, part), 0.0) for part in ("fixed", "each")))
            for kind in MAPPING}


@click.command()
@workspaces_argument
@click.option("--fit", "fitting", is_flag=True, help="Print costs that fit.")
def main(workspaces: tuple[Path, ...], fitting: bool) -> None:
    """Prints the table."""
    rows = [row for row in map(read_row, workspaces) if row is not None]
    if not rows:
        raise click.ClickException("none of these workspaces holds a mapped sfm with its times")
    print_head(*HEADINGS)
    for row in rows:
        facts = row.facts
        print_row(
            row.name, str(facts["frames"]), str(facts["keyframes"] or ""),
            f"{facts['megapixels']:.2f}", "walk" if facts["tracked"] else "photos",
            str(facts["segments"]), f"{row.ratio * row.cpu_seconds:.0f}", f"{row.cpu_seconds:.0f}",
            f"{row.ratio:.2f}", f"{TimeEstimator(COSTS, 2).total(row.work):.0f}",
            f"{row.seconds:.0f}", ", ".join(row.later))
    first = [row for row in rows if not row.later]
    right = sum(abs(row.ratio - 1) <= TOLERANCE for row in first)
    click.echo(f"\n{right} of {len(first)} that the first mapper served are told within a third.")
    if fitting and first:
        costs = fit(first)
        click.echo(f"\n{costs}")
        right = sum(abs(TimeEstimator(costs).total(row.work) / row.cpu_seconds - 1) <= TOLERANCE
                    for row in first)
        click.echo(f"{right} of {len(first)} within a third with these.")


if __name__ == "__main__":
    main()
