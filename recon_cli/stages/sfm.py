"""sfm: finds the cameras and sparse points of the frames, and undistorts the frames.

The original frames are mapped, as filters move corners; denoised twins take their cameras.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from pathlib import Path

from recon_cli.config.stages import SfmConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, FormatError, format_count, list_names, name_command
from recon_cli.io.tracks import TRACKS, Tracks
from recon_cli.jobs.executor import Executor, start_executor
from recon_cli.room.scale import parse_place
from recon_cli.scene.camera import MODELS, PANORAMA
from recon_cli.sfm import database
from recon_cli.sfm.job import CLIP_SECONDS, CameraGroup, MappingJob
from recon_cli.sfm.mapping import parts, process
from recon_cli.sfm.mapping.time_estimate import Workload, estimate_for_notice, format_minutes
from recon_cli.sfm.mapping.trusted_part import JOIN_PANORAMAS
from recon_cli.sfm.results import MappingResult
from recon_cli.sfm.segments import segments
from recon_cli.workspace import records as store
from recon_cli.workspace.records import (
    POSES,
    FrameList,
    KnownPoses,
    describe_stretches,
    read_poses,
)
from recon_cli.workspace.steps import StepFolder
from recon_cli.workspace.summaries import (
    AttemptSummary,
    PartSummary,
    PosesSummary,
    SfmSummary,
)

# 292 photos took 15 minutes with all that was tried, on two busy cores, and 170 photos 11.
MAX_MINUTES, USUAL_FRAMES, MINUTES_PER_FRAME = 20.0, 100, 0.2
NEAR_LIMIT = 0.5  # share of the limit from which on the notice names the limit
STRETCHES = 8  # of frames without a camera, in a sentence


def run(config: SfmConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> SfmSummary:
    """Writes sparse/ and undistorted/{images,denoised,sparse} into `out`.

    The database and finished steps in `out` are kept; the model does not depend on the threads.
    The parts of the capture are those of an earlier result, where that differs in late options.

    Raises:
        SfmError: there are too few cameras, an untrusted model, no time left, or a dead process.
        ConfigError: the capture has no such part.
        FormatError: the folders of ingest or denoise do not hold what they promise.
    """
    ingest, denoise = inputs.folders["ingest"].resolve(), inputs.folders["denoise"].resolve()
    frames = store.read_frame_list(ingest)
    poses, tracks = ingest / POSES, ingest / TRACKS
    earlier = inputs.earlier
    mapped = earlier is not None and parts.take_over(
        earlier.folder, earlier.summary, earlier.changed | earlier.missing, out)
    known = read_poses(poses) if poses.exists() else None
    scale_between = config.scale_between
    if scale_between is not None:
        a, b = store.find_frames(ingest, scale_between[:2])
        scale_between = (a, b, scale_between[2])
    job = MappingJob(
        frames=ingest / store.FOLDER, denoised=denoise / store.FOLDER, out=out.resolve(),
        groups=_groups(frames, config.camera_model),
        masks=ingest / store.MASKS if any(frame.masked for frame in frames.frames) else None,
        poses=poses if known else None, pose_use=_pose_use(config, known),
        given_points=known is not None and known.points is not None,
        tracks=tracks if tracks.exists() else None, pairs=config.pairs,
        max_features=config.max_features, min_registered=config.min_registered,
        accept_weak=config.accept_weak, partial=config.partial, gravity=config.gravity == "auto",
        scale_between=scale_between, part=config.part,
        max_minutes=_time_limit(config, frames), seed=config.seed, threads=ctx.threads,
        sharpness={frame.name: frame.sharpness for frame in frames.frames
                   if frame.sharpness is not None},
        times=_times(frames, tracks),
        spare_minutes=max(0.0, ctx.deadline.left / 60) if ctx.deadline.limited else None)
    _check_frames(job)
    for place in (scale_between or ())[:2]:  # now, not after minutes of mapping
        parse_place(str(place), job.names)
    if not mapped:
        _tell_time(config, job, ctx)
    runs = segments.SegmentRuns(job, {}, {}) if mapped else _run_segments(config, job, ctx)
    job = runs.job
    process.run_job(job, progress=ctx.progress, record=ctx.record, on_idle=ctx.while_idle)
    summary = _summary(frames, runs, MappingResult.read(job))
    _report(summary, frames, ctx)
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
            config.on, job.out, inputs=[job.frames, job.denoised], slots=config.jobs, gpu=False)
    slots = min(config.jobs or threads, count)
    return start_executor(config.on, job.out, slots=slots, cores=max(1, threads // slots))


def _time_limit(config: SfmConfig, frames: FrameList) -> float:
    """Returns the limit in minutes: as asked for, or by the number of frames."""
    if config.max_minutes is not None:
        return config.max_minutes
    return MAX_MINUTES + MINUTES_PER_FRAME * max(0, len(frames.frames) - USUAL_FRAMES)


def _tell_time(config: SfmConfig, job: MappingJob, ctx: StageContext) -> None:
    """Tells how long the cameras will take, and the limit where it is near."""
    if job.known_poses or job.pairs != "auto" or StepFolder(job.out).is_finished("features"):
        return  # as asked for, or partly done
    mapped = segments.count_mapped(job)
    number = segments.count_segments(mapped, config.segments)
    largest = max(job.groups, key=lambda group: len(group.names))
    seconds = estimate_for_notice(Workload(
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


def _check_frames(job: MappingJob) -> None:
    for verb, folder in (("ingest", job.frames), ("denoise", job.denoised)):
        missing = [name for name in job.names if not (folder / name).is_file()]
        if missing:
            raise FormatError(
                f"{folder} lacks {len(missing)} of {len(job.names)} frames: {list_names(missing)}.",
                hint=f"Run {name_command(f'{verb} --again')}.")


def _summary(frames: FrameList, runs: segments.SegmentRuns, found: MappingResult) -> SfmSummary:
    job, model = runs.job, found.model
    part, earlier = model.parts[job.part - 1], model.earlier
    unregistered = tuple(sorted({frame.name for frame in frames.frames} - set(part.registered)))
    held_out = {frame.name for frame in frames.frames if frame.held_out}
    return SfmSummary(
        frames=len(frames.frames), registered=len(part.registered), points=part.points,
        mean_track_length=part.mean_track_length, reprojection_error_px=part.reprojection_error_px,
        median_triangulation_angle_deg=part.median_triangulation_angle_deg, poses=model.poses,
        models=model.models, apart=model.apart, rejected=part.rejected, verdict=part.verdict,
        lines=(*model.broken[:1], *part.lines, *model.notes), attempts=model.attempts,
        seconds=found.seconds, unregistered=unregistered,
        unregistered_held_out=tuple(name for name in unregistered if name in held_out),
        world=found.world, cameras=found.cameras, left_out=model.left_out,
        parts=tuple(PartSummary(names=each.registered, points=each.points)
                    for each in model.parts),
        part=job.part if len(model.parts) > 1 else None, broken=model.broken,
        segments=earlier.segments if earlier else max(1, len(job.segments)),
        cpu_seconds={
            **{f"{step} of segments": seconds for step, seconds in runs.cpu_seconds.items()},
            **(earlier.cpu_seconds if earlier else {}), **found.cpu_seconds})


def _report(summary: SfmSummary, frames: FrameList, ctx: StageContext) -> None:
    """Says which frames have no camera and which models are not used.

    How a sound model was found, and how sure that is, stands in the log and the report.
    """
    sound = summary.trusted is not False and not (summary.broken or summary.left_out)
    for sentence in (*_attempts(summary.attempts), *summary.lines):
        if sound:
            ctx.tell(sentence, detail=True)
        else:
            ctx.notice(sentence)
    if sound and summary.rough:
        ctx.notice(f"{len(summary.rough)} of {summary.registered} cameras are rough, known badly "
                   f"for too few points in common: {list_names(summary.rough)}; "
                   f"{name_command('report')} says how badly.")
    for sentence in (*_describe_parts(summary, frames),
                     *_describe_left_out(summary, frames, named=not sound)):
        ctx.notice(sentence)
    for sentence in (*_movement(summary.poses), *summary.world.sentences):
        ctx.tell(sentence)


def _attempts(attempts: Sequence[AttemptSummary]) -> Iterator[str]:
    """Yields a sentence for each mapper that was tried after the first."""
    for before, attempt in pairwise(attempts):
        reason = attempt.reason[:1].lower() + attempt.reason[1:].rstrip(".")  # may be a sentence
        if attempt.reason == before.reason:
            reason = "that was so again"
        if attempt.skipped:
            yield (f"{attempt.name} was not tried (because {reason}): {attempt.skipped}, and "
                   "there is less time left.")
        else:
            yield (f"{attempt.name} (tried because {reason}) registered "
                   f"{format_count(attempt.registered, 'frame')}"
                   f"{'; this model is used' if attempt.kept else ''}.")


def _movement(poses: PosesSummary | None) -> Iterator[str]:
    """Yields a sentence on how far refining moved the given cameras."""
    if poses and poses.moved_median is not None:
        yield (f"Refining moved the cameras by {poses.moved_median:.2%} of the size of their "
               f"path (at most {poses.moved_max:.2%}) and turned them by "
               f"{poses.turned_median_deg:.2f} degrees (at most {poses.turned_max_deg:.2f}).")


def _describe_parts(summary: SfmSummary, frames: FrameList) -> Iterator[str]:
    """Yields sentences on the parts of a capture that has several, and on how to take another."""
    if len(summary.parts) < 2:
        return
    yield (f"The capture has {len(summary.parts)} parts, each of which can be trusted by itself; "
           f"part {summary.part} is used, and the others are left out.")
    for number, part in enumerate(summary.parts, 1):
        yield (f"Part {number} has {len(part.names)} of {summary.frames} frames: "
               f"{_stretches(frames, part.names)}.")
    other = 2 if summary.part == 1 else 1
    yield (f"{name_command(f'sfm --part {other}')} takes part {other}, without mapping again; "
           f"{name_command('report')} shows what to film to join them.")


def _describe_left_out(
    summary: SfmSummary, frames: FrameList, *, named: bool
) -> Iterator[str]:
    """Yields sentences on frames without a camera and on models that are not used.

    Where frames are `named` already, the verdict has said which have none, and why.
    """
    missing, held_out = summary.unregistered, summary.unregistered_held_out
    if summary.left_out:
        left_out = format_count(len(summary.left_out), "frame")
        yield (f"Left out with the rest of the model: {left_out}, "
               f"{_stretches(frames, summary.left_out)}.")
    for name, reason in summary.rejected.items():
        yield f"{name} was taken out of the model: {reason}."
    if missing and not (named and summary.lines):
        yield (f"Left out without a camera: {len(missing)} of {summary.frames} frames, "
               f"{_stretches(frames, missing)}; {name_command('report')} says why.")
    if missing and any(group.lens is not None and group.lens.is_panorama
                       for group in frames.groups):
        yield JOIN_PANORAMAS
    if held_out:
        yield (f"Held-out frames without a camera, which cannot be scored ({len(held_out)}): "
               f"{list_names(held_out)}.")
    if summary.apart:
        apart = "; ".join(
            f"{format_count(len(names), 'frame')} ({_stretches(frames, names)})"
            for names in summary.apart)
        yield f"The capture split into disconnected models; the smaller ones are not used: {apart}."


def _stretches(frames: FrameList, names: Collection[str]) -> str:
    return list_names(describe_stretches(frames.frames, names), STRETCHES)
