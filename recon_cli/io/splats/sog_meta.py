"""meta.json of a .sog: what it says, checked before anything is unpacked by it."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.splats.codebooks import BOOK
from recon_cli.io.splats.sog_archive import Archive

MOST_ENTRIES = 65536  # of a palette: labels are 16 bits
_MOST_COUNT = 16383 * 16383  # pixels of the largest WebP
_Book = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Harmonics:
    """What it says of the coefficients of degrees 1 and up.

    Attributes:
        count: entries of the palette.
        degree: 1 to 3.
        codebook: at most 256 numbers.
        files: names of the palette's image and of the labels'.
    """

    count: int
    degree: int
    codebook: _Book
    files: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Meta:
    """What meta.json says.

    Attributes:
        count: Gaussians.
        low: [3] least logarithm of a position by axis.
        high: [3] greatest.
        means: names of the images of the low and the high bytes.
        scales: codebook of the logarithms of scales.
        scales_file: name of their image.
        quats_file: name of the image of quaternions.
        sh0: codebook of the colours.
        sh0_file: name of the image of colours and opacities.
        harmonics: None at degree 0.
    """

    count: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    means: tuple[str, ...]
    scales: _Book
    scales_file: str
    quats_file: str
    sh0: _Book
    sh0_file: str
    harmonics: Harmonics | None


def read_meta(archive: Archive) -> Meta:
    """Returns what the meta.json of an archive says.

    Raises:
        FormatError: it is missing or says something else than its format does.
    """
    value = archive.meta()
    if "version" not in value and isinstance(value.get("means"), dict):
        raise archive.damaged("version 1 of the format, which is no longer written")
    if _whole(value, "version", 0, sys.maxsize, archive) != 2:
        raise archive.damaged(f"version {value['version']} of the format; version 2 can be read")
    means, scales, quats, sh0 = (
        _part(value, name, archive) for name in ("means", "scales", "quats", "sh0"))
    return Meta(
        count=_whole(value, "count", 1, _MOST_COUNT, archive),
        low=_numbers(means, "mins", 3, 3, archive), high=_numbers(means, "maxs", 3, 3, archive),
        means=_files(means, 2, archive),
        scales=_book(scales, archive), scales_file=_files(scales, 1, archive)[0],
        quats_file=_files(quats, 1, archive)[0],
        sh0=_book(sh0, archive), sh0_file=_files(sh0, 1, archive)[0],
        harmonics=_harmonics(value, archive))


def _harmonics(value: dict[str, Any], archive: Archive) -> Harmonics | None:
    if value.get("shN") is None:
        return None
    part = _part(value, "shN", archive)
    return Harmonics(
        _whole(part, "count", 1, MOST_ENTRIES, archive), _whole(part, "bands", 1, 3, archive),
        _book(part, archive), _files(part, 2, archive))


def _part(value: dict[str, Any], name: str, archive: Archive) -> dict[str, Any]:
    part = value.get(name)
    if not isinstance(part, dict):
        raise archive.damaged(f"a meta.json without {name}")
    return part


def _whole(part: dict[str, Any], name: str, low: int, high: int, archive: Archive) -> int:
    value = part.get(name)
    if type(value) is not int or not low <= value <= high:
        raise archive.damaged(f"{name} = {value!r:.40}; needed is {low} to {high}")
    return value


def _book(part: dict[str, Any], archive: Archive) -> _Book:
    return _numbers(part, "codebook", 1, BOOK, archive).astype(np.float32)


def _numbers(
    part: dict[str, Any], name: str, least: int, most: int, archive: Archive
) -> NDArray[np.float64]:
    """Returns finite numbers that fit into float32."""
    value = part.get(name)
    largest = float(np.finfo(np.float32).max)
    if not isinstance(value, list) or not least <= len(value) <= most or not all(
            type(one) in (int, float) and abs(one) <= largest for one in value):
        raise archive.damaged(f"{name} = {value!r:.40}; needed are {most} finite numbers")
    return np.array(value, np.float64)


def _files(part: dict[str, Any], count: int, archive: Archive) -> tuple[str, ...]:
    value = part.get("files")
    if not isinstance(value, list) or len(value) != count or not all(
            isinstance(name, str) for name in value):
        raise archive.damaged(f"files = {value!r:.40}; needed are {count} names")
    return tuple(value)
