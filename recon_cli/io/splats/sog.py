"""The .sog of PlayCanvas, version 2: a zip of lossless images, about 15 times below a .ply.

Each Gaussian is one pixel of several images of one size, rows from the top left. Positions are 16
bits an axis of sign(x) ln(1 + |x|) between the scene's bounds; logarithms of scales, colours and
coefficients of degrees 1 and up are bytes that point into codebooks of 256 numbers; coefficients
are rows of a palette of at most 65,536. A quaternion is its three smaller components of 8 bits and,
in alpha, 252 plus the place of the greatest in wxyz. Opacity is a byte after the sigmoid. Axes are
those of the .ply that the scene would be written to.

The format is https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog, read
together with files that splat-transform writes: scales are logarithms there, quaternions wxyz.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from recon_cli.io.splats.codebooks import codebook, nearest
from recon_cli.io.splats.sog_archive import Archive, packed
from recon_cli.io.splats.sog_fields import (
    ROW,
    Bytes,
    Floats,
    Palette,
    morton,
    pack_harmonics,
    pack_means,
    pack_quats,
    unpack_harmonics,
    unpack_means,
    unpack_quats,
)
from recon_cli.io.splats.sog_meta import Meta, read_meta
from recon_cli.io.splats.values import arrays, colored_rows, logit, sigmoid
from recon_cli.scene.splats import TERMS, Splats
from recon_cli.workspace.atomic import write_bytes

_LEAST_OPACITY = 1e-6  # what PlayCanvas takes a byte of 0 for; a logit has to be finite


def write_sog(path: Path, splats: Splats, *, seed: int = 0) -> None:
    """Writes `splats` to `path`, whole or not at all; the same seed gives the same bytes.

    Gaussians are put into Morton order, those that have coefficients first. Quaternions lose their
    length, and opacities within half a 255th of 0 or 1 become that.

    Args:
        path: of the .sog.
        splats: at least one Gaussian.
        seed: of the k-means that find codebooks and palette.

    Raises:
        InputError: there are no Gaussians, or a value is not finite.
    """
    rng = np.random.default_rng(seed)
    table = arrays(splats, ".sog")
    low, high, places = pack_means(table["means"])
    plain = np.arange(len(splats)) >= len(splats.sh_rest)
    order = np.lexsort((morton(places), plain))
    table, places = {name: value[order] for name, value in table.items()}, places[order]
    scales, sh0 = codebook(table["log_scales"], rng), codebook(table["sh_dc"], rng)
    opacities = np.rint(sigmoid(table["logit_opacities"]) * 255).astype(np.uint8)
    rows: dict[str, Bytes] = {
        "means_l.webp": (places & 255).astype(np.uint8),
        "means_u.webp": (places >> 8).astype(np.uint8),
        "scales.webp": nearest(table["log_scales"], scales),
        "quats.webp": pack_quats(table["quats"]),
        "sh0.webp": np.column_stack([nearest(table["sh_dc"], sh0), opacities]),
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
        found = pack_harmonics(table["sh_rest"], len(splats.sh_rest), rng)
        meta["shN"] = {"count": found.count, "bands": found.degree, "codebook": _json(
            found.codebook), "files": ["shN_centroids.webp", "shN_labels.webp"]}
        images["shN_centroids.webp"] = found.entries
        images["shN_labels.webp"] = _image(np.column_stack([
            found.labels & 255, found.labels >> 8, np.zeros_like(found.labels)]).astype(np.uint8))
    write_bytes(path, packed(meta, images))


def _image(rows: Bytes) -> Bytes:
    """Returns the values [N, C] of the Gaussians as an image; the last fills what is left."""
    width = math.isqrt(len(rows) - 1) + 1
    height = -(-len(rows) // width)
    filled = np.pad(rows, ((0, width * height - len(rows)), (0, 0)), mode="edge")
    return filled.reshape(height, width, -1)


def _json(book: Floats) -> list[float]:
    """Returns float32 numbers with as few digits as tell them apart."""
    return [float(str(value)) for value in book]


def read_sog(path: Path) -> Splats:
    """Returns the Gaussians of a .sog as float32 tensors, in the file's order.

    Those behind the last one that has a coefficient other than zero are of degree 0.

    Raises:
        FormatError: the file is missing, damaged, of version 1, or does not hold what it promises.
    """
    archive = Archive(path)
    meta = read_meta(archive)
    archive.check_count(meta.count)
    first = archive.pixels(meta.means[0], meta.count)
    size = (first.shape[1], first.shape[0])

    def rows(name: str) -> Bytes:
        return archive.pixels(name, meta.count, size=size).reshape(-1, 4)[: meta.count]

    means = unpack_means(
        first.reshape(-1, 4)[: meta.count, :3], rows(meta.means[1])[:, :3], meta.low, meta.high)
    if not np.isfinite(means).all():
        raise archive.damaged("positions beyond any number")
    quats = unpack_quats(rows(meta.quats_file))
    if quats is None:
        raise archive.damaged("quaternions without their greatest component")
    sh0 = rows(meta.sh0_file)
    values = {
        "means": means, "quats": quats,
        "log_scales": _looked_up(rows(meta.scales_file)[:, :3], meta.scales, archive),
        "logit_opacities": logit(sh0[:, 3] / 255, _LEAST_OPACITY),
        "sh_dc": _looked_up(sh0[:, :3], meta.sh0, archive),
        "sh_rest": _read_harmonics(archive, meta, rows),
    }
    return Splats(**{name: torch.from_numpy(value.copy()) for name, value in values.items()})


def _looked_up(indices: Bytes, book: Floats, archive: Archive) -> Floats:
    if indices.max() >= len(book):
        raise archive.damaged(f"the number {indices.max()} of a codebook of {len(book)}")
    return np.asarray(book[indices])


def _read_harmonics(archive: Archive, meta: Meta, rows: Callable[[str], Bytes]) -> Floats:
    """Returns coefficients [M, T, 3]."""
    said = meta.harmonics
    if said is None:
        return np.zeros((0, 0, 3), np.float32)
    lines = -(-said.count // ROW)
    width = ROW * TERMS[said.degree]
    entries = archive.pixels(said.files[0], width * lines, size=(width, lines))[:, :, :3]
    parts = rows(said.files[1])
    labels = parts[:, 0] + 256 * parts[:, 1].astype(np.int64)
    if labels.max() >= said.count:
        raise archive.damaged(f"the label {labels.max()} of a palette of {said.count}")
    _looked_up(entries, said.codebook, archive)
    return colored_rows(unpack_harmonics(
        Palette(said.count, said.degree, said.codebook, entries, labels)))
