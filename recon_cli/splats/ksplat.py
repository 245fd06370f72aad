"""The .ksplat of GaussianSplats3D (mkkellogg), version 0.1: read, not written.

A header of 4096 bytes and one of 1024 for each section lie in front of the sections. A section has
buckets, which are cubes with a centre, and rows: position, standard deviations, rotation (wxyz),
RGBA (4 bytes), and the coefficients of degrees 1 and 2, channel after channel within a degree.
At compression level 0 all but the colours are float32. At level 1 and 2 they are float16, and a
position is three integers of 16 bits about the centre of its bucket; at level 2 coefficients are
bytes between the two limits in the header. The first buckets are full, the others say how many
rows they have. Axes are those of the .ply.
Source: https://github.com/mkkellogg/GaussianSplats3D, `SplatBuffer`; the order of the coefficients
is also that of the readers in Spark and splat-transform.
"""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.scene.splat_arrays import SH_C0, TERMS, SplatArrays
from recon_cli.splats.foreign import FLAT, drop_not_finite
from recon_cli.splats.format import LoadedScene, SplatFormat
from recon_cli.splats.values import decode_opacities, read_contents, splats_from_arrays

_FILE = np.dtype({
    "names": ["major", "minor", "sections", "splats", "level", "least", "most"],
    "formats": ["u1", "u1", "<u4", "<u4", "<u2", "<f4", "<f4"],
    "offsets": [0, 1, 4, 16, 20, 36, 40], "itemsize": 4096})
