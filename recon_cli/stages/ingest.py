"""ingest: from videos, photos or a capture with poses to upright 8-bit frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from recon_cli.capture import from_photos, from_video
from recon_cli.capture.images import PHOTO_SUFFIXES
from recon_cli.capture.ingested_source import IngestedSource, merge_sources
from recon_cli.capture.known_files import KNOWN_FILES, find_foreign, refuse_other_file
from recon_cli.capture.photo_tree import find_photo_files, find_videos
from recon_cli.capture.spherical_video import refuse_unusable
from recon_cli.config.stages import IngestConfig, parse_holdout
from recon_cli.context import StageContext, StageInputs
from recon_cli.datasets import from_data_set
from recon_cli.datasets.layouts import recognise, refuse_incomplete
from recon_cli.errors import InputError, format_count
from recon_cli.io.tracks import TRACKS
from recon_cli.sfm.limits import FEW_FRAMES
from recon_cli.workspace import records as store
from recon_cli.workspace.records import FrameList, Group
from recon_cli.workspace.summaries import IngestSummary

MIN_TRAINED = 2  # one view holds no depth


def run(config: IngestConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> IngestSummary:
    """Writes frames/*.png, frames.json, choice.json, contact.png and tracks into `out`.

    The sources are video files and folders of photos, recognised by content, or one data set with
    poses. Each gets its own intrinsics. Frames that are already in `out` are kept.

    Raises:
        InputError: a source is missing, unreadable, or holds too little.
    """
    for path in inputs.sources:
        if not path.exists():
            raise InputError(f"{path} does not exist.", hint="Check the path.")
    store.prepare_frames_folder(out)
    parts = _ingest(config, inputs.sources, out, ctx)
    source = merge_sources(parts)
    _refuse_mixed(source)
    held_out = _choose_held_out(source, config, ctx)
    _check_split(source, held_out, config, ctx)
    frames = tuple(replace(frame, held_out=frame.name in held_out) for frame in source.frames)
    for part in parts:
        if part.selection is not None:
            part.selection.write(out, held_out)
    if source.tracks is not None:
        source.tracks.write(out / TRACKS)
    FrameList(source.kind, source.groups, frames).write(out)
    poses = source.poses
    largest = max(source.groups, key=lambda group: group.width * group.height)
    return IngestSummary(
        kind=source.kind, declared_frames=source.declared, decoded_frames=source.decoded,
        lost_frames=source.lost, dropped_blurred=source.blurred, skipped=source.skipped,
        metric=None if poses is None else poses.metric,
        points=None if poses is None or poses.points is None else len(poses.points),
        frames=len(frames), held_out=sum(frame.held_out for frame in frames),
        groups=len(source.groups), width=largest.width, height=largest.height)


def _refuse_mixed(source: IngestedSource) -> None:
    """Raises InputError for panoramas together with pictures of ordinary lenses."""
    panoramas = [group.name for group in source.groups if _is_panorama(group)]
    others = [group.name for group in source.groups if not _is_panorama(group)]
    if panoramas and others:
        raise InputError(
            f"{panoramas[0]} holds 360-degree panoramas, but {others[0]} pictures of ordinary "
            "lenses; their cameras are not found together.",
            hint="Give one of both, or reconstruct each in a workspace of its own (-w).")


def _is_panorama(group: Group) -> bool:
    return group.lens is not None and group.lens.is_panorama


def _choose_held_out(
    source: IngestedSource, config: IngestConfig, ctx: StageContext
) -> frozenset[str]:
    """Returns the names of the held-out frames: the data set's choice, else ours."""
    if not source.splits:
        return store.choose_held_out(
            [frame.name for frame in source.frames], parse_holdout(config.holdout))
    held_out = frozenset(frame.name for frame in source.frames if frame.held_out)
    ctx.notice(f"The data set itself holds out {format_count(len(held_out), 'view')}; --holdout "
               "has no effect.")
    return held_out


def _check_split(
    source: IngestedSource, held_out: frozenset[str], config: IngestConfig, ctx: StageContext
) -> None:
    """Refuses a split that leaves too little to train on; reports options without effect."""
    left = len(source.frames) - len(held_out)
    if left < MIN_TRAINED:
        raise InputError(
            f"{len(held_out)} of {len(source.frames)} frames are held out, which leaves {left} to "
            f"train on, but at least {MIN_TRAINED} are needed.",
            hint="Hold out fewer, for example with --holdout every:8.")
    if not held_out and config.holdout != "none":
        ctx.notice(f"--holdout {config.holdout} holds out none of {left} frames, so that nothing "
                   "can be scored.")
    if config.frames is not None and source.kind == "photos" and source.tracks is None and (
            len(source.frames) > config.frames):
        ctx.notice("--frames has no effect on photos that are not frames of a video: all are used.")


def _ingest(
    config: IngestConfig, sources: Sequence[Path], out: Path, ctx: StageContext
) -> list[IngestedSource]:
    """Writes the frames of every source; where there are several, numbers prefix their names."""
    layouts = {path: layout for path in sources if (layout := recognise(path))}
    if layouts:
        return [from_data_set.ingest(config, _only_data_set(sources, layouts), out, ctx)]
    for path in sources:
        refuse_incomplete(path)
        if not _is_photos(path):
            refuse_other_file(path)
    parts = _parts([_find_only_video(path, out, ctx) for path in sources])
    prefixes = ["" if len(parts) == 1 else f"{index + 1:02d}_" for index in range(len(parts))]
    videos = [(part[0], prefix) for part, prefix in zip(parts, prefixes, strict=True)
              if not _is_photos(part[0])]
    for path, _ in videos:
        _tell_foreign(path, ctx)
        refuse_unusable(path, config.camera)
    scans = [from_video.load_or_scan(config, path, out / f"{prefix}{from_video.SCAN}", ctx)
             for path, prefix in videos]
    numbers = from_video.frame_counts(config, scans)
    _tell_many(config, sum(numbers), ctx)
    counts = dict(zip(
        (prefix for _, prefix in videos), zip(scans, numbers, strict=True), strict=True))
    ingested = []
    for part, prefix in zip(parts, prefixes, strict=True):
        if prefix in counts:
            video, count = counts[prefix]
            ingested.append(from_video.ingest(config, video, count, out, ctx, prefix=prefix))
        else:
            ingested.append(from_photos.ingest(config, part, out, ctx, prefix=prefix))
    return ingested


def _find_only_video(path: Path, out: Path, ctx: StageContext) -> Path:
    """Returns the one video in a folder without enough photos; any other path as it is."""
    videos = find_videos(path, out) if path.is_dir() else []
    if len(videos) != 1 or len(find_photo_files(path, out).files) >= store.MIN_FRAMES:
        return path
    ctx.notice(f"{path} holds one video and no photos of a scene: {videos[0].name} is used.")
    return videos[0]


def _tell_many(config: IngestConfig, frames: int, ctx: StageContext) -> None:
    """Says how many frames a long video gets; sfm tells how long their cameras take to find."""
    if frames > FEW_FRAMES:
        way = "" if config.frames else " for the way of the camera"
        ctx.notice(f"{frames:,} frames are chosen{way}; --max-frames limits their number.")


def _tell_foreign(video: Path, ctx: StageContext) -> None:
    """Says which poses and depth an app has left beside its video."""
    if any(row.video == video.name for row in KNOWN_FILES):
        for found in find_foreign(video.absolute().parent):
            if found.row.video == video.name:
                ctx.notice(found.notice(video))


def _parts(sources: Sequence[Path]) -> list[list[Path]]:
    """Returns the sources one by one, but all photo files together in place of the first."""
    files = [path for path in dict.fromkeys(sources) if not path.is_dir() and _is_photos(path)]
    parts = [files if path in files else [path] for path in sources]
    return [part for index, part in enumerate(parts) if part not in parts[:index]]


def _is_photos(path: Path) -> bool:
    return path.is_dir() or path.suffix.lower() in PHOTO_SUFFIXES


def _only_data_set(sources: Sequence[Path], layouts: Mapping[Path, str]) -> Path:
    """Returns the one data set, whose poses have no common world with other sources."""
    path, layout = next(iter(layouts.items()))
    if len(sources) > 1:
        raise InputError(
            f"{path} is a data set with poses ({layout}), but {len(sources)} inputs were given.",
            hint="Give only the data set, or the folder of its images as photos without poses.")
    return path
