"""place: moves one part of a capture into the world, and undistorts its frames.

Which way is up, where the floor is and how long a metre is are asked here, so that another answer
needs no new mapping. Denoised twins of the frames take their cameras.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import fields
from itertools import pairwise
from pathlib import Path

from recon_cli.config.stages import SfmConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, Hint, format_count, list_names, name_command
from recon_cli.sfm.job import PlaceJob
from recon_cli.sfm.mapping import process
from recon_cli.sfm.mapping.trusted_part import JOIN_PANORAMAS
from recon_cli.sfm.poses.align_world import find_places
from recon_cli.workspace import records as store
from recon_cli.workspace.records import POSES, FrameList, describe_stretches
from recon_cli.workspace.summaries import PlacedPart, PlaceSummary, SfmSummary


def run(config: SfmConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> PlaceSummary:
    """Writes sparse/, world.json and undistorted/{images,denoised,sparse} into `out`.

    Raises:
        SfmError: what tells the scale contradicts itself.
        ConfigError: the capture has no such part, or a place of --scale-between is unknown.
        FormatError: the folders of other stages do not hold what they promise.
    """
    ingest, denoise, mapped = (
        inputs.folders[name].resolve() for name in ("ingest", "denoise", "sfm"))
    frames = store.read_frame_list(ingest)
    found = SfmSummary.from_json(inputs.summaries["sfm"])
    _refuse_missing_part(config.part, found)
    job = PlaceJob(
        frames=ingest / store.FOLDER, denoised=denoise / store.FOLDER,
        masks=ingest / store.MASKS if any(frame.masked for frame in frames.frames) else None,
        models=mapped / "parts", out=out.resolve(),
        parts=tuple(part.names for part in found.parts),
        poses=ingest / POSES if found.poses else None,
        pose_use=found.poses.use if found.poses else "ignore", part=config.part,
        gravity=config.gravity == "auto", accept_weak=config.accept_weak, threads=ctx.threads,
        scale_between=find_places(frames, config.scale_between),
        held_out=tuple(sorted(frames.held_out)))
    store.refuse_missing_frames(job.frames, job.names, "ingest")
    store.refuse_missing_frames(job.denoised, job.names, "denoise")
    summary = _summary(frames, found, config.part, process.place_part(
        job, progress=ctx.progress, record=ctx.record))
    _report(summary, frames, ctx)
    return summary


def _refuse_missing_part(number: int, found: SfmSummary) -> None:
    """Raises ConfigError where the capture has no part of this number."""
    sizes = [len(part.names) for part in found.parts]
    if number <= len(sizes):
        return
    named = ", ".join(f"{number} of {size} frames" for number, size in enumerate(sizes, 1))
    raise ConfigError(
        f"part is {number}, but the capture has {len(sizes)}: {named}.",
        hint=Hint("sfm", f"--part {len(sizes)}", then=" or a smaller number" * (len(sizes) > 1)))


def _summary(
    frames: FrameList, found: SfmSummary, number: int, placed: PlacedPart
) -> PlaceSummary:
    part = found.parts[number - 1]
    unregistered = tuple(sorted({frame.name for frame in frames.frames} - set(part.names)))
    known = {item.name: getattr(record, item.name)
             for record in (found, placed) for item in fields(record)}
    return PlaceSummary(**{
        **known, "lines": (*found.broken[:1], *placed.lines, *found.notes)},
        registered=len(part.names), rejected=part.rejected, unregistered=unregistered,
        unregistered_held_out=tuple(name for name in unregistered if name in frames.held_out),
        part=number if len(found.parts) > 1 else None)


def _report(summary: PlaceSummary, frames: FrameList, ctx: StageContext) -> None:
    """Says which frames have no camera and which models are not used.

    How a sound model was found, and how sure that is, stands in the log and the report.
    """
    sound = summary.trusted is not False and not (summary.broken or summary.left_out)
    for sentence in (*_attempts(summary), *summary.lines):
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
    for sentence in (*_movement(summary), *summary.world.sentences):
        ctx.tell(sentence)


def _attempts(summary: PlaceSummary) -> Iterator[str]:
    """Yields a sentence for each mapper that was tried after the first."""
    for before, attempt in pairwise(summary.attempts):
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


def _movement(summary: PlaceSummary) -> Iterator[str]:
    """Yields a sentence on how far refining moved the given cameras."""
    poses = summary.poses
    if poses and poses.moved_median is not None:
        yield (f"Refining moved the cameras by {poses.moved_median:.2%} of the size of their "
               f"path (at most {poses.moved_max:.2%}) and turned them by "
               f"{poses.turned_median_deg:.2f} degrees (at most {poses.turned_max_deg:.2f}).")


def _describe_parts(summary: PlaceSummary, frames: FrameList) -> Iterator[str]:
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
    summary: PlaceSummary, frames: FrameList, *, named: bool
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
    return list_names(describe_stretches(frames.frames, names))
