"""sfm: finds the cameras and sparse points of the frames, and undistorts the frames.

The original frames are mapped, not the denoised ones: a filter moves corners. The twins take the
cameras of their originals.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from recon_cli.capture import frames as store
from recon_cli.capture.frames import FrameList
from recon_cli.capture.pace import paced
from recon_cli.config import SfmConfig
from recon_cli.errors import FormatError
from recon_cli.io.poses import POSES
from recon_cli.mapping import process
from recon_cli.mapping.doctor import listed
from recon_cli.mapping.job import CameraGroup, Job
from recon_cli.mapping.ledger import STEPS, Ledger
from recon_cli.stages.context import StageContext, StageInputs, Summary


def run(config: SfmConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Writes sparse/ and undistorted/{images,denoised,sparse} into `out`.

    Args:
        config: see `SfmConfig`.
        inputs: the finished folders of ingest and denoise.
        out: the stage's partial folder; the database and finished steps in it are kept.
        ctx: for notices, progress and threads; the model does not depend on the threads.

    Returns:
        frames, registered (counts), unregistered, unregistered_held_out (names), points,
        mean_track_length, reprojection_error_px, median_triangulation_angle_deg, models (number of
        frames in each model that was found), width, height, focal_px (undistorted), seconds (by
        step).

    Raises:
        SfmError: there are too few cameras, the model cannot be trusted, the time is up, or the
            mapping process died.
        FormatError: the folders of ingest or denoise do not hold what they promise.
    """
    ingest, denoise = inputs.folders["ingest"].resolve(), inputs.folders["denoise"].resolve()
    frames = store.read_frame_list(ingest)
    job = Job(
        frames=ingest / store.FOLDER,
        denoised=denoise / store.FOLDER,
        out=out.resolve(),
        groups=_groups(frames),
        masks=ingest / store.MASKS if any(frame.masked for frame in frames.frames) else None,
        poses=poses if (poses := ingest / POSES).exists() else None,
        pose_use=config.poses,
        pairs=config.pairs,
        max_features=config.max_features,
        min_registered=config.min_registered,
        seed=config.seed,
        threads=ctx.threads,
    )
    _check_frames(job)
    process.run_job(
        job, max_minutes=config.max_minutes, progress=ctx.progress, record=paced(ctx.record))
    summary = _summary(frames, Ledger(out))
    _report(summary, ctx)
    return summary


def _groups(frames: FrameList) -> tuple[CameraGroup, ...]:
    return tuple(
        CameraGroup(
            tuple(frame.name for frame in frames.frames if frame.group == index),
            group.width, group.height, group.focal_px, group.lens)
        for index, group in enumerate(frames.groups))


def _check_frames(job: Job) -> None:
    for verb, folder in (("ingest", job.frames), ("denoise", job.denoised)):
        missing = [name for name in job.names if not (folder / name).is_file()]
        if missing:
            raise FormatError(
                f"{folder} lacks {len(missing)} of {len(job.names)} frames: {listed(missing)}.",
                hint=f"Run `recon {verb} --again`.")


def _summary(frames: FrameList, ledger: Ledger) -> Summary:
    results: dict[str, dict[str, Any]] = {}
    for step in STEPS:
        result = ledger.result(step)
        assert result is not None, f"the mapping process ended without {step}"
        results[step] = result
    sparse, camera = results["sparse"], results["undistorted"]
    unregistered = sorted({frame.name for frame in frames.frames} - set(sparse["registered"]))
    held_out = {frame.name for frame in frames.frames if frame.held_out}
    return {
        "frames": len(frames.frames),
        "registered": len(sparse["registered"]),
        "unregistered": unregistered,
        "unregistered_held_out": [name for name in unregistered if name in held_out],
        "points": sparse["points"],
        "mean_track_length": sparse["mean_track_length"],
        "reprojection_error_px": sparse["reprojection_error_px"],
        "median_triangulation_angle_deg": sparse["median_triangulation_angle_deg"],
        "models": sparse["models"],
        "width": camera["width"],
        "height": camera["height"],
        "focal_px": camera["focal_px"],
        "seconds": {step: result["seconds"] for step, result in results.items()},
    }


def _report(summary: Summary, ctx: StageContext) -> None:
    """Says which frames have no camera and which models were left aside."""
    missing, held_out = summary["unregistered"], summary["unregistered_held_out"]
    if missing:
        ctx.notice(
            f"{len(missing)} of {summary['frames']} frames have no camera and are left out: "
            f"{listed(missing)}.")
    if held_out:
        ctx.notice(
            f"{len(held_out)} of them were held out and so cannot be scored: {listed(held_out)}.")
    if len(summary["models"]) > 1:
        sizes = ", ".join(str(size) for size in summary["models"][1:])
        ctx.notice(
            f"The capture fell apart: the largest model, of {summary['models'][0]} frames, is "
            f"kept; others of {sizes} frames are left aside.")
