"""The compressed .ply of PlayCanvas and SuperSplat: 16 bytes a Gaussian, in chunks of 256.

Each chunk has the bounds of the positions, log scales and colours of its Gaussians; within them a
position or log scale has 11, 10 and 11 bits and a colour 8 per channel. Opacity has 8 bits after
the sigmoid, a rotation 2 for the index of the largest component and 10 for each of the others.
Harmonics, if any, are a third element of bytes between -4 and 4. Axes are those of the plain .ply.
Source of the layout: https://github.com/playcanvas/splat-transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.scene.backdrop import AT_ONCE
from recon_cli.scene.splat_arrays import SH_C0, TERMS, SplatArrays
from recon_cli.splats.foreign import count_terms, drop_not_finite
from recon_cli.splats.format import LoadedScene, SplatFormat, WriteSettings
from recon_cli.splats.ply import describe_settings, describe_writer, is_antialiased, read_up
from recon_cli.splats.ply_tables import Element, format_header, read_header, read_tables
from recon_cli.splats.values import (
    Bytes,
    Floats,
    compact_order,
    decode_opacities,
    decode_smallest_three,
    encode_opacities,
    encode_smallest_three,
    refuse_above,
    splats_from_arrays,
    to_arrays,
)
from recon_cli.workspace.atomic import replacing

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

_AXES, _COLORS = ("x", "y", "z"), ("r", "g", "b")
_PLACE = [f"{end}_{axis}" for end in ("min", "max") for axis in _AXES]
_SCALE = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in _AXES]
_COLOR = [f"{end}_{color}" for end in ("min", "max") for color in _COLORS]
_BOUNDS = [*_PLACE, *_SCALE, *_COLOR]
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_BITS = (11, 10, 11)
_SCALE_RANGE = 20.0  # of log scales; one of -1000 would leave the others of its chunk no bits
_MOST_CENTERS = 32  # of the views, whose mean colour the rounding leaves alone
_STEP = 1 / 32  # of a coefficient: 256 steps from -4 to 4

Words = NDArray[np.uint32]


def write_compressed_ply(
    path: Path, splats: Splats | SplatArrays, *, centers: NDArray[np.float64] | None = None,
    comments: Sequence[str] = (),
) -> None:
    """Writes `splats` to `path`, whole or not at all, in Morton order, so that chunks are compact.

    `comments` go into the header.

    Far outliers come first: in a chunk of the room they would leave the others no bits.
    The Gaussians of the room that fill the last chunk of these lose theirs, so they are the most
    transparent ones: small ones would show, as each is seen as large as a pixel at least.

    Log scales below -20 become -20, coefficients are clipped to -4 to 4, and none stays 0. Their
    rounding changes no mean colour over the `centers` [C, 3] that the scene is seen from, where
    these are known: it is taken off the base colour, whose steps are finer.
    FormatError if there are no Gaussians, one is too large, or a parameter is not finite.
    """
    values = to_arrays(splats, path.name)
    order = compact_order(values["means"], values["logit_opacities"], AT_ONCE)
    means, log_scales, quats, logits, sh_dc, sh_rest = (values[name][order] for name in (
        "means", "log_scales", "quats", "logit_opacities", "sh_dc", "sh_rest"))
    refuse_above(path, log_scales, _SCALE_RANGE)
    harmonics = _harmonic_bytes(sh_rest)
    if centers is not None and sh_rest.shape[1]:
        sh_dc = sh_dc + _mean_change(means, sh_rest - _decode_harmonics(harmonics), centers) / SH_C0
    parts = [means, np.maximum(log_scales, -_SCALE_RANGE),
             (SH_C0 * sh_dc.astype(np.float64) + 0.5).astype(np.float32)]
    bounds, (place, scale, color) = zip(*[_bound_chunks(part) for part in parts], strict=True)
    alpha = encode_opacities(logits).astype(np.uint32)
    words = np.stack([
        _join_bits(place, _BITS), _rotation_words(quats),
        _join_bits(scale, _BITS),
        _join_bits(color, (8, 8, 8)) << 8 | alpha], axis=1)
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(_header(len(splats), sh_rest.shape[1], comments))
        file.write(np.concatenate(bounds, axis=1).astype("<f4").tobytes())
        file.write(words.astype("<u4").tobytes())
        file.write(harmonics.tobytes())


def _header(n: int, terms: int, comments: Sequence[str]) -> bytes:
    rest = [f"uchar f_rest_{i}" for i in range(3 * terms)]
    return format_header({
        "chunk": (-(-n // AT_ONCE), [f"float {name}" for name in _BOUNDS]),
        "vertex": (n, [f"uint {name}" for name in _PACKED]), **({"sh": (n, rest)} if rest else {})},
        comments)


def _bound_chunks(values: Floats) -> tuple[Floats, NDArray[np.float64]]:
    """Returns the bounds [chunks, 6] of values [N, 3], and their positions in them, 0 to 1."""
    starts = np.arange(0, len(values), AT_ONCE)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    rows = np.arange(len(values)) // AT_ONCE
    width = (high.astype(np.float64) - low)[rows]
    share = (values - low[rows].astype(np.float64)) / np.where(width > 0, width, 1)
    return np.concatenate([low, high], axis=1), share


def _join_bits(shares: NDArray[np.floating], bits: tuple[int, ...]) -> Words:
    """Returns words [N] of shares [N, 3], each in that many bits, the last one lowest."""
    most = (1 << np.array(bits)) - 1
    fields = np.clip(np.rint(shares * most), 0, most).astype(np.uint32)
    return np.asarray(np.bitwise_or.reduce(fields << _shifts(bits), axis=1))


def _shifts(bits: tuple[int, ...]) -> NDArray[np.uint32]:
    return np.append(np.cumsum(bits[:0:-1])[::-1], 0).astype(np.uint32)


def _rotation_words(quats: Floats) -> Words:
    largest, others = encode_smallest_three(quats)
    shares = others / np.sqrt(2) + 0.5
    index = largest.astype(np.uint32) << np.uint32(30)
    return index | _join_bits(shares, (10, 10, 10))


def _harmonic_bytes(sh_rest: Floats) -> Bytes:
    """Returns [N, 3 T] bytes, channel-major.

    0 lies between the bytes of plus and minus 1/64, which alternate so as not to tint the scene.
    """
    steps = np.floor(sh_rest / _STEP) + 128
    turns = 127 + np.arange(len(sh_rest))[:, None, None] % 2
    steps = np.where(sh_rest == 0, turns, steps)
    flat = steps.transpose(0, 2, 1).reshape(len(sh_rest), -1)
    return np.clip(flat, 0, 255).astype(np.uint8)


def _mean_change(means: Floats, sh_rest: Floats, centers: NDArray[np.float64]) -> Floats:
    """Returns the mean [N, 3] over the centers of the colour that coefficients [N, T, 3] add."""
    import torch

    from recon_cli.scene.harmonics import basis_rest

    degree = TERMS.index(sh_rest.shape[1])
    places, rest = torch.from_numpy(means), torch.from_numpy(sh_rest)
    total = torch.zeros(len(means), 3)
    for center in torch.from_numpy(centers).float():
        directions = torch.nn.functional.normalize(places - center, dim=1)
        total += torch.einsum("nt,ntc->nc", basis_rest(directions, degree), rest)
    return (total / len(centers)).numpy()


def load_compressed_ply(path: Path) -> LoadedScene:
    """Returns the scene of a compressed .ply in its order and degree, with its comments.

    Files without bounds of colours are supported. Gaussians that are not finite are dropped and
    harmonics of degree 4 cut, with a warning. FormatError if damaged or another kind of .ply.
    """
    header = read_header(path)
    kinds = {each.name: _property_types(each) for each in header.elements}
    colored = not kinds.get("chunk", {}).keys().isdisjoint(_COLOR)
    if not (_has(kinds.get("chunk", {}), _BOUNDS if colored else _PLACE + _SCALE, "f4")
            and _has(kinds.get("vertex", {}), _PACKED, "u4")):
        raise FormatError(f"{path} is not a compressed .ply.")
    tables = read_tables(header)
    chunk, vertex = tables["chunk"], tables["vertex"]
    n = len(vertex)
    if not n or len(chunk) != -(-n // AT_ONCE):
        raise FormatError(f"{path} has {len(chunk)} chunks of {AT_ONCE} for {n} Gaussians.")
    place, rotation, scale, color = (vertex[name].astype(np.uint32) for name in _PACKED)
    shares = _split_bits(color >> np.uint32(8), (8, 8, 8))
    colors = _interpolate(chunk, _COLOR, shares) if colored else shares
    columns = drop_not_finite(path, {
        "means": _interpolate(chunk, _PLACE, _split_bits(place, _BITS)),
        "quats": _rotations(rotation),
        "log_scales": _interpolate(chunk, _SCALE, _split_bits(scale, _BITS)),
        "logit_opacities": decode_opacities((color & 255).astype(np.uint8)),
        "sh_dc": (colors - 0.5) / SH_C0,
        "sh_rest": _harmonics(path, tables, n),
    })
    return LoadedScene(
        splats_from_arrays(path, columns), read_up(header), is_antialiased(header),
        writer=describe_writer(header))


def _property_types(element: Element) -> dict[str, str]:
    """Returns the types of an element's properties, such as f4, without byte order."""
    fields = element.row.fields if element.row is not None else None
    return {name: field[0].str[1:] for name, field in (fields or {}).items()}


