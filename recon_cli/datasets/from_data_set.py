"""Frames of a data set with poses; `layouts` recognises it."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.capture.images import choose_white, is_wide, read_as_stored
from recon_cli.capture.ingested_source import IngestContext, IngestedSource
from recon_cli.capture.masks import opaque, read_mask, write_mask
from recon_cli.capture.photo_tree import describe_unused
from recon_cli.capture.photos import make_frame_names
from recon_cli.capture.video import stored_frames
from recon_cli.config.stages import IngestConfig
from recon_cli.datasets.depth_agreement import fit_depth
from recon_cli.datasets.depth_points import points_from_depth
from recon_cli.datasets.layouts import describe, read_posed
from recon_cli.datasets.packed import is_packed, unpacked
from recon_cli.datasets.posed import PosedImage, PosedSet, image_size
from recon_cli.errors import FormatError, InputError, format_count
from recon_cli.io.depth_maps import write_depth, write_depth_list
from recon_cli.io.images import fit_image, fit_size, write_png
from recon_cli.io.views import spread_inside
from recon_cli.scene.statistics import ROUNDING
from recon_cli.workspace import records as store
from recon_cli.workspace.records import MIN_FRAMES, Frame, Group, KnownPoses

# Units between centres up to which all are one: of metres what a float32 rounds, of any other unit
# nothing that a program would write.
_PLAUSIBLE = (0.1, 20.0)  # metres; the median of depth over the frames of a room


def ingest(config: IngestConfig, path: Path, out: Path, ctx: IngestContext) -> IngestedSource:
    """Writes the images, masks, poses and points of a data set into ingest's folder `out`.

    From a sequence, frames are chosen evenly; of other sets all images are used unless a number is
    given. Views that the set holds out are all used. Frames already in `out` are kept. InputError
    if too few images can be read; FormatError if a file is damaged or contradicts itself.
    """
    with contextlib.ExitStack() as stack:
        given = path
        if path.is_file() and is_packed(path):
            path = stack.enter_context(unpacked(path, out))
        return _ingest(config, path, given.name, out, ctx)


def _ingest(
    config: IngestConfig, path: Path, label: str, out: Path, ctx: IngestContext
) -> IngestedSource:
    """Reads the data set at a path, which is called `label`."""
    posed = read_posed(path)
    ctx.notice(f"{label} is read as {describe(posed)}.")
    for notice in posed.notices:
        ctx.notice(f"{notice[0].upper()}{notice[1:]}.")
    used = {file for image in posed.images for file in (
        image.path, image.mask, *(image.depth.files if image.depth else ())) if file}
    if path.is_dir():
        words = describe(posed).split(":")[0]
        for text in describe_unused(path, used, posed.layout, words):
            ctx.notice(text)
    images = _choose_images(config, posed, ctx)
    white = choose_white([image.path for image in images
                          if image.is_picture and is_wide(image.path)], ctx.notice)
    names = make_frame_names([Path(image.name).stem for image in images])
    broken = _write_images(images, names, config.max_size, white, out, ctx)
    for reason in broken.values():
        ctx.notice(f"An image is left out: {reason}")
    readable = [
        (name, image) for name, image in zip(names, images, strict=True) if name not in broken]
    if len(readable) < MIN_FRAMES:
        raise InputError(
            f"{label}: {len(readable)} images can be read, but at least {MIN_FRAMES} are needed.",
            hint="Check that the images are where the data set says.")
    damaged = {image.path for name, image in zip(names, images, strict=True) if name in broken}
    posed = _write_depth(posed, readable, out, ctx)
    poses = None
    centers = np.linalg.inv([image.viewmat for _, image in readable])[:, :3, 3]
    if np.ptp(centers, axis=0).max() <= ROUNDING:
        ctx.notice("All poses stand in one place: the data set has turns alone, so the cameras are "
                   "found from the pictures.")
    else:
        poses = _make_known_poses(posed, readable, damaged, out, ctx)
        poses.write(out)
    masks, lenses = out / store.MASKS, posed.lenses
    sizes = [fit_size(lens.width, lens.height, config.max_size) for lens in lenses]
    return IngestedSource(
        posed.layout,
        tuple(Group(label, *size, lens=lens.resized(*size))
              for lens, size in zip(lenses, sizes, strict=True)),
        tuple(Frame(name, image.time if image.frame is not None else None, image.path.name, None,
                    image.held_out, lenses.index(image.lens), (masks / name).exists())
              for name, image in readable),
        declared=len(posed.images) + len(posed.missing), decoded=len(readable),
        lost=len(broken) + len(posed.missing),
        skipped=(*posed.missing, *(image.name for image, name in zip(images, names, strict=True)
                                   if name in broken)),
        splits=posed.splits, poses=poses)


def _choose_images(config: IngestConfig, posed: PosedSet, ctx: IngestContext) -> list[PosedImage]:
    """Returns the images to use, in order: evenly chosen ones where there are too many."""
    rest = [image.name for image in posed.images if not image.held_out]
    most = config.frames or (config.max_frames if posed.sequence else len(rest))
    if len(rest) > most:
        ctx.notice(f"{most} of {len(rest)} frames are used, evenly spread; --frames changes that.")
        rest = spread_inside(rest, most)
    chosen = set(rest)
    return [image for image in posed.images if image.held_out or image.name in chosen]


def _write_images(
    images: Sequence[PosedImage], names: Sequence[str], max_size: int, white: int, out: Path,
    ctx: IngestContext,
) -> dict[str, str]:
    """Writes frames and masks; returns why some images could not be read, by frame name."""
    broken: dict[str, str] = {}
    with ctx.progress.bar("images", len(images), unit="image") as bar:
        for done, (name, image, pixels) in enumerate(
                _read_all(list(zip(names, images, strict=True)), out, white, ctx.threads), start=1):
            if pixels is not None:
                try:
                    rgb, mask = _prepare(image, pixels(), max_size)
                except InputError as error:
                    broken[name] = error.message
                else:
                    if mask is not None:  # first: a frame that is there is finished
                        write_mask(out / store.MASKS / name, mask)
                    write_png(out / store.FOLDER / name, rgb)
            bar.advance()
            ctx.record(done, len(images))
    return broken


Pixels = tuple[NDArray[np.uint8], NDArray[np.uint8] | None]  # RGB and opacity


def _read_all(
    named: Sequence[tuple[str, PosedImage]], out: Path, white: int, threads: int
) -> Iterator[tuple[str, PosedImage, Callable[[], Pixels] | None]]:
    """Yields each image with what reads its pixels, None if it is written already.

    Frames of a video come last, in its order, so that it is decoded once.
    """
    videos: dict[Path, dict[int, tuple[str, PosedImage]]] = {}
    for name, image in named:
        if (out / store.FOLDER / name).exists():
            yield name, image, None
        elif image.frame is not None:
            videos.setdefault(image.path, {})[image.frame] = name, image
        elif image.read is not None:
            yield name, image, partial(_without_opacity, image.read)
        else:
            yield name, image, partial(read_as_stored, image.path, white)
    for video, frames in videos.items():
        for number, rgb in stored_frames(video, frames, threads=threads):
            name, image = frames[number]
            yield name, image, partial(_decoded, rgb, f"Frame {number} of {video}")


def _without_opacity(read: Callable[[], NDArray[np.uint8]]) -> Pixels:
    return read(), None


def _decoded(rgb: NDArray[np.uint8] | None, label: str) -> Pixels:
    if rgb is None:
        raise InputError(
            f"{label} cannot be decoded.",
            hint="Copy the recording again; or play it to see whether it is whole.")
    return rgb, None


def _prepare(
    image: PosedImage, pixels: Pixels, max_size: int
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Returns RGB and mask, reduced; at the stored size EXIF orientation is not applied."""
    rgb, opacity = pixels
    lens = image.lens
    height, width = rgb.shape[:2]
    if (width, height) != (lens.width, lens.height):
        raise InputError(
            f"{image.name} holds {width}x{height} pixels, but its camera has "
            f"{lens.width}x{lens.height}.",
            hint="Give the images that the cameras were made for, or scale both alike.")
    if image.rim:
        inner = slice(image.rim, -image.rim)
        opacity = np.zeros((height, width), np.uint8)
        opacity[inner, inner] = 255
    rgb = fit_image(rgb, max_size)
    height, width = rgb.shape[:2]
    if image.mask is not None:
        return rgb, read_mask(image.mask, width, height)
    return rgb, opaque(opacity, image.name, width, height)


