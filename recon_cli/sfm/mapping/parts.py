"""The parts of a capture in the stage's folder: parts/1 shows most, and parts/2 comes next.

Each is a COLMAP model in the mapper's own frame. The stage `place` takes one of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from recon_cli.io.colmap_library import pycolmap, write_model
from recon_cli.sfm.job import VERDICT, MappingJob, fresh_folder, publish
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.verdict.verdict import ModelVerdict
from recon_cli.workspace import atomic
from recon_cli.workspace.summaries import PartSummary


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


def list_part(
    model: pycolmap.Reconstruction, rejected: Mapping[str, str] | None = None
) -> PartSummary:
    """Returns what a part holds, and why frames were taken out of it, by name."""
    return PartSummary(names=tuple(mapper.list_registered(model)), points=model.num_points3D(),
                       rejected=rejected or {})
