"""Frames of a video: one pass scans it, a second one writes the chosen frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture import frame_selection
from recon_cli.capture.contact_sheet import ContactSheet
from recon_cli.capture.frame_measures import check_exposure, well_exposed
from recon_cli.capture.ingested_source import IngestContext, IngestedSource, Selection
from recon_cli.capture.lens_border import hide_border
from recon_cli.capture.masks import write_mask
from recon_cli.capture.panorama_masks import hide_carried
from recon_cli.capture.panorama_motion import measure_parallax
from recon_cli.capture.repeats import find_stills, pick_representatives
from recon_cli.capture.scan import Scan, decode_threads, measure_scene, scan_video
from recon_cli.capture.spherical_video import is_spherical
from recon_cli.capture.static_overlay import MOST, PICTURE, draw_overlay, mask_overlay
from recon_cli.capture.video import frames_at, read_declared_length
from recon_cli.config.stages import IngestConfig
from recon_cli.errors import InputError
from recon_cli.io.images import fit_image, fit_size, write_png
from recon_cli.scene.camera import panorama_lens
from recon_cli.scene.statistics import at_least
from recon_cli.workspace import records as store
from recon_cli.workspace.records import Frame, Group

SCAN = "scan.json"  # a scan for the next run; the prefix of the video's frames comes before it
# A count by the duration may be off by so many frames, or this share of all, without any loss.
INEXACT_COUNT = (10, 0.02)


@dataclass(frozen=True, eq=False)
class ScannedVideo:
    """A video after the first pass."""

    path: Path
    scan: Scan
    lengths: NDArray[np.float64]  # [F], `path_length` up to each frame
    judgement: frame_selection.Judgement
    standing: NDArray[np.int64]  # [F], the frame that stands for the picture of each
    panoramas: bool = False  # its frames are equirectangular

    @property
    def distinct(self) -> NDArray[np.bool_]:  # [F]
        """Which usable frames may be chosen: one of each picture."""
        itself = self.standing == np.arange(len(self.standing))
        return np.asarray(self.judgement.usable & itself)


def load_or_scan(
    config: IngestConfig, path: Path, scan_file: Path, ctx: IngestContext
) -> ScannedVideo:
    """Returns a video after a pass over all of its frames; `scan_file` keeps it for a next run.

    InputError if it is not a video, has too few undamaged frames, or shows nothing or no motion.
    """
    if scan_file.exists():
        scan = Scan.read(scan_file)
    else:
        scan = _scan(config, path, ctx)
        scan.write(scan_file)
    if scan.overlay is not None:
        picture = scan_file.name.replace(SCAN, PICTURE)
        ctx.notice(
            f"An overlay (text, a logo, dirt on the lens) stays in place in {path.name}: "
            f"{float(scan.overlay.mean()):.1%} of the picture is masked in all frames; "
            f"{picture} in the folder of ingest shows where. --overlays keep leaves it in.")
    for notice in scan.notices:
        ctx.notice(notice)
    _report_lost(path, scan, ctx)
    if not is_spherical(
            path, scan.width, scan.height, len(scan.intact), config.camera, size=scan.size):
        return judge(config, path, scan, ctx)
    ctx.notice(f"{path.name} is used as a 360-degree video (equirectangular); --camera perspective "
               "uses it as an ordinary one.")
    scan = replace(scan, motion=measure_parallax(scan.tracks))
    return replace(judge(config, path, scan, ctx), panoramas=True)


def judge(
    config: IngestConfig, path: Path, scan: Scan, ctx: IngestContext, *, least: int = 0
) -> ScannedVideo:
    """Judges the frames of a scan; InputError if they show nothing, or no motion.

    Where fewer than `least` are sharp, the sharpest of the others may be chosen, too.
    """
    check_exposure(path.name, scan.exposure[scan.intact], least=store.MIN_FRAMES)
    intact = int(scan.intact.sum())
    clipped = intact - int(well_exposed(scan.exposure[scan.intact]).sum())
    if 2 * clipped > intact:  # the rest cannot replace what they showed
        ctx.notice(
            f"{clipped} of {intact} frames of {path.name} are left out: they are mostly black or "
            "blown out.")
    warning = frame_selection.check_motion(path.name, scan.motion)
    if warning:
        ctx.notice(warning)
    lengths = frame_selection.path_length(scan.motion)
    judgement = frame_selection.judge_frames(
        lengths, scan.sharpness, scan.exposure, scan.intact, config.sharpness, least)
    tracks = scan.tracks if scan.overlay is None else scan.tracks.outside(scan.overlay)
    return ScannedVideo(path, scan, lengths, judgement, pick_representatives(
        find_stills(tracks, scan.width, scan.height), scan.sharpness, judgement.usable,
        judgement.bridges))


def _scan(config: IngestConfig, path: Path, ctx: IngestContext) -> Scan:
    """Returns the scan of a video; an overlay that is to be masked is left out of it."""
    claim = read_declared_length(path)
    with ctx.progress.bar("scan", claim.count(claim.rate), unit="frame") as bar:
        scan = scan_video(path, threads=ctx.threads, step=bar.advance)
    if config.overlays == "keep" or scan.overlay is None:
        return replace(scan, overlay=None)
    share = float(scan.overlay.mean())
    if share > MOST:
        return replace(scan, overlay=None, notices=(
            *scan.notices,
            f"{share:.0%} of the picture of {path.name} stays where it is while the rest moves; an "
            "overlay covers less, so that nothing is masked."))
    with ctx.progress.bar("scan without overlay", len(scan.intact), unit="frame") as bar:
        return measure_scene(path, scan, threads=ctx.threads, step=bar.advance)


def frame_counts(config: IngestConfig, sources: Sequence[ScannedVideo]) -> list[int]:
    """Returns how many frames to choose from each video, at least `MIN_FRAMES`.

    --frames, or the number that the motion needs up to --max-frames, is divided by the lengths
    of the paths.
    """
    wanted = [frame_selection.automatic_count(source.lengths, most=config.max_frames)
              for source in sources]
    total = config.frames or min(config.max_frames, sum(wanted))
    if len(sources) <= 1:
        return [total] * len(sources)
    sums = np.cumsum([source.lengths[-1] for source in sources])
    cuts = np.round(sums / sums[-1] * total).astype(int)
    return [max(store.MIN_FRAMES, int(count)) for count in np.diff(cuts, prepend=0)]


def ingest(
    config: IngestConfig, source: ScannedVideo, count: int, out: Path, ctx: IngestContext, *,
    prefix: str = "",
) -> IngestedSource:
    """Writes `count` frames of a video into ingest's folder `out` and returns them.

    Frames already in `out` are kept; `prefix` is that of their names. InputError if too few frames
    are sharp, or the file has changed.
    """
    path, scan, judgement = source.path, source.scan, source.judgement
    chosen = frame_selection.choose_frames(
        source.lengths, scan.sharpness, source.distinct, count, bridges=judgement.bridges)
    report_short(source, len(chosen), None if config.frames is None else count, ctx)
    longest = config.max_size * (2 if source.panoramas else 1)
    report_reduced(scan.width, scan.height, longest, ctx)
    names = {int(index): f"{prefix}{index:06d}.png" for index in chosen}
    record = frame_selection.video_candidates(
        path.name, scan.sharpness, judgement.refused, source.lengths, names,
        standing=source.standing)
    sheet = ContactSheet(path.name, record, scan.width, scan.height)
    _write(source, names, sheet, longest, out, ctx)
    width, height = fit_size(scan.width, scan.height, longest)
    tracks = scan.tracks
    if scan.overlay is not None:
        tracks = tracks.outside(scan.overlay)
        mask = mask_overlay(scan.overlay, width, height)
        for name in names.values():
            write_mask(out / store.MASKS / name, mask)
        middle = list(names.values())[len(names) // 2]
        draw_overlay(out / store.FOLDER / middle, mask, out / f"{prefix}{PICTURE}")
    border = None
    if source.panoramas:
        hide_carried(out, list(names.values()), ctx)
    elif config.overlays == "mask":
        border = hide_border(out, list(names.values()), ctx)
        tracks = tracks if border is None else tracks.outside(border)
    frames = tuple(
        Frame(name, scan.seconds[index], path.name, float(scan.sharpness[index]), held_out=False,
              masked=scan.overlay is not None or source.panoramas or border is not None)
        for index, name in names.items())
    # Tracks through panoramas are not used: their features match as far apart as they stand.
    return IngestedSource(
        "video", (Group(path.name, width, height, lens=(
            panorama_lens(width, height) if source.panoramas else None)),), frames,
        declared=scan.declared, decoded=int(scan.intact.sum()), lost=scan.lost,
        blurred=int((scan.intact & ~judgement.usable).sum()),
        selection=Selection(record, sheet, prefix),
        tracks=None if source.panoramas else tracks.select(names))


def _report_lost(path: Path, scan: Scan, ctx: IngestContext) -> None:
    """Says how many frames are missing or damaged; refuses a video that has too few left."""
    decoded, intact = len(scan.intact), int(scan.intact.sum())
    if intact < store.MIN_FRAMES:
        raise InputError(
            f"{path} has {intact} undamaged frames of {scan.expected}, but at least "
            f"{store.MIN_FRAMES} are needed.",
            hint="Give a longer video, or copy it from the camera again if it should be longer.")
    inexact = at_least(INEXACT_COUNT, scan.declared)
    if intact < decoded or scan.gaps or scan.lost > inexact:
        ctx.notice(
            f"{path.name} is damaged or cut off: {scan.lost} of {scan.expected} frames are lost, "
            f"{intact} can be used.")
    elif 0 < scan.declared < decoded - inexact:
        ctx.notice(f"{path.name} declares {scan.declared} frames but holds {decoded}.")


def report_short(
    source: ScannedVideo, chosen: int, requested: int | None, ctx: IngestContext
) -> None:
    """Says why fewer frames were chosen than requested; refuses too few."""
    intact, usable, distinct = (
        int(flags.sum())
        for flags in (source.scan.intact, source.judgement.usable, source.distinct))
    if usable < store.MIN_FRAMES:
        raise InputError(
            f"Only {usable} of {intact} frames are sharp, but at least "
            f"{store.MIN_FRAMES} are needed.",
            hint="Lower --sharpness, or record again with slower movements.")
    if distinct < store.MIN_FRAMES:
        raise InputError(
            f"{source.path} shows {distinct} different picture{'s' * (distinct != 1)} in {usable} "
            f"frames, but at least {store.MIN_FRAMES} are needed.",
            hint="Record again while you walk sideways through the room.")
    if requested is None or chosen == requested:
        return
    if intact < requested:
        ctx.notice(f"{requested} frames were requested, but {source.path.name} has {intact}.")
    if distinct < usable:
        ctx.notice(
            f"Only {distinct} of {usable} frames show different pictures, and all of those are "
            "used; the others repeat one of them.")
    if usable < intact:
        used = ", and all of them are used" if distinct == usable else ""
        ctx.notice(
            f"Only {usable} of {intact} frames are sharp enough{used}; --sharpness 0 uses blurred "
            "ones too.")


def report_reduced(width: int, height: int, max_size: int, ctx: IngestContext) -> None:
    """Says that frames are stored at a reduced size."""
    if max(height, width) > max_size:
        ctx.notice(
            f"Frames of {width}x{height} are reduced to {max_size} pixels on the longer side; "
            "--max-size changes that.")


def _write(
    source: ScannedVideo, names: dict[int, str], sheet: ContactSheet, max_size: int, out: Path,
    ctx: IngestContext,
) -> None:
    """Writes the frames that are not there yet, and adds the thumbnails to the contact sheet."""
    folder = out / store.FOLDER
    missing = {index for index, name in names.items() if not (folder / name).exists()}
    done = len(names) - len(missing)
    threads = decode_threads(source.scan, ctx.threads)
    with (ctx.progress.bar("frames", len(names), unit="frame", done=done) as bar,
          ThreadPoolExecutor(ctx.threads) as pool):
        writing: deque[Future[None]] = deque()

        def wait(most: int) -> None:
            """Returns when at most so many frames are still being written."""
            nonlocal done
            while len(writing) > most:
                writing.popleft().result()
                done += 1
                bar.advance()
                ctx.record(done, len(names))

        for index, rgb in frames_at(
                source.path, missing | sheet.wanted, threads=threads, size=source.scan.size):
            sheet.add(index, rgb)
            if index in missing:
                writing.append(pool.submit(_store, folder / names[index], rgb, max_size))
                wait(most=ctx.threads)
        wait(most=0)


def _store(file: Path, rgb: NDArray[np.uint8], max_size: int) -> None:
    write_png(file, fit_image(rgb, max_size))
