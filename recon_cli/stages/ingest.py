"""ingest: from a video or a folder of photos to upright 8-bit frames, and which are held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli import atomic
from recon_cli.capture import frames as store
from recon_cli.capture.choose import (
    automatic_count,
    bridged,
    choose_frames,
    sharp_frames,
    travelled,
)
from recon_cli.capture.frames import Frame, FrameList
from recon_cli.capture.images import Photo, read_photo
from recon_cli.capture.pace import paced
from recon_cli.capture.photos import (
    MIN_FRAMES,
    Folder,
    check_count,
    check_sizes,
    frame_names,
    list_photos,
    shared_focal,
)
from recon_cli.capture.scan import Scan, decode_threads, scan_video
from recon_cli.capture.video import claimed_length, frames_at
from recon_cli.config import IngestConfig, parse_holdout
from recon_cli.errors import InputError
from recon_cli.stages.context import StageContext, StageInputs, Summary

SCAN = "scan.json"  # what the first pass over a video found, for the next try and for the curious
# A count that was made from the duration is off by this much, as a share or in frames (sound that
# ends a little later), without anything being lost.
COUNT_SHARE, COUNT_FRAMES = 0.02, 10


@dataclass(frozen=True)
class _Capture:
    """What either kind of capture comes down to."""

    kind: str
    frames: Sequence[Frame]
    focal_px: float | None
    summary: Summary


def run(config: IngestConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Writes frames/*.png and frames.json into `out` and returns what was taken and what lost.

    Args:
        config: see `IngestConfig`.
        inputs: one source, a video file or a folder of photos, told apart by content.
        out: the stage's partial folder; frames already in it are kept.
        ctx: for notices and progress.

    Returns:
        kind, declared_frames (0 where unknown), decoded_frames (whole ones), lost_frames,
        dropped_blurred, skipped (file names), frames, held_out, width, height.

    Raises:
        InputError: the source is missing, unreadable, of mixed sizes, or holds too little.
    """
    source = _one_source(inputs.sources)
    store.prepare(out)
    take = _take_photos if source.is_dir() else _take_video
    capture = take(config, source, out, ctx)
    height, width = store.read_png(out / store.FOLDER / capture.frames[0].name).shape[:2]
    FrameList(capture.kind, width, height, capture.focal_px, tuple(capture.frames)).write(out)
    return {
        "kind": capture.kind,
        **capture.summary,
        "frames": len(capture.frames),
        "held_out": sum(frame.held_out for frame in capture.frames),
        "width": width,
        "height": height,
    }


def _one_source(sources: Sequence[Path]) -> Path:
    if len(sources) != 1:
        raise InputError(
            f"{len(sources)} sources were given, but one is taken for now.",
            hint="Give one video, or put all photos into one folder.")
    if not sources[0].exists():
        raise InputError(f"{sources[0]} does not exist.", hint="Check the path.")
    return sources[0]


def _take_video(config: IngestConfig, path: Path, out: Path, ctx: StageContext) -> _Capture:
    scan = _scanned(path, out, ctx)
    for notice in scan.notices:
        ctx.notice(notice)
    _report_lost(path, scan, ctx)
    way = travelled(scan.motion)
    sharp = sharp_frames(scan.sharpness, config.sharpness)
    usable = bridged(way, scan.sharpness, sharp, scan.whole)
    count = config.frames or automatic_count(way, most=config.max_frames)
    chosen = choose_frames(way, scan.sharpness, usable, count)
    _report_short(config, scan, len(chosen), ctx)
    _report_reduced(scan.width, scan.height, config.max_size, ctx)
    names = {int(index): f"{index:06d}.png" for index in chosen}
    _write_video(path, names, decode_threads(scan, ctx.threads), config.max_size, out, ctx)
    held = store.held_out(list(names.values()), parse_holdout(config.holdout))
    frames = [
        Frame(name, scan.seconds[index], path.name, float(scan.sharpness[index]), name in held)
        for index, name in names.items()
    ]
    return _Capture("video", frames, None, {
        "declared_frames": scan.declared,
        "decoded_frames": int(scan.whole.sum()),
        "lost_frames": scan.lost,
        "dropped_blurred": int((scan.whole & ~usable).sum()),
        "skipped": [],
    })


def _scanned(path: Path, out: Path, ctx: StageContext) -> Scan:
    """Returns the scan of a video, from an earlier try where there was one."""
    if (out / SCAN).exists():
        return Scan.from_json(atomic.read_json(out / SCAN))
    claim = claimed_length(path)
    with ctx.progress.bar("scan", claim.count(claim.rate), unit="frame") as bar:
        scan = scan_video(path, threads=ctx.threads, step=bar.advance)
    atomic.write_json(out / SCAN, scan.to_json())
    return scan


