"""Frames of photos: all that can be read and show something of their own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.camera_groups import PhotoGroup, group_notices, group_photos
from recon_cli.capture.contact_sheet import ContactSheet
from recon_cli.capture.from_video import report_reduced
from recon_cli.capture.images import Photo, read_photo
from recon_cli.capture.ingested_source import Choice, Context, Taken
from recon_cli.capture.masks import FoundMasks, find_masks, photo_mask, write_mask
from recon_cli.capture.near_duplicates import (
    NAMED,
    PhotoLook,
    choose_photos,
    dropped_photos,
    look_at_photo,
    named,
)
from recon_cli.capture.pace import paced
from recon_cli.capture.photos import Folder, check_count, frame_names, list_photos, photo_folder
from recon_cli.capture.raw import RawPlan, develop, plan_raw
from recon_cli.capture.selection_record import Candidate, Reason
from recon_cli.config.stages import IngestConfig
from recon_cli.errors import InputError
from recon_cli.io import frames as store
from recon_cli.io.frames import Frame, Group
from recon_cli.workspace import atomic

PLAN = "raw.json"  # how camera RAW was developed, for the next try and for the curious


@dataclass(frozen=True)
class _Writer:
    """What every photo of a folder is written with.

    Attributes:
        out: ingest's folder.
        max_size: longest side of a frame.
        masks: by the file name of the photo.
        plan: for those that are RAW.
    """

    out: Path
    max_size: int
    masks: dict[str, Path]
    plan: RawPlan

    def write(self, photo: Photo, name: str) -> NDArray[np.uint8]:
        """Writes a frame, and before it its mask, so that a frame that is there is complete.

        Returns:
            the pixels as they are stored, RGB, [H, W, 3].
        """
        target = self.out / store.FOLDER / name
        if target.exists():
            return store.read_png(target)
        rgb = store.fitted(self._read(photo), self.max_size)
        height, width = rgb.shape[:2]
        mask = photo_mask(photo, self.masks.get(photo.path.name), width, height)
        if mask is not None:
            write_mask(self.out / store.MASKS / name, mask)
        store.write_png(target, rgb)
        return rgb

    def remove(self, name: str) -> None:
        """Deletes a frame and its mask."""
        for folder in (store.FOLDER, store.MASKS):
            (self.out / folder / name).unlink(missing_ok=True)

    def _read(self, photo: Photo) -> NDArray[np.uint8]:
        return develop(photo, self.plan) if photo.is_raw else read_photo(photo)


def take(
    config: IngestConfig, paths: Sequence[Path], out: Path, ctx: Context, *, prefix: str = ""
) -> Taken:
    """Writes photos into ingest's folder `out` and returns them.

    Args:
        config: see `IngestConfig`.
        paths: a folder, which holds photos itself or in a folder of its own; or photos.
        out: frames already in it are kept.
        ctx: for notices and progress.
        prefix: of the names of the frames.

    Raises:
        InputError: too few photos can be read, have a mask that can be, or show something of their
            own.
    """
    path, folder = _listed(paths, ctx)
    check_count(path, len(folder.photos), folder.broken)
    plan = _planned(folder.photos, out / f"{prefix}{PLAN}", ctx)
    photos = _without_twins(folder.photos, plan, ctx)
    masks = _masks(paths, photos, ctx)
    names = [f"{prefix}{name}" for name in frame_names(photos)]
    writer = _Writer(out, config.max_size, masks.by_photo, plan)
    looks, unreadable = _write(photos, names, writer, ctx)
    broken = folder.broken | unreadable
    readable = sum(look is not None for look in looks)
    check_count(path, readable, broken)
    _tell_broken(tuple(broken.values()), ctx)
    record = choose_photos(path.name, [photo.path.name for photo in photos], names, looks)
    for text in dropped_photos(record):
        ctx.notice(text)
    sheet = _sheet(path.name, record, names, writer)
    taken = {photos[one.index]: one.name for one in record if one.name is not None}
    dropped = {one.source for one in record if one.name is None}
    groups = _grouped(list(taken), config.max_size, ctx)
    return Taken(
        "photos",
        _stored(groups, path, config.max_size),
        _frames(groups, taken, out),
        declared=readable + len(broken), decoded=readable, lost=len(broken),
        skipped=tuple(sorted(dropped | broken.keys())), choice=Choice(record, sheet, prefix))


def _listed(paths: Sequence[Path], ctx: Context) -> tuple[Path, Folder]:
    """Returns the path that stands for the photos in messages, and what they are."""
    path = paths[0]
    if not path.is_dir():
        _refuse_namesakes(paths)
        return (path if len(paths) == 1 else path.absolute().parent), list_photos(paths)
    home = photo_folder(path)
    if home != path:
        ctx.notice(f"{path} holds no photos itself: those in {home.name}/ are taken.")
    return path, list_photos(home.iterdir())


def _tell_broken(reasons: Sequence[str], ctx: Context) -> None:
    """Says why photos are left out; of many, the record of the choice names the rest."""
    for reason in reasons[:NAMED]:
        ctx.notice(f"A photo is left out: {reason}")
    if len(reasons) > NAMED:
        ctx.notice(f"{len(reasons) - NAMED} more photos are left out for such reasons.")


def _refuse_namesakes(paths: Sequence[Path]) -> None:
    counts = Counter(path.name for path in paths)
    name, count = counts.most_common(1)[0]
    if count > 1:
        raise InputError(
            f"{count} photos are called {name}.",
            hint="Give the folders that they lie in instead of the files.")


def _masks(paths: Sequence[Path], photos: Sequence[Photo], ctx: Context) -> FoundMasks:
    """Returns the masks in a folder that was given; files that were given bring none."""
    if not paths[0].is_dir():
        return FoundMasks({}, ())
    masks = find_masks(paths[0], photo_folder(paths[0]), photos)
    if masks.outside:
        ctx.notice(f"{masks.outside} is not used; give {masks.outside.parent} to use it.")
    if masks.unused:
        ctx.notice(f"Masks without a photo are left out: {named(masks.unused)}.")
    if masks.unused and not masks.by_photo:
        ctx.notice(
            f"No mask is used: that of {photos[0].path.name} must be called "
            f"{photos[0].path.stem}.png or {photos[0].path.name}.png.")
    return masks


def _sheet(
    title: str, record: Sequence[Candidate], names: Sequence[str], writer: _Writer
) -> ContactSheet:
    """Returns the contact sheet, and removes the files of photos that are not kept."""
    files = {one.index: writer.out / store.FOLDER / names[one.index] for one in record
             if one.reason is not Reason.DAMAGED}
    height, width = store.read_png(next(iter(files.values()))).shape[:2]
    sheet = ContactSheet(title, record, width, height)
    for index in sorted(sheet.wanted & files.keys()):
        sheet.add(index, store.read_png(files[index]))
    for one in record:
        if one.index in files and one.name is None:
            writer.remove(names[one.index])
    return sheet


def _planned(photos: Sequence[Photo], record: Path, ctx: Context) -> RawPlan:
    """Returns how to develop the RAW photos among all, from an earlier try where there was one."""
    paths = [photo.path for photo in photos if photo.is_raw]
    if not paths:
        return RawPlan({}, {})
    if record.exists():
        plan = RawPlan.from_json(atomic.read_json(record))
        if plan.shots.keys() | plan.broken.keys() == {path.name for path in paths}:
            return plan
    with ctx.progress.bar("raw", len(paths), unit="photo") as bar:
        plan = plan_raw(paths, step=bar.advance)
    atomic.write_json(record, plan.to_json())
    return plan


def _without_twins(photos: Sequence[Photo], plan: RawPlan, ctx: Context) -> list[Photo]:
    """Returns the photos without what the camera wrote beside a RAW photo of the same name.

    A view taken twice would be trained on while it is held out.
    """
    stems = {Path(name).stem for name in plan.shots}
    twins = [photo.path.name for photo in photos
             if not photo.is_raw and photo.path.stem in stems]
    if twins:
        ctx.notice(
            f"{len(twins)} photos are left out because they lie beside camera RAW of the same "
            f"name, such as {twins[0]}.")
    return [photo for photo in photos if photo.path.name not in twins]


def _write(
    photos: Sequence[Photo], names: Sequence[str], writer: _Writer, ctx: Context
) -> tuple[list[PhotoLook | None], dict[str, str]]:
    """Writes the photos; returns a look at each, and why some could not be read, by file name."""
    looks: list[PhotoLook | None] = []
    broken: dict[str, str] = {}
    record = paced(ctx.record)
    with ctx.progress.bar("photos", len(photos), unit="photo") as bar:
        for photo, name in zip(photos, names, strict=True):
            try:
                looks.append(look_at_photo(writer.write(photo, name)))
            except InputError as error:
                broken[photo.path.name] = f"{error.message} {error.hint}".rstrip()
                looks.append(None)
            bar.advance()
            record(len(looks), len(photos))
    return looks, broken


def _grouped(photos: Sequence[Photo], max_size: int, ctx: Context) -> list[PhotoGroup]:
    """Returns the photos by intrinsics and tells what is to be known of that."""
    groups = group_photos(photos)
    for notice in group_notices(groups):
        ctx.notice(notice)
    for width, height in dict.fromkeys((group.width, group.height) for group in groups):
        report_reduced(width, height, max_size, ctx)
    return groups


def _stored(groups: Sequence[PhotoGroup], source: Path, max_size: int) -> tuple[Group, ...]:
    """Returns the groups at the size at which their photos are stored."""
    stored = []
    for group in groups:
        name = source.name if len(groups) == 1 else f"{source.name}: {group.name}"
        width, height = store.fitted_size(group.width, group.height, max_size)
        scale = min(1.0, max_size / max(group.width, group.height))
        focal = None if group.focal_px is None else group.focal_px * scale
        stored.append(Group(name, width, height, focal_px=focal))
    return tuple(stored)


def _frames(
    groups: Sequence[PhotoGroup], names: dict[Photo, str], out: Path
) -> tuple[Frame, ...]:
    """Returns the frames sorted by name, each with its group and whether it has a mask."""
    frames = [
        Frame(names[photo], None, photo.path.name, None, held_out=False, group=index,
              masked=(out / store.MASKS / names[photo]).exists())
        for index, group in enumerate(groups) for photo in group.photos]
    return tuple(sorted(frames, key=lambda frame: frame.name))