def _write_depth(
    posed: PosedSet, readable: Sequence[tuple[str, PosedImage]], out: Path, ctx: IngestContext
) -> PosedSet:
    """Writes the depth of frames that the set does not hold out, as the sensor gave it.

    Returns the set with depth in the unit that fits its poses; without depth that is damaged, or
    fits in none. FormatError if every file is damaged.
    """
    posed, readable = _fit_depth(posed, readable, ctx)
    maps, damaged, medians = {}, dict[str, FormatError](), []
    for name, image in readable:
        if image.depth is None or image.held_out:
            continue
        try:
            depth, levels = image.depth.read(), image.depth.read_confidence()
        except FormatError as error:
            damaged[image.name] = error
            continue
        height, width = depth.shape
        medians.append(float(np.median(depth[depth > 0])) if depth.any() else np.nan)
        maps[name] = write_depth(
            out, name, depth, image.depth.own_lens(width, height), unit=image.depth.unit,
            reliable=image.depth.reliable if math.isfinite(image.depth.reliable) else None,
            confidence=levels)
    if damaged and not maps:
        raise next(iter(damaged.values()))
    typical = float(np.nanmedian(medians)) if np.isfinite(medians).any() else 0.0
    low, high = _PLAUSIBLE
    if posed.metric and typical and not low <= typical <= high:
        return _without_depth(posed, ctx, (
            f"it is {typical:.3g} m in the median of the frames, which is not that of a room, so "
            "its unit is not the one that its program writes"))
    if damaged:
        first = next(iter(damaged.values()))
        ctx.notice(f"Depth is left out: {format_count(len(damaged), 'file')} cannot be read; "
                   f"the first: {first.message}")
    if maps:
        write_depth_list(out, maps)
    return replace(posed, images=tuple(
        replace(image, depth=None) if image.name in damaged else image for image in posed.images))


