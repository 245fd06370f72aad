"""Views that a data set holds out by a list of their names, so that scores compare with others'.

INRIA's trainers read test.txt beside the COLMAP model, nerfstudio train_list.txt, test_list.txt and
validation_list.txt in the folder of the set, and names in transforms.json; ScanNet++ has
train_test_lists.json. Names come with a suffix or without, and with folders or without.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from recon_cli.datasets.posed import SUFFIXES, PosedSet, is_file
from recon_cli.errors import FormatError, format_count, list_names
from recon_cli.workspace.atomic import read_json, read_text

PARTS = ("train", "val", "test")  # a name in several lists is of the last
_FILES = {
    "train": ("train.txt", "train_list.txt"),
    "val": ("val.txt", "val_list.txt", "validation_list.txt"),
    "test": ("test.txt", "test_list.txt")}
_JSON = "train_test_lists.json"
_MODELS = ("sparse/0", "sparse", "colmap/sparse/0")  # where lists lie beside a model
_HINT = "Write one name of an image a line, or delete the file."


def apply_lists(posed: PosedSet, folder: Path) -> PosedSet:
    """Returns a set that holds out what the lists in its folder name, and says so.

    A set that holds out views already stays. FormatError if a list cannot be read.
    """
    lists = {} if posed.splits else _read_lists(folder)
    if not lists:
        return posed
    where = ", ".join(dict.fromkeys(name for name, _ in lists.values()))
    parts, unmatched = match_parts(
        {part: names for part, (_, names) in lists.items()},
        [image.name for image in posed.images], where)
    keep, held_out, notices = split_parts(parts, where)
    images = tuple(replace(image, held_out=held) for image, kept, held in zip(
        posed.images, keep, held_out, strict=True) if kept)
    if any(held_out):
        notices.append(f"held out are {sum(held_out)} of {len(parts)} images, by {where}")
    return replace(posed, images=images, splits=any(held_out),
                   notices=(*posed.notices, *unmatched, *notices))


def match_parts(
    lists: Mapping[str, Iterable[object]], images: Sequence[str], where: str
) -> tuple[list[str], list[str]]:
    """Returns the part of each image by the lists of some parts, "" for none, and notices.

    Without a list of training views every other image is one; with that alone, the others are for
    the test.
    """
    index: dict[str, set[str]] = {}
    for image in images:
        for key in _keys(image, stem=True):
            index.setdefault(key, set()).add(_plain(image))
    parts, unknown, notices = dict[str, str](), list[str](), list[str]()
    for part in PARTS:
        names = [str(name) for name in lists.get(part, ())]
        if part in lists and not names:
            notices.append(f"{where} names no image for {part}")
        for name in names:
            fitting = next((index[key] for key in _keys(name) if len(index.get(key, ())) == 1), ())
            parts.update(dict.fromkeys(fitting, part))
            unknown += [name] * (not fitting)
    if unknown:
        notices.append(f"{where} names {format_count(len(unknown), 'image')} that the set does not "
                       f"have: {list_names(unknown)}")
    others = "train" if "train" not in lists else "test" if len(lists) == 1 and parts else ""
    return [parts.get(_plain(image), others) for image in images], notices


def split_parts(
    parts: Sequence[str | None], where: str
) -> tuple[list[bool], list[bool], list[str]]:
    """Returns which images are used, which of them held out, and notices, by their parts.

    With test views these are held out and validation views left out, as the literature scores it;
    else validation views are held out. None is an image of no part, which is trained on. Where
    nothing is left to train on, all images are used.
    """
    part = "test" if "test" in parts else "val"
    held = [one == part for one in parts]
    keep = [one in (None, "train", part) for one in parts]
    if sum(held) == sum(keep):
        whole = [True] * len(parts)
        return whole, [not one for one in whole], [
            f"the split of {where} is not used: it leaves no image to train on"]
    return keep, held, [
        f"{len(parts) - sum(keep)} frames are left out: the set keeps them for validation, or "
        "lists them in no part"] * (not all(keep))


def _keys(name: str, *, stem: bool = False) -> list[str]:
    """Returns what a name may be called, the strictest first; `stem` also without any suffix."""
    path = PurePosixPath(_plain(name))
    bare = path.with_suffix("") if stem or path.suffix.lower() in SUFFIXES else path
    return list(dict.fromkeys([
        str(path), f"{bare}/", path.name, f"{bare.name}/"]))


def _plain(name: str) -> str:
    return PurePosixPath(name.strip().replace("\\", "/")).as_posix()


def _read_lists(folder: Path) -> dict[str, tuple[str, list[str]]]:
    """Returns the file and the names of each part that has a list."""
    lists: dict[str, tuple[str, list[str]]] = {}
    for home in (*(folder / place for place in _MODELS), folder):
        for part, names in _FILES.items():
            path = next((home / name for name in names if is_file(home / name)), None)
            if path is not None:
                lists.setdefault(part, (path.relative_to(folder).as_posix(), _read_names(path)))
        if is_file(home / _JSON):
            value = read_json(home / _JSON, dict, hint=_HINT)
            for part in PARTS:
                if isinstance(value.get(part), list):
                    lists.setdefault(part, (_JSON, [str(name) for name in value[part]]))
    return lists


def _read_names(path: Path) -> list[str]:
    try:
        lines = read_text(path).lstrip("\ufeff").splitlines()
    except (OSError, ValueError) as error:
        raise FormatError(f"{path} cannot be read: {error}.", hint=_HINT) from error
    return [line.strip() for line in lines if line.strip() and line.strip()[0] != "#"]