def _report_lost(path: Path, scan: Scan, ctx: StageContext) -> None:
    """Says how many frames are missing or damaged; refuses a video that has too few left."""
    decoded, whole = len(scan.whole), int(scan.whole.sum())
    if whole < MIN_FRAMES:
        raise InputError(
            f"{path} gives {whole} whole frames of {scan.expected}, but at least {MIN_FRAMES} are "
            "needed.",
            hint="Give a longer video, or copy it from the camera again if it should be longer.")
    inexact = max(COUNT_SHARE * scan.declared, COUNT_FRAMES)
    if whole < decoded or scan.gaps or scan.lost > inexact:
        ctx.notice(
            f"{path.name} is damaged or cut off: {scan.lost} of {scan.expected} frames are lost, "
            f"{whole} can be used.")
    elif 0 < scan.declared < decoded - inexact:
        ctx.notice(f"{path.name} declares {scan.declared} frames but holds {decoded}.")


def _report_short(config: IngestConfig, scan: Scan, chosen: int, ctx: StageContext) -> None:
    """Says why fewer frames were chosen than asked for; refuses too few."""
    whole = int(scan.whole.sum())
    if chosen < MIN_FRAMES:
        raise InputError(
            f"Only {chosen} of {whole} frames are sharp, but at least {MIN_FRAMES} are needed.",
            hint="Lower --sharpness, or record again with slower movements.")
    if config.frames is None or chosen == config.frames:
        return
    if whole < config.frames:
        ctx.notice(f"{config.frames} frames were asked for, but the video has {whole}.")
    if chosen < whole:
        ctx.notice(
            f"{chosen} of {whole} frames are sharp enough and all of them are taken; "
            "--sharpness 0 takes blurred ones too.")


def _write_video(
    path: Path, names: dict[int, str], threads: int, max_size: int, out: Path, ctx: StageContext
) -> None:
    folder = out / store.FOLDER
    missing = [index for index, name in names.items() if not (folder / name).exists()]
    done, record = len(names) - len(missing), paced(ctx.record)
    with ctx.progress.bar("frames", len(names), unit="frame", done=done) as bar:
        for index, rgb in frames_at(path, missing, threads=threads):
            store.write_png(folder / names[index], store.fitted(rgb, max_size))
            done += 1
            bar.advance()
            record(done, len(names))


def _report_reduced(width: int, height: int, max_size: int, ctx: StageContext) -> None:
    if max(height, width) > max_size:
        ctx.notice(
            f"Frames of {width}x{height} are reduced to {max_size} pixels on the longer side; "
            "--max-size changes that.")


def _take_photos(config: IngestConfig, path: Path, out: Path, ctx: StageContext) -> _Capture:
    folder = list_photos(path)
    check_count(path, len(folder.photos), folder.broken)
    check_sizes(folder.photos)
    first = folder.photos[0]
    _report_reduced(first.width, first.height, config.max_size, ctx)
    names = frame_names(folder.photos)
    broken = folder.broken | _write_photos(folder.photos, names, config.max_size, out, ctx)
    for reason in broken.values():
        ctx.notice(f"A photo is left out: {reason}")
    taken = [
        (name, photo) for name, photo in zip(names, folder.photos, strict=True)
        if photo.path.name not in broken
    ]
    check_count(path, len(taken), broken)
    held = store.held_out([name for name, _ in taken], parse_holdout(config.holdout))
    frames = [Frame(name, None, photo.path.name, None, name in held) for name, photo in taken]
    return _Capture("photos", frames, _stored_focal(folder, config), {
        "declared_frames": len(taken) + len(broken),
        "decoded_frames": len(taken),
        "lost_frames": len(broken),
        "dropped_blurred": 0,
        "skipped": sorted(broken),
    })


def _write_photos(
    photos: Sequence[Photo], names: Sequence[str], max_size: int, out: Path, ctx: StageContext
) -> dict[str, str]:
    """Writes the photos and returns why some could not be read after all, by file name."""
    broken: dict[str, str] = {}
    record = paced(ctx.record)
    with ctx.progress.bar("photos", len(photos), unit="photo") as bar:
        for done, (photo, name) in enumerate(zip(photos, names, strict=True), start=1):
            target = out / store.FOLDER / name
            if not target.exists():
                try:
                    rgb = read_photo(photo)
                except InputError as error:
                    broken[photo.path.name] = error.message
                else:
                    store.write_png(target, store.fitted(rgb, max_size))
            bar.advance()
            record(done, len(photos))
    return broken


def _stored_focal(folder: Folder, config: IngestConfig) -> float | None:
    """Returns the focal length at the size at which the photos are stored."""
    focal = shared_focal(folder.photos)
    if focal is None:
        return None
    first = folder.photos[0]
    return focal * min(1.0, config.max_size / max(first.width, first.height))