def _fit_depth(
    posed: PosedSet, readable: Sequence[tuple[str, PosedImage]], ctx: IngestContext
) -> tuple[PosedSet, Sequence[tuple[str, PosedImage]]]:
    """Returns the set and its readable images with depth in the unit that fits the poses."""
    fit = fit_depth([image for _, image in readable if not image.held_out], posed.points)
    # Tracked poses may be refuted later, and depth then still shows the scale.
    if fit.fault and not (fit.contradicts and posed.accuracy == "tracked"):
        posed = _without_depth(posed, ctx, f"{fit.fault}, but not as it is")
    elif fit.words:
        ctx.notice(f"The depth fits the poses {fit.words}, and is used so.")
    elif posed.metric_by_depth and not fit.shown:
        ctx.notice("Nothing shows whether the depth fits the poses, so their unit is not taken for "
                   "a metre; --scale-between of recon sfm makes it one.")
    images = {image.name: replace(image, depth=image.depth and image.depth.scaled(fit.factor))
              for image in posed.images}
    posed = replace(posed, images=tuple(images.values()),
                    metric=posed.metric and (fit.shown or not posed.metric_by_depth))
    return posed, [(name, images[image.name]) for name, image in readable]


def _without_depth(posed: PosedSet, ctx: IngestContext, reason: str) -> PosedSet:
    ctx.notice(f"The depth is not used: {reason}.")
    return replace(posed, images=tuple(replace(image, depth=None) for image in posed.images))


def _make_known_poses(
    posed: PosedSet, readable: Sequence[tuple[str, PosedImage]], damaged: Collection[Path],
    out: Path, ctx: IngestContext,
) -> KnownPoses:
    viewmats = {name: image.viewmat for name, image in readable}
    poses = KnownPoses(
        viewmats, posed.metric, posed.points, posed.colors, up=posed.up, find_up=posed.find_up,
        accuracy=posed.accuracy)
    if posed.points is not None or not any(image.depth for image in posed.images):
        return poses
    # Views that the set holds out give no depth: it would reveal what they are scored on.
    names = {image.name: name for name, image in readable}
    rest = tuple(image if image.is_picture else _as_written(image, out / store.FOLDER / names[
        image.name]) for image in posed.images if not image.held_out and image.path not in damaged
        and (image.is_picture or image.name in names))
    try:
        points, colors = points_from_depth(replace(posed, images=rest))
    except InputError as error:
        ctx.notice(f"The depth gives no points, so they are triangulated: {error.message}")
        return poses
    return replace(poses, points=points, colors=colors)


def _as_written(image: PosedImage, path: Path) -> PosedImage:
    """Returns a frame of a video as the image that was written of it."""
    lens = image.lens.resized(*image_size(path))
    return replace(image, path=path, lens=lens, depth=image.depth and image.depth.with_lens(lens),
                   frame=None, read=None)
