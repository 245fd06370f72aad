"""COLMAP's mappers on the matches of finished workspaces: `bench_mappers.py WORKSPACE...`.

Each of incremental, hierarchical and global mapping gets a copy of sfm/database.db, with the
matches of features alone, and the same seed and single thread. The first row of a workspace is the
model that it holds, which was mapped from tracks or coarse features first; its CPU seconds are
those of the step, with the verdict and everything else that a mapper alone does not do. Cameras are
compared with a reference where WORKSPACE=REFERENCE names one (a traj.txt or a data set), else with
the model of the workspace.
"""

from __future__ import annotations

import io
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import click
from pose_errors import Poses, compare, model_poses, reference_poses
from workbench import mapping_job, print_head, print_row, read_json

from recon_cli.errors import FormatError
from recon_cli.io.colmap_library import pycolmap
from recon_cli.sfm.job import MappingJob, Reporter
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.mapping.mapper import model_size

HEADINGS = ("capture", "mapper", "registered", "models", "points", "reprojection px",
            "centre median / max", "compared with", "CPU s")
LEAF, OVERLAP = 40, 20  # images of a cluster and of two: COLMAP's 500 would leave a single cluster
FEWEST = 3  # cameras that can be compared

Models = list[pycolmap.Reconstruction]


def map_hierarchically(job: MappingJob, _report: Reporter) -> Models:
    """Returns the models of COLMAP's hierarchical mapper, adjusted as those of the others are."""
    options = pycolmap.HierarchicalPipelineOptions()
    options.num_threads = options.num_workers = 1
    options.clustering_options.leaf_max_num_images = LEAF
    options.clustering_options.image_overlap = OVERLAP
    inner = options.incremental_options
    inner.num_threads = inner.mapper.num_threads = 1
    inner.random_seed = inner.mapper.random_seed = inner.triangulation.random_seed = job.seed
    inner.min_model_size = 3
    inner.ba_global_frames_ratio = inner.ba_global_points_ratio = mapper.GLOBAL_RATIO
    inner.ba_global_function_tolerance = mapper.TOLERANCE
    models = pycolmap.hierarchical_mapping(job.database, job.frames, job.out / "found", options)
    for model in models.values():
        mapper.adjust(model)
    return list(models.values())


MAPPERS: dict[str, Callable[[MappingJob, Reporter], Models]] = {
    "incremental": mapper.map_incrementally, "hierarchical": map_hierarchically,
    "global": mapper.map_globally}


def errors(found: Poses, truth: Poses) -> str:
    """Returns the cell on the errors of the centres, as shares of the extent."""
    if len(set(found) & set(truth)) < FEWEST:
        return ""
    off = compare(found, truth)
    return f"{off.median_share:.3%} / {off.max_share:.2%}"


def measure(workspace: Path, name: str, truth: Poses) -> tuple[str, ...]:
    """Returns the cells of one mapper on the matches of a workspace."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        job = mapping_job(workspace / "ingest", out, matches_db=out / "database.db")
        shutil.copyfile(workspace / "sfm" / "database.db", job.database)
        job.attempts.mkdir()
        (out / "found").mkdir()
        start = time.process_time()
        try:
            models = sorted(MAPPERS[name](job, Reporter(io.BytesIO())), key=model_size)
        except (RuntimeError, ValueError) as error:
            return name, "", "", "", "", f"failed: {error}", f"{time.process_time() - start:.1f}"
        seconds = time.process_time() - start
        if not models:
            return name, "0", "0", "", "", "", f"{seconds:.1f}"
        best = models[-1]
        (out / "best").mkdir()
        best.write_binary(out / "best")
        return (name, str(best.num_reg_images()), str(len(models)), str(best.num_points3D()),
                f"{best.compute_mean_reprojection_error():.3f}",
                errors(model_poses(out / "best"), truth), f"{seconds:.1f}")


def describe_finished(workspace: Path, truth: Poses | None) -> tuple[str, ...]:
    """Returns the cells of the model that a workspace holds."""
    summary = read_json(workspace / "place" / "manifest.json")["summary"]
    way = next((rung["name"] for rung in summary["rungs"] if rung["kept"]), "given poses")
    own = model_poses(workspace / "place" / "sparse")
    return (f"recon ({way})", str(summary["registered"]), str(len(summary["models"])),
            str(summary["points"]), f"{summary['reprojection_error_px']:.3f}",
            "" if truth is None else errors(own, truth), f"{summary['cpu_seconds']['model']:.1f}")


@click.command()
@click.argument("workspaces", nargs=-1, required=True)
@click.option("--mapper", "names", multiple=True, type=click.Choice(list(MAPPERS)),
              default=tuple(MAPPERS), help="Only these.")
def main(workspaces: tuple[str, ...], names: tuple[str, ...]) -> None:
    """Prints a Markdown table, a row as soon as it is known."""
    print_head(*HEADINGS)
    for text in workspaces:
        place, _, given = text.partition("=")
        workspace = Path(place)
        if not (workspace / "place" / "manifest.json").exists():
            raise FormatError(f"{workspace} has no finished sfm.",
                              hint="Run `recon sfm` there first.")
        truth = reference_poses(Path(given)) if given else None
        own = model_poses(workspace / "place" / "sparse")
        for cells in (describe_finished(workspace, truth),
                      *(measure(workspace, name, truth or own) for name in names)):
            own_row = cells[0].startswith("recon")
            compared = "reference" if given else "" if own_row else "recon"
            print_row(workspace.name, *cells[:6], compared, cells[6])


if __name__ == "__main__":
    main()