_SECTION = np.dtype({
    "names": ["splats", "room", "bucket_splats", "buckets", "bucket_side", "bucket_bytes",
              "steps", "full", "partial", "degree"],
    "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
    "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40], "itemsize": 1024})
# of positions, other vectors and coefficients, by compression level
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
_STEPS = 32767  # of half a bucket, where a section does not say
_LIMIT = 1.5  # of coefficients, where the header does not say
_DEGREES = 3  # 0, 1 and 2


def read_ksplat(path: Path) -> SplatArrays:
    """Returns the Gaussians of a .ksplat, section after section.

    Those that are not finite are dropped, with a warning. FormatError if the file is damaged.
    """
    data = read_contents(path)
    if len(data) < _FILE.itemsize:
        raise FormatError(f"{path} holds {len(data)} bytes, fewer than the header of a .ksplat.")
    header = np.frombuffer(data, _FILE, 1)[0]
    version, level = f"{header['major']}.{header['minor']}", int(header["level"])
    if version != "0.1" or level >= len(_TYPES):
        raise FormatError(
            f"{path} states version {version} and compression level {level}; versions 0.1 and "
            "levels 0 to 2 of .ksplat are read.")
    start = _FILE.itemsize + _SECTION.itemsize * int(header["sections"])
    count = int(header["splats"])
    if start > len(data):
        raise FormatError(f"{path} states {header['sections']} sections, but ends before them.")
    sections = []
    for section in np.frombuffer(data, _SECTION, int(header["sections"]), _FILE.itemsize):
        values, start = _read_section(path, data, start, header, section)
        sections.append(values)
    found = sum(len(values["means"]) for values in sections)
    if found != count or not count:
        raise FormatError(f"{path} states {count:,} Gaussians, but has {found:,}.")
    return _to_splats(path, sections)


def _read_section(
    path: Path, data: bytes, start: int, header: np.void, section: np.void
) -> tuple[dict[str, NDArray[Any]], int]:
    """Returns the values of a section by name, and where it ends."""
    place, vector, harmonics = _TYPES[header["level"]]
    degree, splats, room = (int(section[name]) for name in ("degree", "splats", "room"))
    if degree >= _DEGREES:
        raise FormatError(f"{path} states harmonics of degree {degree}; a .ksplat has up to 2.")
    row = np.dtype([
        ("means", place, 3), ("scales", vector, 3), ("quats", vector, 4), ("rgba", "u1", 4),
        ("sh_rest", harmonics, 3 * TERMS[degree])])
    centres = start + 4 * int(section["partial"])
    rows = centres + int(section["bucket_bytes"]) * int(section["buckets"])
    end = rows + row.itemsize * room
    if splats > room or end > len(data):
        raise FormatError(
            f"{path} states sections that end at byte {end:,}, but has {len(data):,}: it is "
            "truncated or damaged.")
    table = np.frombuffer(data, row, splats, rows)
    means, rest = table["means"], table["sh_rest"]
    if header["level"]:
        means = _decode_means(path, data, start, section, means)
    if harmonics == "u1":
        least, most = header["least"] or -_LIMIT, header["most"] or _LIMIT
        rest = rest / np.float32(255) * (most - least) + least
    return {
        "means": means, "scales": table["scales"], "quats": table["quats"],
        "rgba": table["rgba"], "sh_rest": _by_term(rest, degree)}, end


def _decode_means(
    path: Path, data: bytes, start: int, section: np.void, steps: NDArray[np.uint16]
) -> NDArray[np.float64]:
    """Returns positions [N, 3] of their steps from the lowest corners of their buckets."""
    buckets, full, partial = (int(section[name]) for name in ("buckets", "full", "partial"))
    stride = int(section["bucket_bytes"])
    if full + partial > buckets or (buckets and stride < 3 * np.dtype(_TYPES[0][0]).itemsize):
        raise FormatError(f"{path} states {full} + {partial} of {buckets} buckets: it is damaged.")
    sizes = np.concatenate([
        np.full(full, section["bucket_splats"], np.int64),
        np.frombuffer(data, "<u4", partial, start).astype(np.int64)])
    bucket = np.searchsorted(np.cumsum(sizes), np.arange(len(steps)), side="right")
    if len(steps) and int(bucket[-1]) >= len(sizes):
        raise FormatError(f"{path} has buckets for {int(sizes.sum()):,} of {len(steps):,} "
                          "Gaussians: it is damaged.")
    centre = np.ndarray((buckets, 3), "<f4", data, start + 4 * partial, (stride, 4))
    half = int(section["steps"]) or _STEPS
    side = float(section["bucket_side"]) / 2
    means: NDArray[np.float64] = (
        (steps.astype(np.float64) - half) * (side / half) + centre[bucket])
    return means


def _by_term(rest: NDArray[Any], degree: int) -> NDArray[np.float32]:
    """Returns coefficients [N, T, 3] of rows that hold a channel after the other in each degree."""
    parts = [np.zeros((len(rest), 0, 3), np.float32)]
    for low, high in pairwise(TERMS[: degree + 1]):
        part = rest[:, 3 * low: 3 * high].astype(np.float32)
        parts.append(part.reshape(len(rest), 3, high - low).transpose(0, 2, 1))
    return np.concatenate(parts, axis=1)


def _to_splats(path: Path, sections: list[dict[str, NDArray[Any]]]) -> SplatArrays:
    terms = max(values["sh_rest"].shape[1] for values in sections)
    for values in sections:
        missing = terms - values["sh_rest"].shape[1]
        values["sh_rest"] = np.pad(values["sh_rest"], ((0, 0), (0, missing), (0, 0)))
    columns = drop_not_finite(path, {
        name: np.concatenate([values[name] for values in sections]) for name in sections[0]})
    if (columns["scales"] < 0).any():
        raise FormatError(f"{path} holds negative scales: it is damaged or not a .ksplat file.")
    return splats_from_arrays(path, {
        "means": columns["means"], "quats": columns["quats"],
        "log_scales": np.log(np.maximum(columns["scales"].astype(np.float32), math.exp(FLAT))),
        "logit_opacities": decode_opacities(columns["rgba"][:, 3]),
        "sh_dc": (columns["rgba"][:, :3] / 255 - 0.5) / SH_C0,
        "sh_rest": columns["sh_rest"]})


FORMAT = SplatFormat(load=lambda path: LoadedScene(read_ksplat(path)))
