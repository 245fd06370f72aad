"""The masks of what moves as files, which a user may edit, and the views that they are masks of.

They have the form of ingest's masks: PNG named like the view, 255 where a pixel counts, at the size
of the undistorted image. A mask that a user changed, added or removed is his word: it is kept by
the next training, which finds all others anew.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.context import EarlierResult
from recon_cli.errors import FormatError, Hint, InputError, ManifestError
from recon_cli.io.images import HALF, decode_file, fill_masked, read_mask, write_png
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.train_view import TrainView
from recon_cli.workspace.atomic import read_json, write_json
from recon_cli.workspace.layout import link_or_copy, remove
from recon_cli.workspace.summaries import MovingSummary

FOLDER = "masks"  # in the folder of the training

logger = logging.getLogger("recon")
Counts = NDArray[np.bool_]
Regions = list[NDArray[np.bool_]]  # [h, w] what is to be masked in each view, at any size


@dataclass(frozen=True)
class EditedMasks:
    """The masks that a user made, changed or removed, by file name; None: nothing is masked."""

    files: Mapping[str, Path | None] = field(default_factory=dict)

    @staticmethod
    def find(earlier: EarlierResult | None) -> EditedMasks:
        """Returns the edited masks of an earlier training; none where their folder is gone."""
        if earlier is None or not (earlier.folder / FOLDER).is_dir():
            return EditedMasks()
        record = read_summary(earlier.folder)
        known = set(record.by_hand) if record else set()
        place = f"{FOLDER}/"
        touched = {name.removeprefix(place) for name in
                   (*earlier.changed, *earlier.missing, *earlier.foreign)
                   if name.startswith(place)}
        files: dict[str, Path | None] = {}
        for name in sorted(known | touched):
            path = earlier.folder / FOLDER / name
            files[name] = path if path.exists() else None
        return EditedMasks(files)

    def read(self, view: View) -> Counts | None:
        """Returns where the pixels of a view count by its edited mask, None where it has none.

        Raises:
            InputError: the file is not a picture, or of another shape.
        """
        name = file_name(view)
        if name not in self.files:
            return None
        path, camera = self.files[name], view.camera
        if path is None:
            return np.ones((camera.height, camera.width), np.bool_)
        image = decode_file(path, cv2.IMREAD_COLOR)
        if image is None:
            raise InputError(
                f"{path} cannot be read as a mask.",
                hint="Write it again as PNG, white where pixels count, or remove it.")
        height, width = image.shape[:2]
        if abs(camera.height / camera.width * width - height) > 1:
            raise InputError(
                f"The mask {path} has {width}x{height} pixels, but {camera.width}x{camera.height} "
                "or the same shape in another size is needed.",
                hint="Draw it over the picture of that name in place/undistorted/images.")
        grey = cv2.resize(image.max(axis=2), (camera.width, camera.height),
                          interpolation=cv2.INTER_NEAREST_EXACT)
        return np.asarray(grey >= HALF)

    def unused(self, views: Sequence[View]) -> list[str]:
        """Returns the names of edited masks of no view that training reads."""
        return sorted(self.files.keys() - {file_name(view) for view in views})


def file_name(view: View) -> str:
    """Returns the name of the mask of a view."""
    return f"{Path(view.name).stem}.png"


def masked_views(scene: Scene) -> tuple[View, ...]:
    """Returns the views whose masks a training has: those that it reads."""
    return (*scene.train, *scene.validation)


def write_masks(
    out: Path, scene: Scene, regions: Regions | None, edited: EditedMasks
) -> MovingSummary | None:
    """Writes the masks of a training and their record; returns it, None where nothing is masked.

    Args:
        out: the folder of the training.
        scene: as sfm left it.
        regions: where each of `masked_views` shows what moves; None: nowhere.
        edited: what a user says instead.
    """
    _remove_masks(out)
    shares: dict[str, float] = {}
    by_hand: list[str] = []
    views = masked_views(scene)
    for row, view in enumerate(views):
        counts = edited.read(view)
        if counts is not None:
            by_hand.append(file_name(view))
        elif regions is not None and regions[row].any():
            counts = ~enlarge(regions[row], view.camera.width, view.camera.height)
        else:
            continue
        shares[view.name] = round(1 - float(counts.mean()), 4)
        if view.mask is not None:
            counts &= read_mask(view.mask, view.camera.width, view.camera.height)
        (out / FOLDER).mkdir(parents=True, exist_ok=True)
        write_png(out / FOLDER / file_name(view), np.where(counts, 255, 0).astype(np.uint8))
    if not shares:
        return None
    summary = MovingSummary(shares=shares, by_hand=tuple(by_hand), views=len(views))
    write_json(out / MovingSummary.FILE, summary.to_json())
    return summary


def _remove_masks(out: Path) -> None:
    """Removes those of a run that ended before its plan was written."""
    remove(out / FOLDER)
    remove(out / MovingSummary.FILE)


def read_summary(folder: Path) -> MovingSummary | None:
    """Returns what a training masked, None where it masked nothing."""
    path = folder / MovingSummary.FILE
    if not path.exists():
        return None
    hint = Hint("train", again=True)
    try:
        return MovingSummary.from_json(read_json(path, dict, hint=hint))
    except ManifestError as error:
        raise FormatError(f"{path} is damaged: {error.message}", hint=hint) from error


def copy_masks(folder: Path, summary: MovingSummary | None, out: Path) -> None:
    """Copies the masks of a finished training and their record to that which continues it."""
    _remove_masks(out)
    if summary is None:
        return
    for path in sorted((folder / FOLDER).glob("*.png")):
        link_or_copy(path, out / FOLDER / path.name)
    write_json(out / MovingSummary.FILE, summary.to_json())


def join_masks(out: Path, folders: Sequence[Path], scene: Scene) -> None:
    """Writes the masks that the blocks of a scene found, each in its folder, and their record.

    What moves for one block moves for all, but a user's mask is kept as it is.
    """
    own = read_summary(out)
    by_hand = own.by_hand if own else ()
    shares = dict(own.shares) if own else {}
    views = masked_views(scene)
    for view in views:
        name = file_name(view)
        found = [path for folder in folders if (path := folder / FOLDER / name).exists()]
        if name in by_hand or not found:
            continue
        width, height = view.camera.width, view.camera.height
        counts = np.logical_and.reduce([read_mask(path, width, height) for path in found])
        shares[view.name] = round(1 - float(counts.mean()), 4)
        (out / FOLDER).mkdir(parents=True, exist_ok=True)
        write_png(out / FOLDER / name, np.where(counts, 255, 0).astype(np.uint8))
    if shares:
        write_json(out / MovingSummary.FILE, MovingSummary(
            shares=shares, by_hand=by_hand, views=len(views)).to_json())


def with_masks(scene: Scene, folder: Path) -> Scene:
    """Returns a scene whose training and validation views have the masks of a training's folder."""
    def masked(views: Sequence[View]) -> tuple[View, ...]:
        return tuple(
            dataclasses.replace(view, mask=path) if (
                path := folder / FOLDER / file_name(view)).exists() else view for view in views)

    if not (folder / FOLDER).is_dir():
        return scene
    return dataclasses.replace(
        scene, train=masked(scene.train), validation=masked(scene.validation))


def hide(views: Sequence[TrainView], regions: Sequence[NDArray[np.bool_]]) -> list[TrainView]:
    """Returns the views without their regions [h, w], which may be of another size."""
    hidden = []
    for view, region in zip(views, regions, strict=True):
        if region.any():
            counts = ~enlarge(region, view.camera.width, view.camera.height)
            if view.mask is not None:
                counts &= view.mask
            image = fill_masked(view.image, counts)
            hidden.append(dataclasses.replace(view, stored=image, mask=counts, file=None))
        else:
            hidden.append(view)
    return hidden


def enlarge(region: NDArray[np.bool_], width: int, height: int) -> NDArray[np.bool_]:
    """Returns a region in another size, with a smooth border."""
    large = cv2.resize(region.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(large > 0.5)
