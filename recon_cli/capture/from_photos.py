"""Frames of a folder of photos: all of them that can be read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from recon_cli.capture import frames as store
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
from recon_cli.capture.taken import Context, Taken
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
        InputError: the photos are of mixed sizes, or too few can be read.
    """
    folder = list_photos(path)
    check_count(path, len(folder.photos), folder.broken)
    check_sizes(folder.photos)
    first = folder.photos[0]
    report_reduced(first.width, first.height, config.max_size, ctx)
    names = [f"{prefix}{name}" for name in frame_names(folder.photos)]
    broken = folder.broken | _write(folder.photos, names, config.max_size, out, ctx)
    for reason in broken.values():
        ctx.notice(f"A photo is left out: {reason}")
    taken = [
        (name, photo) for name, photo in zip(names, folder.photos, strict=True)
        if photo.path.name not in broken
    ]
    check_count(path, len(taken), broken)
    frames = tuple(
        Frame(name, None, photo.path.name, None, held_out=False) for name, photo in taken)
    size = store.fitted_size(first.width, first.height, config.max_size)
    group = Group(path.name, *size, focal_px=_stored_focal(folder, config))
    return Taken(
        "photos", (group,), frames, declared=len(taken) + len(broken), decoded=len(taken),
        lost=len(broken), skipped=tuple(sorted(broken)))


def _write(
    photos: Sequence[Photo], names: Sequence[str], max_size: int, out: Path, ctx: Context
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