def _has(kinds: dict[str, str], names: list[str], kind: str) -> bool:
    return all(kinds.get(name) == kind for name in names)


def _split_bits(words: Words, bits: tuple[int, ...]) -> NDArray[np.float64]:
    """Returns [N, 3] shares of words [N]: the inverse of `_join_bits`."""
    most = (1 << np.array(bits, np.uint32)) - 1
    return (words[:, None] >> _shifts(bits) & most) / most


def _interpolate(
    chunk: NDArray[np.void], names: list[str], shares: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Returns the values of shares [N, 3] of the chunks' bounds."""
    with np.errstate(invalid="ignore"):  # bounds that are not finite make NaN, which is refused
        bounds = np.stack([chunk[name].astype(np.float64) for name in names], axis=1)
        rows = np.arange(len(shares)) // AT_ONCE
        low, high = bounds[rows, :3], bounds[rows, 3:]
        return np.asarray(low * (1 - shares) + high * shares)


def _rotations(words: Words) -> Floats:
    others = (_split_bits(words, (10, 10, 10)) - 0.5) * np.sqrt(2)
    return decode_smallest_three((words >> 30).astype(np.int64), others.astype(np.float32))


def _harmonics(path: Path, tables: dict[str, NDArray[np.void]], n: int) -> Floats:
    if "sh" not in tables:
        return np.zeros((n, 0, 3), np.float32)
    table = tables["sh"]
    kinds = dict(table.dtype.fields or {})
    names = [f"f_rest_{i}" for i in range(len(kinds))]
    if len(table) != n or set(names) != kinds.keys() or any(
            kinds[name][0] != "u1" for name in names):
        raise FormatError(f"{path} has harmonics that do not fill a degree for its Gaussians.")
    kept = min(count_terms(path, len(names)), TERMS[-1])
    return _decode_harmonics(np.stack([table[name] for name in names], axis=1))[:, :kept]


def _decode_harmonics(coded: Bytes) -> Floats:
    """Returns the coefficients [N, T, 3] of channel-major bytes [N, 3 T]."""
    steps = coded.astype(np.float32)
    steps[steps > 0] += 0.5  # a byte means the middle of its step, but 0 and 255 the ends
    steps[steps > 255] = 256
    return ((steps - 128) * np.float32(_STEP)).reshape(len(coded), 3, -1).transpose(0, 2, 1)


def _write_with(path: Path, splats: SplatArrays, settings: WriteSettings) -> None:
    from recon_cli.io.views import evenly_spread  # imports what reads images

    seen_from = evenly_spread(settings.views, _MOST_CENTERS)
    centers = np.stack([camera.center for _, camera in seen_from]) if seen_from else None
    write_compressed_ply(path, splats.with_sphere(), centers=centers,
                         comments=describe_settings(settings))


FORMAT = SplatFormat(load_compressed_ply, _write_with)
