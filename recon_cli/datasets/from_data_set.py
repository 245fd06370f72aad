"""Frames of a data set with poses; `io.layouts` recognises it by its layout."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.frame_selection import MIN_FRAMES
from recon_cli.capture.images import (
    WHITE,
    describe_white,
    find_white,
    is_wide,
    read_as_stored,
)
from recon_cli.capture.ingested_source import IngestContext, IngestedSource
from recon_cli.capture.masks import opaque, read_mask, write_mask
from recon_cli.capture.photo_tree import describe_unused
from recon_cli.capture.photos import make_frame_names
from recon_cli.config.stages import IngestConfig
from recon_cli.datasets.depth_points import points_from_depth
from recon_cli.datasets.layouts import describe, read_posed
from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.errors import InputError
from recon_cli.io.depth_maps import write_depth, write_depth_list
from recon_cli.io.images import fit_image, fit_size, write_png
from recon_cli.workspace import records as store
from recon_cli.workspace.records import Frame, Group, KnownPoses


def ingest(config: IngestConfig, path: Path, out: Path, ctx: IngestContext) -> IngestedSource:
    """Writes the images, masks, poses and points of a data set into ingest's folder `out`.

    From a sequence, frames are chosen evenly; of other sets all images are used unless a number is
    given. Views that the set holds out are all used. Frames already in `out` are kept. InputError
    if too few images can be read; FormatError if a file is damaged or contradicts itself.
    """
    posed = read_posed(path)
    ctx.notice(f"{path.name} is read as {describe(posed)}.")
    for notice in posed.notices:
        ctx.notice(f"{notice[0].upper()}{notice[1:]}.")
    used = {file for image in posed.images
            for file in (image.path, image.mask, image.depth and image.depth.path) if file}
    if path.is_dir():
        for text in describe_unused(path, used, describe(posed).split(":")[0]):
            ctx.notice(text)
    images = _choose_images(config, posed, ctx)
    white = _find_white(images, ctx)
    names = make_frame_names([Path(image.name).stem for image in images])
    broken = _write_images(images, names, config.max_size, white, out, ctx)
    for reason in broken.values():
        ctx.notice(f"An image is left out: {reason}")
    readable = [
        (name, image) for name, image in zip(names, images, strict=True) if name not in broken]
    if len(readable) < MIN_FRAMES:
        raise InputError(
            f"{path}: {len(readable)} images can be read, but at least {MIN_FRAMES} are needed.",
            hint="Check that the images are where the data set says.")
    damaged = {image.path for name, image in zip(names, images, strict=True) if name in broken}
    poses = _make_known_poses(posed, readable, damaged)
    poses.write(out)
    _write_depth(readable, out)
    masks, lenses = out / store.MASKS, posed.lenses
    sizes = [fit_size(lens.width, lens.height, config.max_size) for lens in lenses]
    return IngestedSource(
        posed.layout,
        tuple(Group(path.name, *size, lens=lens.resized(*size))
              for lens, size in zip(lenses, sizes, strict=True)),
        tuple(Frame(name, None, image.path.name, None, image.held_out, lenses.index(image.lens),
                    (masks / name).exists()) for name, image in readable),
        declared=len(posed.images) + len(posed.missing), decoded=len(readable),
        lost=len(broken) + len(posed.missing),
        skipped=(*posed.missing, *(image.name for image, name in zip(images, names, strict=True)
                                   if name in broken)),
        splits=posed.splits, poses=poses)


def _choose_images(config: IngestConfig, posed: PosedSet, ctx: IngestContext) -> list[PosedImage]:
    """Returns the images to use, in order: evenly chosen ones where there are too many."""
    held_out = [image for image in posed.images if image.held_out]
    rest = [image for image in posed.images if not image.held_out]
    most = config.frames or (config.max_frames if posed.sequence else len(rest))
    if len(rest) > most:
        ctx.notice(f"{most} of {len(rest)} frames are used, evenly spread; --frames changes that.")
        rest = [rest[int((i + 0.5) * len(rest) / most)] for i in range(most)]
    return rest + held_out


def _find_white(images: Sequence[PosedImage], ctx: IngestContext) -> int:
    """Returns the brightest value of images with 16 bits, and says where it is below 65535."""
    wide = [image.path for image in images if is_wide(image.path)]
    white = find_white(wide) if wide else WHITE
    if white < WHITE:
        ctx.notice(describe_white(len(wide), white))
    return white


def _write_images(
    images: Sequence[PosedImage], names: Sequence[str], max_size: int, white: int, out: Path,
    ctx: IngestContext,
) -> dict[str, str]:
    """Writes frames and masks; returns why some images could not be read, by frame name."""
    broken: dict[str, str] = {}
    with ctx.progress.bar("images", len(images), unit="image") as bar:
        for done, (image, name) in enumerate(zip(images, names, strict=True), start=1):
            target = out / store.FOLDER / name
            if not target.exists():
                try:
                    rgb, mask = _read_pixels(image, max_size, white)
                except InputError as error:
                    broken[name] = error.message
                else:
                    if mask is not None:  # first: a frame that is there is finished
                        write_mask(out / store.MASKS / name, mask)
                    write_png(target, rgb)
            bar.advance()
            ctx.record(done, len(images))
    return broken


def _read_pixels(
    image: PosedImage, max_size: int, white: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Returns RGB and mask at the stored size, ignoring EXIF orientation as the poses do."""
    rgb, opacity = read_as_stored(image.path, white)
    lens = image.lens
    height, width = rgb.shape[:2]
    if (width, height) != (lens.width, lens.height):
        raise InputError(
            f"{image.name} holds {width}x{height} pixels, but its camera has "
            f"{lens.width}x{lens.height}.",
            hint="Give the images that the cameras were made for, or scale both alike.")
    rgb = fit_image(rgb, max_size)
    height, width = rgb.shape[:2]
    if image.mask is not None:
        return rgb, read_mask(image.mask, width, height)
    return rgb, opaque(opacity, image.name, width, height)


def _write_depth(readable: Sequence[tuple[str, PosedImage]], out: Path) -> None:
    """Writes the depth of the frames that may be trained on, as the sensor gave it."""
    maps = {}
    for name, image in readable:
        if image.depth is not None and not image.held_out:
            depth = image.depth.read()
            height, width = depth.shape
            maps[name] = write_depth(
                out, name, depth, image.depth.own_lens(width, height), unit=image.depth.unit,
                reliable=image.depth.reliable if math.isfinite(image.depth.reliable) else None,
                confidence=image.depth.read_confidence())
    if maps:
        write_depth_list(out, maps)


def _make_known_poses(
    posed: PosedSet, readable: Sequence[tuple[str, PosedImage]], damaged: Collection[Path]
) -> KnownPoses:
    viewmats = {name: image.viewmat for name, image in readable}
    points, colors = posed.points, posed.colors
    if points is None and any(image.depth for image in posed.images):
        # Views that the set holds out give no depth: it would reveal what they are scored on.
        rest = tuple(image for image in posed.images
                     if not image.held_out and image.path not in damaged)
        points, colors = points_from_depth(replace(posed, images=rest))
    return KnownPoses(viewmats, posed.metric, points, colors, up=posed.up, find_up=posed.find_up,
                      accuracy=posed.accuracy)
