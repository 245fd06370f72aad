"""ingest: from videos, photos or a data set with poses to upright 8-bit frames.

Which frames are held out is frozen here, before anything is estimated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from recon_cli.capture import from_data_set, from_photos, from_video
from recon_cli.capture.images import PHOTO_SUFFIXES
from recon_cli.capture.ingested_source import Taken, joined
from recon_cli.config.stages import IngestConfig, parse_holdout
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import InputError
from recon_cli.io import frames as store
from recon_cli.io.frames import FrameList
from recon_cli.io.layouts import recognise, refuse_incomplete
from recon_cli.workspace.summaries import IngestSummary

MIN_TRAINED = 2  # one view holds no depth


def run(config: IngestConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> IngestSummary:
    """Writes frames/*.png and frames.json into `out` and returns what was taken and what lost.

    choice.json and contact.png tell what was kept and what was dropped of each source.

    Args:
        config: see `IngestConfig`.
        inputs: the sources: video files and folders of photos, told apart by content, or one data
            set with poses, told by its layout. The frames of each get intrinsics of their own.
        out: the stage's partial folder; frames already in it are kept.
        ctx: for notices and progress.

    Raises:
        InputError: a source is missing, unreadable, or holds too little.
    """
    for source in inputs.sources:
        if not source.exists():
            raise InputError(f"{source} does not exist.", hint="Check the path.")
    store.prepare(out)
    parts = _take(config, inputs.sources, out, ctx)
    taken = joined(parts)
    held = _held_out(taken, config, ctx)
    _check_split(taken, held, config, ctx)
    frames = tuple(replace(frame, held_out=frame.name in held) for frame in taken.frames)
    for part in parts:
        if part.choice is not None:
            part.choice.write(out, held)
    FrameList(taken.kind, taken.groups, frames).write(out)
    poses = taken.poses
    largest = max(taken.groups, key=lambda group: group.width * group.height)
    return IngestSummary(
        kind=taken.kind,
        declared_frames=taken.declared,
        decoded_frames=taken.decoded,
        lost_frames=taken.lost,
        dropped_blurred=taken.blurred,
        skipped=taken.skipped,
        metric=None if poses is None else poses.metric,
        points=None if poses is None or poses.points is None else len(poses.points),
        frames=len(frames),
        held_out=sum(frame.held_out for frame in frames),
        groups=len(taken.groups),
        width=largest.width,
        height=largest.height,
    )


def _held_out(taken: Taken, config: IngestConfig, ctx: StageContext) -> frozenset[str]:
    """Returns the names of the frames kept for the score: the data set's choice, else ours."""
    if not taken.splits:
        return store.held_out(
            [frame.name for frame in taken.frames], parse_holdout(config.holdout))
    held = frozenset(frame.name for frame in taken.frames if frame.held_out)
    ctx.notice(f"The data set itself holds out {len(held)} views; --holdout has no effect.")
    return held


def _check_split(
    taken: Taken, held: frozenset[str], config: IngestConfig, ctx: StageContext
) -> None:
    """Refuses a split that leaves too little to train on; says that options had no effect."""
    left = len(taken.frames) - len(held)
    if left < MIN_TRAINED:
        raise InputError(
            f"{len(held)} of {len(taken.frames)} frames are held out, which leaves {left} to train "
            f"on, but at least {MIN_TRAINED} are needed.",
            hint="Hold out fewer, for example with --holdout every:8.")
    if not held and config.holdout != "none":
        ctx.notice(f"--holdout {config.holdout} holds out none of {left} frames: no score.")
    if config.frames is not None and taken.kind == "photos":
        ctx.notice("--frames has no effect on photos: all are taken.")


def _take(
    config: IngestConfig, sources: Sequence[Path], out: Path, ctx: StageContext
) -> list[Taken]:
    """Writes the frames of every source; the names of several are told apart by a number."""
    layouts = {path: layout for path in sources if (layout := recognise(path))}
    if layouts:
        return [from_data_set.take(config, _alone(sources, layouts), out, ctx)]
    for path in sources:
        refuse_incomplete(path)
    parts = _parts(sources)
    prefixes = ["" if len(parts) == 1 else f"{index + 1:02d}_" for index in range(len(parts))]
    videos = [(part[0], prefix) for part, prefix in zip(parts, prefixes, strict=True)
              if not _of_photos(part[0])]
    looks = [
        from_video.look_at(config, path, out / f"{prefix}scan.json", ctx)
        for path, prefix in videos]
    counts = dict(zip(
        (prefix for _, prefix in videos),
        zip(looks, from_video.shares(config, looks), strict=True), strict=True))
    taken = []
    for part, prefix in zip(parts, prefixes, strict=True):
        if prefix in counts:
            look, count = counts[prefix]
            taken.append(from_video.take(config, look, count, out, ctx, prefix=prefix))
        else:
            taken.append(from_photos.take(config, part, out, ctx, prefix=prefix))
    return taken


def _parts(sources: Sequence[Path]) -> list[list[Path]]:
    """Returns the sources one by one, but files that are photos together in place of the first."""
    files = [path for path in dict.fromkeys(sources) if not path.is_dir() and _of_photos(path)]
    parts = [files if path in files else [path] for path in sources]
    return [part for index, part in enumerate(parts) if part not in parts[:index]]


def _of_photos(path: Path) -> bool:
    return path.is_dir() or path.suffix.lower() in PHOTO_SUFFIXES


def _alone(sources: Sequence[Path], layouts: Mapping[Path, str]) -> Path:
    """Returns the one data set, for its poses have no common world with anything else."""
    path, layout = next(iter(layouts.items()))
    if len(sources) > 1:
        raise InputError(
            f"{path} is a data set with poses ({layout}), but {len(sources)} inputs were given.",
            hint="Give it alone, or give the folder of its images for photos without poses.")
    return path
