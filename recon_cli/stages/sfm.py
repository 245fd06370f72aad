"""sfm: finds the cameras and sparse points of the frames.

The original frames are mapped, as filters move corners. Each part of the capture is a COLMAP model
in the frame of the mapper; `place` moves one of them into the world.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

from recon_cli.config.stages import SfmConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError
from recon_cli.io.tracks import TRACKS, Tracks
from recon_cli.jobs.executor import Executor, start_executor
from recon_cli.scene.camera import MODELS, PANORAMA
from recon_cli.sfm import database
from recon_cli.sfm.job import CLIP_SECONDS, CameraGroup, MappingJob
from recon_cli.sfm.mapping import process
from recon_cli.sfm.poses.align_world import find_places
from recon_cli.sfm.results import MappingResult
from recon_cli.sfm.segments import segments
from recon_cli.time_estimate import estimate_for_notice, format_minutes, list_mapping
from recon_cli.workspace import records as store
from recon_cli.workspace.records import POSES, FrameList, KnownPoses, read_poses
from recon_cli.workspace.steps import StepFolder
from recon_cli.workspace.summaries import MappedParts, SfmSummary

# 292 photos took 15 minutes with all that was tried, on two busy cores, and 170 photos 11.
USUAL_FRAMES, MINUTES_PER_FRAME = 100, 0.2
NEAR_LIMIT = 0.5  # share of the limit from which on the notice names the limit


def run(config: SfmConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> SfmSummary:
    """Writes the models of the parts of the capture into out/parts.

    The database and finished steps in `out` are kept; the model does not depend on the threads.

    Raises:
        SfmError: there are too few cameras, an untrusted model, no time left, or a dead process.
        ConfigError: a place of --scale-between is unknown.
        FormatError: the folder of ingest does not hold what it promises.
    """
    ingest = inputs.folders["ingest"].resolve()
    frames = store.read_frame_list(ingest)
    poses, tracks = ingest / POSES, ingest / TRACKS
    known = read_poses(poses) if poses.exists() else None
    job = MappingJob(
        frames=ingest / store.FOLDER, out=out.resolve(),
        groups=_groups(frames, config.camera_model),
        masks=ingest / store.MASKS if any(frame.masked for frame in frames.frames) else None,
        poses=poses if known else None, pose_use=_pose_use(config, known),
        given_points=known is not None and known.points is not None,
        tracks=tracks if tracks.exists() else None, pairs=config.pairs,
        max_features=config.max_features, min_registered=config.min_registered,
        accept_weak=config.accept_weak, partial=config.partial,
        max_minutes=_time_limit(config, frames), seed=config.seed, threads=ctx.threads,
        sharpness={frame.name: frame.sharpness for frame in frames.frames
                   if frame.sharpness is not None},
        times=_times(frames, tracks),
        spare_minutes=max(0.0, ctx.deadline.left / 60) if ctx.deadline.limited else None)
    store.refuse_missing_frames(job.frames, job.names, "ingest")
    find_places(frames, config.scale_between)  # now, not after minutes of mapping
    _tell_time(config, job, ctx)
    runs = _run_segments(config, job, ctx)
    job = runs.job
    process.run_job(job, progress=ctx.progress, record=ctx.record, on_idle=ctx.while_idle)
    summary = _summary(frames, runs, MappingResult.read(job))
    segments.remove_segments(job)
    database.forget_rows(job.database)
    return summary


def _pose_use(config: SfmConfig, known: KnownPoses | None) -> str:
    """Returns how poses are used: what a device tracked is a start, others stay."""
    if config.poses == "auto" and (known is None or known.accuracy != "tracked"):
        return "keep"
    return config.poses


def _run_segments(
    config: SfmConfig, job: MappingJob, ctx: StageContext
) -> segments.SegmentRuns:
    """Maps a long capture in segments and says which failed; leaves others as they are."""
    together = job.known_poses or job.pairs != "auto" or bool(job.panoramas)
    number = 1 if together else segments.count_segments(
        segments.count_mapped(job), config.segments)
    if number == 1:
        segments.remove_segments(job)  # of a run with other options
        if config.on == "ray":
            ctx.notice(f"The {len(job.names)} images are mapped together, on this machine: only "
                       "segments run on Ray (--segments).")
        return segments.SegmentRuns(job, {}, {})
    runs = segments.map_segments(
        job, number, lambda count: _start_executor(config, job, count, ctx.threads),
        progress=ctx.progress, record=ctx.record)
    for index, reason in runs.failed.items():
        names = runs.job.segments[index]
        ctx.notice(f"Segment {index}, {names[0]} to {names[-1]}, has no model: {reason}")
    return runs


def _start_executor(
    config: SfmConfig, job: MappingJob, count: int, threads: int
) -> tuple[Executor, int]:
    """Returns what maps segments, and the threads of each: on this machine they share `threads`."""
    if config.on == "ray":
        return start_executor(
            config.on, job.out, inputs=[job.frames], slots=config.jobs, gpu=False)
    slots = min(config.jobs or threads, count)
    return start_executor(config.on, job.out, slots=slots, cores=max(1, threads // slots))


def _time_limit(config: SfmConfig, frames: FrameList) -> float:
    """Returns the limit in minutes: as asked for, or by the number of frames."""
    if config.max_minutes is not None:
        return config.max_minutes
    return MINUTES_PER_FRAME * max(USUAL_FRAMES, len(frames.frames))


def _tell_time(config: SfmConfig, job: MappingJob, ctx: StageContext) -> None:
    """Tells how long the cameras will take, and the limit where it is near."""
    if job.known_poses or job.pairs != "auto" or StepFolder(job.out).is_finished("features"):
        return  # as asked for, or partly done
    mapped = segments.count_mapped(job)
    number = segments.count_segments(mapped, config.segments)
    largest = max(job.groups, key=lambda group: len(group.names))
    seconds = estimate_for_notice(list_mapping(
        len(job.names), largest.width * largest.height / 1e6, tracked=job.tracks is not None,
        segments=number, keyframes=mapped), ctx.threads)
    if seconds is None:
        return
    words = f"The cameras of {len(job.names):,} frames will take about {format_minutes(seconds)}"
    if seconds > NEAR_LIMIT * 60 * job.max_minutes:
        ctx.notice(f"{words} of the {job.max_minutes:.3g} that --max-minutes allows.")
    else:
        ctx.tell(f"{words}.")


def _groups(frames: FrameList, model: str) -> tuple[CameraGroup, ...]:
    models = [name for name in MODELS if name != PANORAMA]  # ingest recognises those
    if model not in ("auto", *models):
        raise ConfigError(
            f"camera_model is {model!r}, which is not a model of COLMAP for a lens.",
            hint=f"Give --camera-model auto or one of {', '.join(models)}.")
    return tuple(
        CameraGroup(
            tuple(frame.name for frame in frames.frames if frame.group == index),
            group.width, group.height, group.focal_px, group.lens, model)
        for index, group in enumerate(frames.groups))


def _times(frames: FrameList, tracks: Path) -> dict[str, float]:
    """Returns the seconds of video frames; one clip follows another after a gap of any length.

    Photos that follow each other, which only their tracks say, get their place in the order.
    """
    times = {frame.name: frame.time_seconds + CLIP_SECONDS * frame.group
             for frame in frames.frames if frame.time_seconds is not None}
    if times or not tracks.exists():
        return times
    followed = Tracks.read(tracks)
    clip = 0
    for place, name in enumerate(followed.names):
        clip += place > 0 and not len(followed.matches(place - 1, place)[0])
        times[name] = place + CLIP_SECONDS * clip
    return times


def _summary(frames: FrameList, runs: segments.SegmentRuns, found: MappingResult) -> SfmSummary:
    job, model = runs.job, found.model
    return SfmSummary(
        **{item.name: getattr(model, item.name) for item in fields(MappedParts)},
        frames=len(frames.frames), seconds=found.seconds, segments=max(1, len(job.segments)),
        cpu_seconds={
            **{f"{step} of segments": seconds for step, seconds in runs.cpu_seconds.items()},
            **found.cpu_seconds})
