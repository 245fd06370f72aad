"""Frames of photos: all that can be read and show a view of their own.

Photos that follow each other are chosen like the frames of a video, by `photo_sequence`, and get
tracks; those that share nothing with the others are set aside.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture import frame_selection
from recon_cli.capture.contact_sheet import ContactSheet
from recon_cli.capture.dng_corrections import describe_corrections, read_corrections
from recon_cli.capture.frame_selection import FrameCandidate, Reason
from recon_cli.capture.from_video import SCAN, judge, report_reduced, report_short
from recon_cli.capture.images import Photo, choose_white, read_photo
from recon_cli.capture.ingested_source import IngestContext, IngestedSource, Selection
from recon_cli.capture.known_files import find_foreign, find_lists
from recon_cli.capture.lens_border import hide_border
from recon_cli.capture.masks import (
    FolderMasks,
    find_masks,
    mask_folders,
    photo_mask,
    write_mask,
)
from recon_cli.capture.panorama_masks import hide_carried
from recon_cli.capture.panoramas import fill_sphere
from recon_cli.capture.photo_sequence import (
    PhotoSequence,
    find_odd,
    find_sequence,
    is_dense,
)
from recon_cli.capture.photo_tree import find_photo_files
from recon_cli.capture.photos import (
    PhotoFolder,
    PhotoGroup,
    check_count,
    choose_pictures,
    group_notices,
    group_photos,
    list_photos,
    make_frame_names,
)
from recon_cli.capture.raw import RawPlan, develop, plan_raw
from recon_cli.capture.same_view import PhotoMeasures, measure_photo
from recon_cli.config.stages import IngestConfig
from recon_cli.errors import MOST_NAMED, FormatError, InputError, ManifestError, list_names
from recon_cli.io.images import fit_image, fit_size, read_png, write_png
from recon_cli.io.tracks import Tracks
from recon_cli.scene.camera import panorama_lens
from recon_cli.scene.matches import EXHAUSTIVE_MAX
from recon_cli.workspace import atomic
from recon_cli.workspace import records as store
from recon_cli.workspace.records import Frame, Group

PLAN = "raw.json"  # how camera RAW was developed, for the next run and for inspection
Record = tuple[FrameCandidate, ...]  # what became of every photo, in order


def ingest(
    config: IngestConfig, paths: Sequence[Path], out: Path, ctx: IngestContext, *, prefix: str = ""
) -> IngestedSource:
    """Writes photos into ingest's folder `out` and returns them.

    `paths` are photos, or a folder with photos in it or in a subfolder. Frames already in `out` are
    kept; `prefix` is that of their names. InputError if too few photos can be read or show a view
    of their own, or a mask is broken.
    """
    path, home, folder = _list_photos(paths, out, config.camera, ctx)
    check_count(path, folder.photos, folder.broken)
    plan = _plan_raw(folder.photos, out / f"{prefix}{PLAN}", ctx)
    photos = _drop_raw_twins(folder.photos, plan, ctx)
    white = choose_white([photo.path for photo in photos if photo.wide], ctx.notice)
    for coding, count in Counter(photo.coding for photo in photos if photo.coding).items():
        ctx.notice(f"{count} {'photos are' if count > 1 else 'photo is'} {coding.words}: "
                   "converted to sRGB as video is.")
    sequence, strangers = None, list[str]()
    if not folder.panoramas:
        photos, sequence, strangers = _find_sequence(
            photos, out / f"{prefix}{SCAN}", ctx, white=white)
    masks = _find_masks(paths, home, photos, ctx)
    stems = make_frame_names([photo.path.stem for photo in photos])
    source = _PhotoSource(path, tuple(photos), tuple(f"{prefix}{stem}" for stem in stems),
                          masks.by_photo, plan, folder.broken, white, folder.panoramas)
    taken = (_take_all(source, config, out, ctx) if sequence is None
             else _take_from_sequence(source, sequence, config, out, ctx))
    sheet = _make_sheet(source, taken.record, taken.broken, out)
    of_frame = {photos[candidate.index]: candidate for candidate in taken.record
                if candidate.name is not None}
    groups = group_photos(list(of_frame))
    for notice in group_notices(groups):
        ctx.notice(notice)
    longest = source.longest_side(config.max_size)
    for width, height in dict.fromkeys((group.first.width, group.first.height) for group in groups):
        report_reduced(width, height, longest, ctx)
    if source.panoramas:
        hide_carried(out, [str(candidate.name) for candidate in of_frame.values()], ctx)
    elif config.overlays == "mask":
        for group in groups:
            hide_border(out, [str(of_frame[photo].name) for photo in group.photos], ctx)
    count = len(photos) + len(strangers) + len(folder.broken)
    frames = tuple(sorted((
        Frame(str(of_frame[photo].name), None, photo.name, taken.sharpness.get(photo.name),
              held_out=False, group=index,
              masked=(out / store.MASKS / str(of_frame[photo].name)).exists(),
              exposure_ev=photo.exposure_ev)
        for index, group in enumerate(groups) for photo in group.photos),
        key=lambda frame: frame.name))
    return IngestedSource(
        "photos", _frame_groups(groups, path, source, longest, out, of_frame), frames,
        declared=count, decoded=count - len(taken.broken), lost=len(taken.broken),
        blurred=sum(candidate.reason in (Reason.BLURRED, Reason.CLIPPED)
                    and candidate.source in taken.sharpness for candidate in taken.record),
        skipped=tuple(sorted({*taken.dropped, *taken.broken, *strangers})),
        selection=Selection(taken.record, sheet, prefix),
        tracks=_visible_tracks(taken, frames, out))


def _find_sequence(
    photos: Sequence[Photo], scan_file: Path, ctx: IngestContext, *, white: int
) -> tuple[list[Photo], PhotoSequence | None, list[str]]:
    """Returns the photos without strangers, those that follow each other, and the strangers."""
    sequence = find_sequence(photos, scan_file, ctx, white=white)
    strangers = [] if sequence is None else [photos[place].name for place in sequence.strangers]
    strangers += [photos[place].name for place in find_odd(
        photos, () if sequence is None else (*sequence.places, *sequence.strangers), white=white)]
    if not strangers:
        return list(photos), sequence, []
    ctx.notice(
        f"{len(strangers)} photos are set aside, because they show nothing that the others show: "
        f"{list_names(strangers)}.")
    kept = [place for place, photo in enumerate(photos) if photo.name not in strangers]
    return ([photos[place] for place in kept],
            None if sequence is None else sequence.among(kept), strangers)


def _visible_tracks(taken: _TakenPhotos, frames: Sequence[Frame], out: Path) -> Tracks | None:
    """Returns the tracks through the frames, without masked points."""
    tracks = taken.tracks
    if tracks is None:
        return None
    visible = np.ones(len(tracks.image), np.bool_)
    images = {name: image for image, name in enumerate(tracks.names)}
    for frame in frames:
        if frame.masked and frame.name in images:
            hidden = read_png(out / store.MASKS / frame.name)[..., 0] == 0
            visible &= (tracks.image != images[frame.name]) | ~tracks.inside(hidden)
    return tracks.where(visible)


@dataclass(frozen=True)
class _PhotoSource:
    """The photos to choose from, in order."""

    path: Path  # represents them in messages
    photos: tuple[Photo, ...]
    names: tuple[str, ...]  # of their frames
    masks: Mapping[str, Path]  # by file name
    plan: RawPlan
    broken: Mapping[str, str]  # why other files are not photos, by file name
    white: int  # the brightest value of those with 16 bits
    panoramas: bool  # they are equirectangular

    def longest_side(self, max_size: int) -> int:
        """Returns the longest side of their frames: of panoramas, --max-size is the height."""
        return 2 * max_size if self.panoramas else max_size


@dataclass(frozen=True)
class _TakenPhotos:
    """The decisions on the photos of a folder."""

    record: Record
    broken: Mapping[str, str]  # why some cannot be read, by file name
    dropped: frozenset[str]  # that show nothing, or the same as others; not reported for a sequence
    tracks: Tracks | None = None  # through the photos that follow each other, by their frames
    sharpness: Mapping[str, float] = field(default_factory=dict)  # of these, by file name


def _take_all(
    source: _PhotoSource, config: IngestConfig, out: Path, ctx: IngestContext
) -> _TakenPhotos:
    """Writes all photos; returns which are kept, and why some are broken."""
    measures, unreadable = _write_photos(source, range(len(source.photos)), out, config, ctx)
    broken = {**source.broken, **unreadable}
    check_count(
        source.path, [photo for photo in source.photos if photo.name not in unreadable], broken)
    _report_broken(broken, ctx)
    record = frame_selection.choose_photos(
        source.path.name, [photo.name for photo in source.photos], source.names, measures)
    for text in frame_selection.describe_dropped(record):
        ctx.notice(text)
    return _TakenPhotos(record, broken, frozenset(
        candidate.source for candidate in record if candidate.name is None))


def _take_from_sequence(
    source: _PhotoSource, sequence: PhotoSequence, config: IngestConfig, out: Path,
    ctx: IngestContext,
) -> _TakenPhotos:
    """Writes the photos that are chosen from a sequence as from a video, and all beside it."""
    followed, tracks = _choose_followed(config, source, sequence, ctx)
    rest = sorted(set(range(len(source.photos))) - followed.keys())
    chosen = sorted(place for place, candidate in followed.items() if candidate.name is not None)
    measures, unreadable = _write_photos(source, [*chosen, *rest], out, config, ctx)
    broken = {**source.broken, **unreadable}
    check_count(source.path, [source.photos[place] for place in (*chosen, *rest)
                              if source.photos[place].name not in broken], broken)
    _report_broken(broken, ctx)
    beside = frame_selection.choose_beside(
        dict(zip(chosen, measures, strict=False)),
        dict(zip(rest, measures[len(chosen):], strict=True)),
        [photo.name for photo in source.photos], source.names)
    record = tuple(
        replace(candidate, reason=Reason.DAMAGED, name=None) if candidate.source in unreadable
        else candidate for _, candidate in sorted({**followed, **beside}.items()))
    dropped = [beside[place] for place in rest if beside[place].name is None]
    for text in frame_selection.describe_dropped(record, dropped):
        ctx.notice(text)
    return _TakenPhotos(
        record, broken, frozenset(candidate.source for candidate in dropped),
        tracks, {candidate.source: candidate.sharpness for candidate in followed.values()
                 if candidate.sharpness is not None})


def _choose_followed(
    config: IngestConfig, source: _PhotoSource, sequence: PhotoSequence, ctx: IngestContext
) -> tuple[dict[int, FrameCandidate], Tracks]:
    """Returns the decisions on the photos of a sequence, by place, and the tracks through them."""
    dense = is_dense([source.photos[place] for place in sequence.places])
    count = config.frames or frame_selection.automatic_count(
        frame_selection.path_length(sequence.scan.motion), most=config.max_frames,
        least=EXHAUSTIVE_MAX if dense else len(sequence.places))
    video = judge(config, source.path, sequence.scan, ctx, least=count)
    chosen = frame_selection.choose_frames(
        video.lengths, video.scan.sharpness, video.distinct, count,
        bridges=video.judgement.bridges)
    report_short(video, len(chosen), config.frames, ctx)
    names = {int(index): source.names[sequence.places[index]] for index in chosen}
    if len(names) < len(sequence.places):
        ctx.notice(
            f"The photos in {source.path.name} follow each other like the frames of a video: "
            f"{len(names)} of {len(sequence.places)} are chosen by their sharpness and the "
            "camera's motion; --frames sets another number.")
    candidates = frame_selection.video_candidates(
        source.path.name, video.scan.sharpness, video.judgement.refused, video.lengths, names,
        standing=video.standing)
    places = sequence.places
    return {places[candidate.index]: replace(
        candidate, source=source.photos[places[candidate.index]].name,
        index=places[candidate.index],
        like=None if candidate.like is None else places[candidate.like])
        for candidate in candidates}, video.scan.tracks.select(names)


def _report_broken(broken: Mapping[str, str], ctx: IngestContext) -> None:
    """Says which photos cannot be read, and why."""
    for reason in list(broken.values())[:MOST_NAMED]:
        ctx.notice(f"A photo is left out: {reason}")
    if (more := len(broken) - MOST_NAMED) > 0:
        ctx.notice(f"{more} more photos are left out for similar reasons.")


def _list_photos(
    paths: Sequence[Path], out: Path, camera: str, ctx: IngestContext
) -> tuple[Path, Path, PhotoFolder]:
    """Returns the path that represents the photos in messages, their folder, and the photos."""
    path = paths[0]
    if path.is_dir():
        tree = find_photo_files(path, out)
        home, found, notices = tree.home, list_photos(tree.files, tree.home), list(tree.notices)
        taken = {one.path for one in tree.foreign}
    else:
        (name, count), = Counter(path.name for path in paths).most_common(1)
        if count > 1:
            raise InputError(
                f"{count} photos are called {name}.",
                hint="Give their folders instead of the files.")
        home, found, taken = path.absolute().parent, list_photos(paths), set()
        notices = _describe_beside(paths, home)
        path = path if len(paths) == 1 else home
    chosen, left_out = choose_pictures(path if path.is_dir() else home, found, camera)
    for folder in dict.fromkeys((path, home)):
        for text in find_lists(folder, [photo.name for photo in chosen.photos], known=taken):
            notices.append(
                f"{text.name} names the photos and is not read: its data on them (such as "
                "places or angles) are not used.")
    for notice in (*notices, *left_out):
        ctx.notice(notice)
    return path, home, chosen


def _describe_beside(paths: Sequence[Path], home: Path) -> list[str]:
    """Returns the unused files that lie beside photos that were given as files."""
    if len({path.absolute().parent for path in paths}) > 1:
        return []
    masks = [f"{folder} is not used with files; give {home} to use it."
             for folder in mask_folders(home)]
    return masks + [found.notice(home) for found in find_foreign(home)]


def _find_masks(
    paths: Sequence[Path], home: Path, photos: Sequence[Photo], ctx: IngestContext
) -> FolderMasks:
    """Returns the masks in a given folder; given files have none."""
    if not paths[0].is_dir():
        return FolderMasks({}, ())
    masks = find_masks(paths[0], home, photos)
    if masks.outside:
        ctx.notice(f"{masks.outside} is not used; give {masks.outside.parent} to use it.")
    if masks.unused:
        ctx.notice(f"Masks without a photo are left out: {list_names(masks.unused)}.")
    if masks.unused and not masks.by_photo:
        ctx.notice(
            f"No mask is used: the mask of {photos[0].name} must be called "
            f"{photos[0].path.stem}.png or {photos[0].name}.png.")
    return masks


def _make_sheet(
    source: _PhotoSource, record: Record, broken: Mapping[str, str], out: Path
) -> ContactSheet:
    """Returns the contact sheet, and removes the files of photos that are not selected."""
    files = {candidate.index: out / store.FOLDER / source.names[candidate.index]
             for candidate in record if candidate.source not in broken}
    written = {index: file for index, file in files.items() if file.exists()}
    height, width = read_png(next(iter(written.values()))).shape[:2]
    sheet = ContactSheet(source.path.name, record, width, height)
    for index in sorted(sheet.wanted & files.keys()):
        with suppress(InputError):  # only of a photo that is not needed
            sheet.add(index, read_png(written[index]) if index in written
                      else read_photo(source.photos[index], source.white))
    for candidate in record:
        if candidate.index in written and candidate.name is None:
            for folder in (store.FOLDER, store.MASKS):
                atomic.delete(out / folder / source.names[candidate.index])
    return sheet


def _plan_raw(photos: Sequence[Photo], record: Path, ctx: IngestContext) -> RawPlan:
    """Returns how to develop the RAW photos; an interrupted run may have left its plan."""
    raw = {photo.name: photo.path for photo in photos if photo.is_raw}
    if not raw:
        return RawPlan({}, {})
    for text in describe_corrections([read_corrections(path) for path in raw.values()]):
        ctx.notice(text)
    if record.exists():
        with suppress(FormatError, ManifestError):  # damaged: it is planned again
            plan = RawPlan.from_json(atomic.read_json(record, dict))
            if plan.shots.keys() | plan.broken.keys() == raw.keys():
                return plan
    with ctx.progress.bar("raw", len(raw), unit="photo") as bar:
        plan = plan_raw(raw, step=bar.advance)
    atomic.write_json(record, plan.to_json())
    return plan


def _drop_raw_twins(photos: Sequence[Photo], plan: RawPlan, ctx: IngestContext) -> list[Photo]:
    """Returns the photos without twins of RAW ones, which could be trained on and held out."""
    stems = {PurePosixPath(name).with_suffix("") for name in plan.shots}
    twins = [photo.name for photo in photos
             if not photo.is_raw and PurePosixPath(photo.name).with_suffix("") in stems]
    if twins:
        ctx.notice(
            f"{len(twins)} photos are left out because there is camera RAW of the same name, "
            f"such as {twins[0]}.")
    return [photo for photo in photos if photo.name not in twins]


def _write_photos(
    source: _PhotoSource, indices: Sequence[int], out: Path, config: IngestConfig,
    ctx: IngestContext,
) -> tuple[list[PhotoMeasures | None], dict[str, str]]:
    """Writes some photos; returns their measures, and why some cannot be read, by file name."""
    measures: list[PhotoMeasures | None] = []
    unreadable: dict[str, str] = {}
    with ctx.progress.bar("photos", len(indices), unit="photo") as bar:
        for index in indices:
            photo, name = source.photos[index], source.names[index]
            mask = source.masks.get(photo.name)
            try:
                rgb = _write_photo(photo, mask, source, out, name,
                                   source.longest_side(config.max_size))
                measures.append(measure_photo(rgb))
            except InputError as error:
                unreadable[photo.name] = f"{error.message} {error.hint}".rstrip()
                measures.append(None)
            bar.advance()
            ctx.record(len(measures), len(indices))
    return measures, unreadable


def _write_photo(
    photo: Photo, mask_file: Path | None, source: _PhotoSource, out: Path, name: str,
    longest: int,
) -> NDArray[np.uint8]:
    """Writes a mask and then its frame, and returns the stored pixels, RGB, [H, W, 3]."""
    target = out / store.FOLDER / name
    if target.exists():
        return read_png(target)
    rgb = fit_image(develop(photo, source.plan) if photo.is_raw
                    else read_photo(photo, source.white), longest)
    height, width = rgb.shape[:2]
    mask = photo_mask(photo, mask_file, width, height)
    if source.panoramas and photo.area is not None and not photo.area.is_full:
        rgb, mask = fill_sphere(rgb, mask, photo.area)
    if mask is not None:
        write_mask(out / store.MASKS / name, mask)
    write_png(target, rgb)
    return rgb


def _frame_groups(
    groups: Sequence[PhotoGroup], path: Path, source: _PhotoSource, longest: int, out: Path,
    of_frame: Mapping[Photo, FrameCandidate],
) -> tuple[Group, ...]:
    """Returns the groups at the size at which their photos are stored."""
    frame_groups = []
    for group in groups:
        name = path.name if len(groups) == 1 else f"{path.name}: {group.name}"
        photo = group.first
        if source.panoramas:
            file = out / store.FOLDER / str(of_frame[photo].name)
            height, width = read_png(file).shape[:2]
            frame_groups.append(Group(name, width, height, lens=panorama_lens(width, height)))
            continue
        width, height = fit_size(photo.width, photo.height, longest)
        scale = min(1.0, longest / max(photo.width, photo.height))
        focal = None if photo.focal_px is None else photo.focal_px * scale
        frame_groups.append(Group(name, width, height, focal_px=focal))
    return tuple(frame_groups)
