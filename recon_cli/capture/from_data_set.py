"""Frames of a data set that comes with poses; recognised by its layout, see `io.layouts`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.images import read_as_stored
from recon_cli.capture.ingested_source import Context, Taken
from recon_cli.capture.masks import opaque, read_mask, write_mask
from recon_cli.capture.pace import paced
from recon_cli.capture.photos import MIN_FRAMES, names_in_order
from recon_cli.config.stages import IngestConfig
from recon_cli.errors import InputError
from recon_cli.io import frames as store
from recon_cli.io.depth_points import points_from_depth
from recon_cli.io.frames import Frame, Group
from recon_cli.io.layouts import describe, read_posed
from recon_cli.io.posed import KnownPoses, PosedImage, PosedSet
from recon_cli.scene.camera import Lens


def take(config: IngestConfig, path: Path, out: Path, ctx: Context) -> Taken:
    """Writes the images, masks, poses and points of a data set into ingest's folder `out`.

    Args:
        config: see `IngestConfig`. Of a sequence an even choice is taken, of other sets all images
            unless a number is asked for. Views that the set itself holds out are all taken.
        path: the data set.
        out: frames already in it are kept.
        ctx: for notices and progress.

    Raises:
        InputError: too few images can be read.
        FormatError: a file of the data set is damaged or contradicts itself.
    """
    posed = read_posed(path)
    ctx.notice(f"{path.name} is taken for {describe(posed)}.")
    for notice in posed.notices:
        ctx.notice(f"{notice[0].upper()}{notice[1:]}.")
    images = _chosen(config, posed, ctx)
    names = names_in_order([Path(image.name).stem for image in images])
    broken = _write(images, names, posed.lenses, config.max_size, out, ctx)
    for reason in broken.values():
        ctx.notice(f"An image is left out: {reason}")
    kept = [(name, image) for name, image in zip(names, images, strict=True) if name not in broken]
    if len(kept) < MIN_FRAMES:
        raise InputError(
            f"{path}: {len(kept)} images can be read, but at least {MIN_FRAMES} are needed.",
            hint="Check that the images of the data set lie where it says.")
    poses = _known(posed, kept)
    poses.write(out)
    masks = out / store.MASKS
    return Taken(
        posed.layout,
        tuple(_group(path.name, lens, config.max_size) for lens in posed.lenses),
        tuple(Frame(name, None, image.path.name, None, image.held_out, image.lens,
                    (masks / name).exists()) for name, image in kept),
        declared=len(posed.images) + len(posed.missing), decoded=len(kept),
        lost=len(broken) + len(posed.missing),
        skipped=(*posed.missing, *(image.name for image, name in zip(images, names, strict=True)
                                   if name in broken)),
        splits=posed.splits, poses=poses)


def _chosen(config: IngestConfig, posed: PosedSet, ctx: Context) -> list[PosedImage]:
    """Returns the images to take, in order: an even choice where there are too many."""
    kept = [image for image in posed.images if image.held_out]
    rest = [image for image in posed.images if not image.held_out]
    most = config.frames or (config.max_frames if posed.sequence else len(rest))
    if len(rest) > most:
        ctx.notice(f"{most} of {len(rest)} frames are taken, evenly spread; --frames changes that.")
        rest = [rest[int((i + 0.5) * len(rest) / most)] for i in range(most)]
    return rest + kept


def _write(
    images: Sequence[PosedImage], names: Sequence[str], lenses: Sequence[Lens], max_size: int,
    out: Path, ctx: Context,
) -> dict[str, str]:
    """Writes frames and masks; returns why some images could not be read, by frame name."""
    broken: dict[str, str] = {}
    record = paced(ctx.record)
    with ctx.progress.bar("images", len(images), unit="image") as bar:
        for done, (image, name) in enumerate(zip(images, names, strict=True), start=1):
            target = out / store.FOLDER / name
            if not target.exists():
                try:
                    rgb, mask = _pixels(image, lenses[image.lens], max_size)
                except InputError as error:
                    broken[name] = error.message
                else:
                    if mask is not None:  # first: a frame that is there is finished
                        write_mask(out / store.MASKS / name, mask)
                    store.write_png(target, rgb)
            bar.advance()
            record(done, len(images))
    return broken


def _pixels(
    image: PosedImage, lens: Lens, max_size: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Returns RGB and mask at the stored size.

    They are turned as they lie in the file: poses are those of the pixels, not of EXIF.
    """
    rgb, opacity = read_as_stored(image.path)
    height, width = rgb.shape[:2]
    if (width, height) != (lens.width, lens.height):
        raise InputError(
            f"{image.name} holds {width}x{height} pixels, but its camera has "
            f"{lens.width}x{lens.height}.")
    rgb = store.fitted(rgb, max_size)
    height, width = rgb.shape[:2]
    if image.mask is not None:
        return rgb, read_mask(image.mask, width, height)
    return rgb, opaque(opacity, image.name, width, height)


def _known(posed: PosedSet, kept: Sequence[tuple[str, PosedImage]]) -> KnownPoses:
    viewmats = {name: image.viewmat for name, image in kept}
    points, colors = posed.points, posed.colors
    if points is None and any(image.depth for image in posed.images):
        # The views that the set holds out lend no depth: it would show what they are scored on.
        rest = tuple(image for image in posed.images if not image.held_out)
        points, colors = points_from_depth(replace(posed, images=rest))
    return KnownPoses(viewmats, posed.metric, points, colors)


def _group(name: str, lens: Lens, max_size: int) -> Group:
    width, height = store.fitted_size(lens.width, lens.height, max_size)
    return Group(name, width, height, lens=lens.resized(width, height))
