"""The parts of a capture in the stage's folder: parts/1 shows most, and parts/2 comes next.

Each is a COLMAP model in the mapper's own frame. One of them is placed and undistorted; another
one is taken without mapping again, also from a finished result.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from recon_cli.errors import ConfigError, ManifestError, name_command
from recon_cli.io.colmap_library import pycolmap, write_model
from recon_cli.sfm.job import (
    DATABASE,
    ORDER,
    VERDICT,
    MappingJob,
    fresh_folder,
    publish,
)
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.results import EarlierRun, ModelResult, PartResult
from recon_cli.sfm.verdict.verdict import ModelVerdict
from recon_cli.workspace import atomic, layout
from recon_cli.workspace.steps import LOG, StepFolder
from recon_cli.workspace.summaries import SfmSummary


def write_parts(
    job: MappingJob, parts: Sequence[tuple[pycolmap.Reconstruction, ModelVerdict | None]]
) -> None:
    """Writes all parts with the verdict on each, whole or not at all; the first shows most."""
    folder = fresh_folder(job.out / "parts.partial")
    for number, (model, verdict) in enumerate(parts, 1):
        own = fresh_folder(folder / str(number))
        write_model(model, own)
        if verdict is not None:
            atomic.write_json(own / VERDICT, verdict.to_json())
    publish(folder, job.parts)


def describe_part(
    model: pycolmap.Reconstruction, verdict: ModelVerdict | None, *,
    held: Collection[str] = (), rejected: Mapping[str, str] | None = None,
) -> PartResult:
    """Returns the figures and sentences of a part.

    Frames that are `held` by any part are not said to have no camera.
    """
    lines: list[str] = []
    if verdict is not None:
        lost = {name: why for name, why in verdict.unregistered.items() if name not in held}
        lines = dataclasses.replace(verdict, unregistered=lost).lines()
    tracks = model.compute_num_observations() > 0
    return PartResult(
        registered=tuple(mapper.list_registered(model)), points=model.num_points3D(),
        mean_track_length=model.compute_mean_track_length() if tracks else None,
        reprojection_error_px=model.compute_mean_reprojection_error() if tracks else None,
        median_triangulation_angle_deg=(
            float(np.median(mapper.triangulation_angles(model))) if tracks else None),
        rejected=dict(rejected or {}), verdict=verdict.to_json() if verdict else None,
        lines=tuple(lines))


def check_part(job: MappingJob) -> None:
    """Raises ConfigError where the capture has no part of the job's number."""
    found = StepFolder(job.out).find("model", ModelResult)
    assert found is not None, "the parts are found before one of them is placed"
    sizes = [len(part.registered) for part in found.parts]
    if job.part <= len(sizes):
        return
    named = ", ".join(f"{number} of {size} frames" for number, size in enumerate(sizes, 1))
    raise ConfigError(
        f"part is {job.part}, but the capture has {len(sizes)}: {named}.",
        hint="Type "
        f"{name_command(f'sfm --part {len(sizes)}')}{' or a smaller number' * (len(sizes) > 1)}.")


def take_over(
    finished: Path, summary: Mapping[str, Any], touched: Collection[str], out: Path
) -> bool:
    """Puts the parts of a finished result into the folder of a run that takes one of them.

    Returns whether they are there. Otherwise, as where files that it needs were `touched` since,
    the run maps by itself. The files are hard links, which nothing writes through.
    """
    try:
        known = SfmSummary.from_json(summary)
    except ManifestError:  # of another version
        return False
    log, current = StepFolder(finished), StepFolder(out).find("model", ModelResult)
    found = log.find("model", ModelResult)
    needed = log.files("model")
    intact = set(touched).isdisjoint((*needed, LOG))
    if found is None or not (known.parts and intact):
        return False
    if current is not None and current.earlier is not None:  # of an interrupted run
        return True
    for path in out.iterdir():
        layout.remove(path)
    for name in (*needed, DATABASE):
        if (finished / name).is_file():
            layout.link_or_copy(finished / name, out / name)
    log.copy_to(out, ORDER[:ORDER.index("model")])
    StepFolder(out).finish("model", dataclasses.replace(found, earlier=EarlierRun(
        segments=known.segments, cpu_seconds=known.cpu_seconds or {})), [
            out / name for name in needed])
    return True
