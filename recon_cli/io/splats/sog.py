"""The .sog of PlayCanvas, version 2: a zip of lossless images, about 15 times smaller than a .ply.

Each Gaussian is one pixel of several images of one size, rows from the top left. Positions are 16
bits an axis of sign(x) ln(1 + |x|) between the scene's bounds; logarithms of scales, colours and
coefficients of degrees 1 and up are bytes that point into codebooks of 256 numbers; coefficients
are rows of a palette of at most 65,536. A quaternion is its three smaller components of 8 bits and,
in alpha, 252 plus the index of the greatest in wxyz. Opacity is a byte after the sigmoid. Axes are
those of the .ply that the scene would be written to.

Source: https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, read
together with files that splat-transform writes: scales are logarithms there, quaternions wxyz.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.splats.codebooks import fit_codebook, fit_palette, nearest_entries
from recon_cli.io.splats.sog_archive import Archive, Meta, pack_archive, read_meta
from recon_cli.io.splats.values import (
    Bytes,
    Floats,
    decode_smallest_three,
    encode_smallest_three,
    logit,
    morton_codes,
    sigmoid,
    splats_from_arrays,
    to_arrays,
)
from recon_cli.scene.splats import TERMS, Splats
from recon_cli.workspace.atomic import write_bytes

_LEAST_OPACITY = 1e-6  # that PlayCanvas reads for a byte of 0; a logit has to be finite
ROW = 64  # palette entries in a row of their image
_STEPS = 65535  # of a position along an axis
_TAG = 252  # of a quaternion whose greatest component is w
_ROOT2 = math.sqrt(2)  # only the greatest component of a unit quaternion exceeds 1 / sqrt(2)
_MAX_ENTRIES = 65535  # of a palette, besides one of zeros
# Gaussians per entry. A scene of photos with 60,000 (fox, degree 3) loses .15, .19, .25 and .33 dB
# with 4, 8, 16 and 32, and takes 23.7, 18.7, 16.1 and 14.7 bytes each.
_SHARE = 16
Doubles = NDArray[np.float64]


def write_sog(path: Path, splats: Splats, *, seed: int = 0) -> None:
    """Writes `splats` to `path`, whole or not at all; the same seed gives the same bytes.

    Gaussians are sorted in Morton order, those that have coefficients first. Quaternions are
    normalized, and opacities are rounded to 255ths. `seed` is of the k-means that finds codebooks
    and palette. FormatError if there are no Gaussians, or a value is not finite.
    """
    rng = np.random.default_rng(seed)
    table = to_arrays(splats, ".sog")
    low, high, places = pack_means(table["means"])
    plain = np.arange(len(splats)) >= len(splats.sh_rest)
    order = np.lexsort((morton_codes(places.astype(np.uint64)), plain))
    table, places = {name: value[order] for name, value in table.items()}, places[order]
    scales, sh0 = fit_codebook(table["log_scales"], rng), fit_codebook(table["sh_dc"], rng)
    opacities = np.rint(sigmoid(table["logit_opacities"]) * 255).astype(np.uint8)
    rows: dict[str, Bytes] = {
        "means_l.webp": (places & 255).astype(np.uint8),
        "means_u.webp": (places >> 8).astype(np.uint8),
        "scales.webp": nearest_entries(table["log_scales"], scales),
        "quats.webp": pack_quats(table["quats"]),
        "sh0.webp": np.column_stack([nearest_entries(table["sh_dc"], sh0), opacities]),
    }
    meta: dict[str, Any] = {
        "version": 2, "asset": {"generator": "recon"}, "count": len(splats), "antialias": False,
        "means": {"mins": low.tolist(), "maxs": high.tolist(),
                  "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _json(scales), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _json(sh0), "files": ["sh0.webp"]},
    }
    images = {name: _image(row) for name, row in rows.items()}
    if table["sh_rest"].size:
        meta["shN"], palette = pack_harmonics(table["sh_rest"], len(splats.sh_rest), rng)
        images |= palette
    write_bytes(path, pack_archive(meta, images))


def _image(rows: Bytes) -> Bytes:
    """Returns the values [N, C] of the Gaussians as an image, padded with the last."""
    width = math.isqrt(len(rows) - 1) + 1
    height = -(-len(rows) // width)
    filled = np.pad(rows, ((0, width * height - len(rows)), (0, 0)), mode="edge")
    return filled.reshape(height, width, -1)


def _json(book: Floats) -> list[float]:
    """Returns float32 numbers with the fewest digits that round-trip."""
    return [float(str(value)) for value in book]


def read_sog(path: Path) -> Splats:
    """Returns the Gaussians of a .sog as float32 tensors, in the file's order.

    Those behind the last one that has a coefficient other than zero are of degree 0. FormatError if
    the file is missing, damaged, of version 1, or does not hold what it promises.
    """
    archive = Archive(path)
    meta = read_meta(archive)
    archive.check_count(meta.count)
    first = archive.pixels(meta.means[0], meta.count)
    size = (first.shape[1], first.shape[0])

    def rows(name: str) -> Bytes:
        return archive.pixels(name, meta.count, size=size).reshape(-1, 4)[: meta.count]

    low_bytes, high_bytes = first.reshape(-1, 4)[: meta.count, :3], rows(meta.means[1])[:, :3]
    quats = rows(meta.quats_file)
    if (quats[:, 3] < _TAG).any():
        raise archive.error("quaternions without their greatest component")
    sh0 = rows(meta.sh0_file)
    return splats_from_arrays(path, {
        "means": unpack_means(low_bytes, high_bytes, meta.low, meta.high),
        "quats": decode_smallest_three(
            quats[:, 3].astype(np.int64) - _TAG, (quats[:, :3] / 255 * 2 - 1) / _ROOT2),
        "log_scales": _look_up(rows(meta.scales_file)[:, :3], meta.scales, archive),
        "logit_opacities": logit(sh0[:, 3] / 255, _LEAST_OPACITY),
        "sh_dc": _look_up(sh0[:, :3], meta.sh0, archive),
        "sh_rest": _read_harmonics(archive, meta, rows),
    })


def _look_up(indices: Bytes, book: Floats, archive: Archive) -> Floats:
    if indices.max() >= len(book):
        raise archive.error(f"the number {indices.max()} of a codebook of {len(book)}")
    return np.asarray(book[indices])


def _read_harmonics(archive: Archive, meta: Meta, rows: Callable[[str], Bytes]) -> Floats:
    """Returns coefficients [M, T, 3]."""
    harmonics = meta.harmonics
    if harmonics is None:
        return np.zeros((0, 0, 3), np.float32)
    lines = -(-harmonics.count // ROW)
    width = ROW * TERMS[harmonics.degree]
    entries = archive.pixels(harmonics.files[0], width * lines, size=(width, lines))[:, :, :3]
    parts = rows(harmonics.files[1])
    labels = parts[:, 0] + 256 * parts[:, 1].astype(np.int64)
    if labels.max() >= harmonics.count:
        raise archive.error(f"the label {labels.max()} of a palette of {harmonics.count}")
    coefficients = _look_up(entries, harmonics.codebook, archive)
    return np.asarray(coefficients.reshape(-1, TERMS[harmonics.degree], 3)[labels])


def pack_means(means: Floats) -> tuple[Doubles, Doubles, NDArray[np.int64]]:
    """Returns the least and greatest logarithms [3] and 16-bit positions [N, 3] between them."""
    wide = means.astype(np.float64)
    logs = np.copysign(np.log1p(np.abs(wide)), wide)
    low, high = logs.min(axis=0), logs.max(axis=0)
    span = np.where(high > low, high - low, 1)
    return low, high, np.rint((logs - low) / span * _STEPS).astype(np.int64)


def unpack_means(low_bytes: Bytes, high_bytes: Bytes, low: Doubles, high: Doubles) -> Floats:
    """Returns positions [N, 3]; infinite if the bounds are out of range."""
    steps = low_bytes.astype(np.float64) + 256.0 * high_bytes
    logs = low + (high - low) * (steps / _STEPS)
    with np.errstate(over="ignore"):
        return np.copysign(np.expm1(np.abs(logs)), logs).astype(np.float32)


def pack_quats(quats: Floats) -> Bytes:
    """Returns unit quaternions [N, 4] as the three smaller components and a tag [N, 4]."""
    greatest, others = encode_smallest_three(quats)
    steps = np.rint((others.astype(np.float64) * _ROOT2 + 1) / 2 * 255).clip(0, 255)
    return np.column_stack([steps, _TAG + greatest]).astype(np.uint8)


def pack_harmonics(
    sh_rest: Floats, colored: int, rng: np.random.Generator
) -> tuple[dict[str, Any], dict[str, Bytes]]:
    """Returns the entry of meta.json and the images of coefficients [N, T, 3].

    The first `colored` Gaussians have any; the others share an entry of zeros, and the codebook
    holds 0 for it.
    """
    n, terms = sh_rest.shape[:2]
    size = min(_MAX_ENTRIES, -(-colored // _SHARE))
    entries, labels = fit_palette(sh_rest[:colored].reshape(colored, -1), size, rng)
    # Neighbours in space get neighbouring numbers, so that both images compress.
    order = np.argsort(np.bincount(labels, np.arange(colored)) / np.bincount(labels))
    labels, entries = np.argsort(order)[labels], entries[order]
    if colored < n:
        labels = np.append(labels, np.full(n - colored, len(entries)))
        entries = np.concatenate([entries, np.zeros((1, entries.shape[1]), np.float32)])
    book = fit_codebook(entries, rng)
    book[np.abs(book).argmin()] = 0
    lines = -(-len(entries) // ROW)
    filled = np.pad(entries, ((0, lines * ROW - len(entries)), (0, 0)))
    pixels = nearest_entries(filled, book).reshape(lines, ROW * terms, 3)
    rows = np.column_stack([labels & 255, labels >> 8, np.zeros_like(labels)]).astype(np.uint8)
    names = ["shN_centroids.webp", "shN_labels.webp"]
    return {"count": len(entries), "bands": TERMS.index(terms), "codebook": _json(book),
            "files": names}, dict(zip(names, (pixels, _image(rows)), strict=True))
