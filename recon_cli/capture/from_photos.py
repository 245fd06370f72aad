"""Frames of a folder of photos: all that can be read and show something of their own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture import frames as store
from recon_cli.capture.candidates import Candidate, Reason
from recon_cli.capture.contact import ContactSheet
from recon_cli.capture.duplicates import PhotoLook, choose_photos, dropped_photos, look_at_photo
from recon_cli.capture.frames import Frame, Group
from recon_cli.capture.from_video import report_reduced
from recon_cli.capture.images import Photo, read_photo
from recon_cli.capture.pace import paced
from recon_cli.capture.photos import (
    Folder,
    check_count,
    check_sizes,
    frame_names,
    list_photos,
    shared_focal,
)
from recon_cli.capture.taken import Choice, Context, Taken
from recon_cli.config import IngestConfig
from recon_cli.errors import InputError


def take(
    config: IngestConfig, path: Path, out: Path, ctx: Context, *, prefix: str = ""
) -> Taken:
    """Writes the photos of a folder into ingest's folder `out` and returns them.

    Args:
        config: see `IngestConfig`.
        path: the folder.
        out: frames already in it are kept.
        ctx: for notices and progress.
        prefix: of the names of the frames.

    Raises:
        InputError: the photos are of mixed sizes, or too few can be read or show something of
            their own.
    """
    folder = list_photos(path)
    check_count(path, len(folder.photos), folder.broken)
    check_sizes(folder.photos)
    first = folder.photos[0]
    report_reduced(first.width, first.height, config.max_size, ctx)
    names = [f"{prefix}{name}" for name in frame_names(folder.photos)]
    looks, broken = _write(folder.photos, names, config.max_size, out, ctx)
    broken = folder.broken | broken
    for reason in broken.values():
        ctx.notice(f"A photo is left out: {reason}")
    readable = sum(look is not None for look in looks)
    check_count(path, readable, broken)
    record = choose_photos(path.name, [photo.path.name for photo in folder.photos], names, looks)
    for text in dropped_photos(record):
        ctx.notice(text)
    sheet = _sheet(path.name, record, names, out)
    frames = tuple(
        Frame(one.name, None, one.source, None, held_out=False)
        for one in record if one.name is not None)
    dropped = {one.source for one in record if one.name is None}
    size = store.fitted_size(first.width, first.height, config.max_size)
    group = Group(path.name, *size, focal_px=_stored_focal(folder, config))
    return Taken(
        "photos", (group,), frames, declared=readable + len(broken), decoded=readable,
        lost=len(broken), skipped=tuple(sorted(dropped | broken.keys())),
        choice=Choice(record, sheet, prefix))


def _sheet(
    title: str, record: Sequence[Candidate], names: Sequence[str], out: Path
) -> ContactSheet:
    """Returns the contact sheet, and removes the files of photos that are not kept."""
    files = {one.index: out / store.FOLDER / names[one.index] for one in record
             if one.reason is not Reason.DAMAGED}
    height, width = store.read_png(next(iter(files.values()))).shape[:2]
    sheet = ContactSheet(title, record, width, height)
    for index in sorted(sheet.wanted & files.keys()):
        sheet.add(index, store.read_png(files[index]))
    for one in record:
        if one.index in files and one.name is None:
            files[one.index].unlink()
    return sheet


def _write(
    photos: Sequence[Photo], names: Sequence[str], max_size: int, out: Path, ctx: Context
) -> tuple[list[PhotoLook | None], dict[str, str]]:
    """Writes the photos; returns a look at each, and why some could not be read, by file name."""
    looks: list[PhotoLook | None] = []
    broken: dict[str, str] = {}
    record = paced(ctx.record)
    with ctx.progress.bar("photos", len(photos), unit="photo") as bar:
        for photo, name in zip(photos, names, strict=True):
            try:
                looks.append(look_at_photo(_stored(photo, out / store.FOLDER / name, max_size)))
            except InputError as error:
                broken[photo.path.name] = error.message
                looks.append(None)
            bar.advance()
            record(len(looks), len(photos))
    return looks, broken


def _stored(photo: Photo, target: Path, max_size: int) -> NDArray[np.uint8]:
    """Returns the pixels of a photo as they are stored, from an earlier try where there was one."""
    if target.exists():
        return store.read_png(target)
    rgb = store.fitted(read_photo(photo), max_size)
    store.write_png(target, rgb)
    return rgb


def _stored_focal(folder: Folder, config: IngestConfig) -> float | None:
    """Returns the focal length at the size at which the photos are stored."""
    focal = shared_focal(folder.photos)
    if focal is None:
        return None
    first = folder.photos[0]
    return focal * min(1.0, config.max_size / max(first.width, first.height))
