"""How well the time of sfm is told before it starts: told against took, of finished workspaces.

    python tests/bench/bench_sfm_estimate.py WORKSPACE... [--fit]

Nothing is run: manifests record the CPU seconds of each step. Those of all steps together are told
from the frames, their size, tracks and segments, by the costs in `sfm/mapping/time_estimate.py`;
the seconds on two idle cores follow from the same costs. A row that needed a later mapper is
marked: that the first falls short cannot be known before. --fit prints costs that fit the rows that
are not marked, in relative least squares with none below zero; one that no row pays keeps its
value.

CPU seconds of a busy machine are up to twice those of an idle one, so workspaces to fit with should
be mapped one at a time.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from scipy.optimize import lsq_linear
from workbench import print_head, print_row, read_json, workspaces_argument

from recon_cli.errors import FormatError, ManifestError
from recon_cli.io.tracks import TRACKS, Tracks
from recon_cli.sfm.features.keyframes import choose_keyframes
from recon_cli.sfm.mapping.time_estimate import COSTS, Costs, Workload, expected_seconds, list_work
from recon_cli.workspace.records import read_frame_list
from recon_cli.workspace.summaries import SfmSummary

HEADINGS = (
    "workspace", "frames", "keyframes", "MP", "kind", "segments", "told, CPU s", "took",
    "told / took", "told, s on 2 cores", "s of the clock", "later mappers")
TOLERANCE = 1 / 3  # of what it took
STAY = 0.1  # how strongly costs keep their values in a fit


@dataclass(frozen=True)
class Row:
    """A finished workspace."""

    name: str
    work: Workload
    cpu_seconds: float
    seconds: float
    later: tuple[str, ...]  # mappers that were run after the first

    @property
    def ratio(self) -> float:
        """Told over took, in CPU seconds."""
        return told(self.work) / self.cpu_seconds


def told(work: Workload, costs: Costs = COSTS) -> float:
    """Returns the CPU seconds of all cores together."""
    return expected_seconds(work, 1, costs=costs)


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
    work = Workload(
        summary.frames, group.width * group.height / 1e6, tracked=tracks.exists(),
        segments=summary.segments,
        keyframes=len(choose_keyframes(Tracks.read(tracks))) if tracks.exists() else None)
    return Row(
        workspace.name, work, sum(summary.cpu_seconds.values()), manifest["seconds"],
        tuple(attempt.name for attempt in summary.attempts[1:] if not attempt.skipped))


def fit(rows: list[Row]) -> Costs:
    """Returns the costs that tell these rows best."""
    names = [field.name for field in dataclasses.fields(Costs)]
    known = np.array([getattr(COSTS, name) for name in names])
    paid = np.array([[list_work(row.work).get(name, (0.0, True))[0] / row.cpu_seconds
                      for name in names] for row in rows])
    keep = STAY * np.diag(1 / known)
    found = lsq_linear(np.vstack([paid, keep]), np.concatenate([
        np.ones(len(rows)), np.full(len(names), STAY)]), bounds=(0, np.inf)).x
    return Costs(*(round(float(value), 3) for value in found))


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
        work = row.work
        print_row(
            row.name, str(work.frames), str(work.keyframes or ""), f"{work.megapixels:.2f}",
            "walk" if work.tracked else "photos", str(work.segments), f"{told(work):.0f}",
            f"{row.cpu_seconds:.0f}", f"{row.ratio:.2f}", f"{expected_seconds(work, 2):.0f}",
            f"{row.seconds:.0f}", ", ".join(row.later))
    first = [row for row in rows if not row.later]
    right = sum(abs(row.ratio - 1) <= TOLERANCE for row in first)
    click.echo(f"\n{right} of {len(first)} that the first mapper served are told within a third.")
    if fitting and first:
        costs = fit(first)
        click.echo(f"\n{costs}")
        right = sum(abs(told(row.work, costs) / row.cpu_seconds - 1) <= TOLERANCE for row in first)
        click.echo(f"{right} of {len(first)} within a third with these.")


if __name__ == "__main__":
    main()
