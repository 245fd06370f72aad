"""ingest: from videos, photos or a data set with poses to upright 8-bit frames.

Which frames are held out is frozen here, before anything is estimated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from recon_cli.capture import frames as store
from recon_cli.capture import from_photos, from_video
from recon_cli.capture.frames import FrameList
from recon_cli.capture.taken import Taken, joined
from recon_cli.config import IngestConfig, parse_holdout
from recon_cli.errors import InputError
from recon_cli.stages.context import StageContext, StageInputs, Summary


def run(config: IngestConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Writes frames/*.png and frames.json into `out` and returns what was taken and what lost.

    Args:
        config: see `IngestConfig`.
        inputs: the sources: video files and folders of photos, told apart by content. The frames
            of each get intrinsics of their own.
        out: the stage's partial folder; frames already in it are kept.
        ctx: for notices and progress.

    Returns:
        kind, declared_frames (0 where unknown), decoded_frames (whole ones), lost_frames,
        dropped_blurred, skipped (file names), frames, held_out, groups, width, height (of the
        largest group).

    Raises:
        InputError: a source is missing, unreadable, or holds too little.
    """
    for source in inputs.sources:
        if not source.exists():
            raise InputError(f"{source} does not exist.", hint="Check the path.")
    store.prepare(out)
    taken = joined(_take(config, inputs.sources, out, ctx))
    held = store.held_out([frame.name for frame in taken.frames], parse_holdout(config.holdout))
    frames = tuple(replace(frame, held_out=frame.name in held) for frame in taken.frames)
    FrameList(taken.kind, taken.groups, frames).write(out)
    largest = max(taken.groups, key=lambda group: group.width * group.height)
    return {
        "kind": taken.kind,
        "declared_frames": taken.declared,
        "decoded_frames": taken.decoded,
        "lost_frames": taken.lost,
        "dropped_blurred": taken.blurred,
        "skipped": list(taken.skipped),
        **(taken.details or {}),
        "frames": len(frames),
        "held_out": sum(frame.held_out for frame in frames),
        "groups": len(taken.groups),
        "width": largest.width,
        "height": largest.height,
    }


def _take(
    config: IngestConfig, sources: Sequence[Path], out: Path, ctx: StageContext
) -> list[Taken]:
    """Writes the frames of every source; the names of several are told apart by a number."""
    prefixes = ["" if len(sources) == 1 else f"{index + 1:02d}_" for index in range(len(sources))]
    videos = [(path, prefix) for path, prefix in zip(sources, prefixes, strict=True)
              if not path.is_dir()]
    looks = [
        from_video.look_at(config, path, out / f"{prefix}scan.json", ctx)
        for path, prefix in videos]
    counts = dict(zip(
        (prefix for _, prefix in videos),
        zip(looks, from_video.shares(config, looks), strict=True), strict=True))
    taken = []
    for path, prefix in zip(sources, prefixes, strict=True):
        if prefix in counts:
            look, count = counts[prefix]
            taken.append(from_video.take(config, look, count, out, ctx, prefix=prefix))
        else:
            taken.append(from_photos.take(config, path, out, ctx, prefix=prefix))
    return taken
