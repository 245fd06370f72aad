"""Checks, orders and encodings of Gaussians that several splat formats share."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.scene.splat_arrays import Floats as Floats
from recon_cli.scene.splat_arrays import SplatArrays
from recon_cli.scene.voxels import BITS
from recon_cli.splats.axes import UP

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

HUGE = 0.1  # of the distance from the middle, at least of the radius
WIDE = 10.0  # times the size of the bulk: the room is a dot in a viewer that shows all
BULK = 0.9  # share of the Gaussians that determines the size of a scene; some lie far away
_BULK_BOX = (0.05, 0.95)  # quantiles along each axis, between which the bulk lies
_FAR = 10.0  # times the median distance of all from their middle
_SHELL = 1.5  # outer distance over the inner one
_LARGEST = float(np.finfo(np.float32).max)
# Limits of what a file unpacks to. A .spz whose harmonics are all 0 reaches 5 times its size.
HARMLESS_BYTES, MAX_RATIO = 1 << 24, 128
MOST_PARTS = 1 << 16  # of a scene: files or chunks
MOST_HEAD_BYTES = 1 << 20  # of what describes a file; most need a hundredth of it
Bytes = NDArray[np.uint8]


def measure_extent(means: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float64], float]:
    """Returns the middle [3] and the radius of most of the centres [N, 3]."""
    middle = np.median(means.astype(np.float64), axis=0)
    return middle, float(np.quantile(np.linalg.norm(means - middle, axis=1), BULK))


def measure_distances(means: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Returns the distances [N] of centres [N, 3] from their middle and the radius of most."""
    away = np.linalg.norm(means - lower_median(means), axis=1)
    return away, float(np.sort(away)[round(BULK * (len(away) - 1))])


def lower_median(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the median over the first axis; the lower one of the two in the middle."""
    return np.asarray(np.partition(values, (len(values) - 1) // 2, axis=0)[(len(values) - 1) // 2])


def find_bulk(
    means: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns the lowest and the highest corner [3] of the box that the bulk [N, 3] lies in."""
    low, high = (round(share * (len(means) - 1)) for share in _BULK_BOX)
    order = np.partition(means, (low, high), axis=0)
    return order[low], order[high]


def morton_order(points: NDArray[np.float32]) -> NDArray[np.int64]:
    """Returns the stable order of points [N, 3] along a Z-order curve (Morton 1966)."""
    exact = points.astype(np.float64)
    low, high = exact.min(axis=0), exact.max(axis=0)
    width = np.where(high > low, high - low, 1)
    cells = ((exact - low) / width * ((1 << BITS) - 1)).astype(np.uint64)
    return np.argsort(morton_codes(cells), kind="stable")


def compact_order(
    points: NDArray[np.float32], weights: NDArray[np.floating], chunk: int
) -> NDArray[np.int64]:
    """Returns the Morton order of points [N, 3], with the far outliers before all others.

    It comes by shells, the farthest one first: points that share a chunk with distant ones are
    left few bits for their place. The last such chunk is filled with the points of the least
    weights [N].
    """
    exact = points.astype(np.float64)
    away = np.linalg.norm(exact - np.median(exact, axis=0), axis=1)
    far = away > _FAR * np.median(away)
    near = np.flatnonzero(~far)
    spare = near[np.argsort(weights[near], kind="stable")[: -far.sum() % chunk]]
    shell = np.full(len(points), np.inf)
    shell[far] = np.floor(np.log(away.max(initial=0.0) / away[far]) / np.log(_SHELL))
    shell[spare] = len(points)  # behind all shells, before the rest
    order = morton_order(points)
    return order[np.argsort(shell[order], kind="stable")]


def morton_codes(cells: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Returns the Z-order [N] of cells [N, 3] of at most 21 bits: their bits interleaved."""
    for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                        (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    x, y, z = cells.T
    return np.asarray(x | y << np.uint64(1) | z << np.uint64(2))


def read_contents(path: Path) -> bytes:
    """Returns the bytes of a file; FormatError if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(os.fstat(file.fileno()).st_size)  # a device has no end
    except OSError as error:
        raise FormatError(f"{path} cannot be read: {error}.") from error


def describe_asset(up: str | None) -> dict[str, Any]:
    """Returns `asset` of a JSON: the program, and the axis that is up, z, -y or y, if known."""
    return {"generator": "recon", **({} if up is None else {"extras": {"up": up}})}


def read_start(path: Path, count: int) -> bytes:
    """Returns the first bytes of a file; none if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(count)
    except OSError:
        return b""


class UntrustedFile:
    """The bytes of a file and checks of the JSON in it, each of which raises FormatError."""

    def __init__(self, path: Path, start: bytes, kind: str) -> None:
        self.path = path
        try:
            with path.open("rb") as file:
                if file.read(len(start)) != start:
                    raise FormatError(f"{path} is not a {kind}.")
                self.data = start + file.read()
        except OSError as error:
            raise FormatError(f"{path} cannot be read: {error}.") from error

    def error(self, content: str) -> FormatError:
        """Returns the error for this file holding `content`."""
        return FormatError(f"{self.path} holds {content}.", hint="Write or copy the file again.")

    def check_unpacked(self, promised: int, content: str) -> None:
        """Raises FormatError if what `promised` bytes take cannot have been packed into the file.

        To be called with all that is read so far and before it is unpacked: equal places that are
        read again and again are promised again and again.
        """
        if promised > HARMLESS_BYTES + MAX_RATIO * len(self.data):
            raise self.error(f"{content}, which do not fit into its {len(self.data):,} bytes")

    def json_object(self, text: bytes) -> dict[str, Any]:
        """Returns a JSON object without NaN that is not nested too deeply."""
        def refuse_constant(name: str) -> float:
            raise ValueError(f"{name} is not a number of JSON")

        try:
            value = json.loads(text, parse_constant=refuse_constant)
        except (ValueError, RecursionError) as error:
            raise self.error(f"JSON that cannot be read: {error}") from error
        if not isinstance(value, dict):
            raise self.error("JSON that cannot be read: it is not an object")
        return value

    def generator(self, json: Mapping[str, Any]) -> str:
        """Returns the program that `asset` names, as glTF and .sog have it; empty if none."""
        asset = json.get("asset")
        name = asset.get("generator") if isinstance(asset, dict) else None
        return name if isinstance(name, str) else ""

    def up(self, json: Mapping[str, Any]) -> str | None:
        """Returns the axis that is up by `asset.extras`: z, -y or y; None if it does not say."""
        asset = json.get("asset")
        extras = asset.get("extras") if isinstance(asset, dict) else None
        axis = extras.get("up") if isinstance(extras, dict) else None
        return axis if isinstance(axis, str) and axis in UP else None

    def integer(
        self, part: Mapping[str, Any], name: str, least: int, most: int,
        *, default: int | None = None,
    ) -> int:
        """Returns an integer from `least` to `most` in an object of the JSON."""
        value = part.get(name, default)
        if type(value) is not int or not least <= value <= most:
            raise self.error(f"{name} = {value!r:.40}; needed is {least} to {most}")
        return value

    def numbers(
        self, part: Mapping[str, Any], name: str, least: int, most: int
    ) -> NDArray[np.float64]:
        """Returns a list of `least` to `most` finite numbers that fit into float32."""
        value = part.get(name)
        if not isinstance(value, list) or not least <= len(value) <= most or not all(
                type(item) in (int, float) and abs(item) <= _LARGEST for item in value):
            raise self.error(f"{name} = {value!r:.40}; needed are {most} finite numbers")
        return np.array(value, np.float64)


def splats_from_arrays(path: Path, values: Mapping[str, NDArray[Any]]) -> SplatArrays:
    """Returns the values of a file in float32, in the file's order.

    `values` are the parameters by their names in `Splats`. Gaussians behind the last one with a
    coefficient other than zero are of degree 0. FormatError if a value is not finite.
    """
    with np.errstate(over="ignore"):  # overflow becomes infinite, which is refused
        plain = {name: np.array(value, np.float32, order="C") for name, value in values.items()}
    refuse_not_finite(path, plain)
    plain["sh_rest"] = trim_zero_rows(plain["sh_rest"]).copy()
    return SplatArrays.from_parameters(plain)


def refuse_above(path: Path, log_scales: Floats, most: float) -> None:
    """Raises FormatError if a Gaussian is larger than the format can hold."""
    count = int((log_scales.max(axis=1) > most).sum())
    if count:
        raise FormatError(
            f"{count} Gaussians are too large for {path}: at most e^{most:g} units fit, the "
            f"largest has e^{log_scales.max():.1f}.",
            hint="Remove them, scale the scene down, or write a .ply.")


def encode_opacities(logits: Floats) -> Bytes:
    """Returns opacities [N] in 255 steps."""
    return round_to_bytes(255 * sigmoid(logits))


def decode_opacities(values: Bytes) -> NDArray[np.float64]:
    """Returns logits [N] of opacities in 255 steps.

    The first and last step, half as wide, are decoded as their middle: 0 and 1 have no logit.
    """
    share = np.clip(values.astype(np.float64), 0.25, 254.75) / 255
    return np.asarray(np.log(share) - np.log1p(-share))


def round_to_bytes(values: NDArray[Any]) -> Bytes:
    """Returns values rounded to bytes, clipped to 0 to 255."""
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def encode_smallest_three(quats: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Returns the index of the largest component [N] of unit quaternions [N, 4], and the others.

    q and -q are the same rotation: the sign is chosen so that the largest component is positive
    and follows from the others [N, 3], none of which is above 1 / sqrt(2).
    """
    largest = np.abs(quats).argmax(axis=1)
    value = np.take_along_axis(quats, largest[:, None], axis=1)
    signed = np.where(value < 0, -quats, quats)
    return largest, signed[_others(largest)].reshape(-1, 3)


def decode_smallest_three(largest: NDArray[np.int64], others: NDArray[np.floating[Any]]) -> Floats:
    """Returns quaternions [N, 4]: the inverse of `encode_smallest_three`."""
    quats = np.empty((len(others), 4), np.float32)
    quats[_others(largest)] = others.ravel()
    missing = np.sqrt(np.maximum(0, 1 - (others * others).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None], missing[:, None], axis=1)
    return quats


def _others(largest: NDArray[np.int64]) -> NDArray[np.bool_]:
    return np.asarray(np.arange(4) != largest[:, None])


_Float = TypeVar("_Float", bound=np.floating[Any])


def to_arrays(splats: Splats | SplatArrays, kind: str) -> dict[str, NDArray[np.float32]]:
    """Returns the raw parameters as float32 arrays by name, `sh_rest` for all N Gaussians.

    Quaternions are normalized; zeros, which mean no rotation, become 1 0 0 0. If no Gaussian has
    coefficients, `sh_rest` is [N, 0, 3]. `kind` names the file or format in messages: FormatError
    if there are no Gaussians, or a value is not finite.
    """
    if not len(splats):
        raise FormatError(f"There are no Gaussians to write; a {kind} needs at least one.")
    arrays = splats.as_arrays()
    table, rest = arrays.parameters(), arrays.sh_rest
    table["sh_rest"] = np.pad(rest[:, :rest.shape[1] if len(rest) else 0],
                              ((0, len(arrays) - len(rest)), (0, 0), (0, 0)))
    refuse_not_finite(f"The scene for a {kind}", table)
    table["quats"] = normalize_quats(table["quats"])
    return table


def refuse_not_finite(source: object, columns: Mapping[str, NDArray[Any]]) -> None:
    """Raises FormatError with the count of NaN and infinities in each column that has any."""
    bad = {name: int(np.size(value) - np.isfinite(value).sum()) for name, value in columns.items()}
    bad = {name: count for name, count in bad.items() if count}
    if bad:
        listed = ", ".join(f"{name} ({count})" for name, count in bad.items())
        raise FormatError(f"{source} holds values that are not finite in {listed}.")


def normalize_quats(quats: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Returns quaternions [N, 4] wxyz of unit length; zeros become no rotation."""
    wide = quats.astype(np.float64)
    wide[~wide.any(axis=1)] = [1, 0, 0, 0]
    # The greatest component first: the square of a tiny one underflows.
    wide /= np.abs(wide).max(axis=1, keepdims=True)
    wide /= np.linalg.norm(wide, axis=1, keepdims=True)
    return wide.astype(np.float32)


def sigmoid(logits: NDArray[np.float32]) -> NDArray[np.float64]:
    """Returns opacities in [0, 1] of logits, without overflow."""
    return np.asarray(0.5 * (1 + np.tanh(0.5 * logits.astype(np.float64))))


def logit(opacities: NDArray[np.float64], least: float) -> NDArray[np.float32]:
    """Returns the logits of opacities in [0, 1], clipped to `least` away from both ends."""
    inner = np.clip(opacities, least, 1 - least)
    return np.asarray(np.log(inner / (1 - inner)), np.float32)


def linear_from_srgb(values: NDArray[Any]) -> NDArray[np.float64]:
    """Returns linear colours of sRGB ones, both in [0, 1] (IEC 61966-2-1)."""
    exact = values.astype(np.float64)
    return np.where(exact <= 0.04045, exact / 12.92, ((exact + 0.055) / 1.055) ** 2.4)


def trim_zero_rows(sh_rest: NDArray[_Float]) -> NDArray[_Float]:
    """Returns coefficients [N, T, 3] without trailing rows of zeros."""
    rows = np.flatnonzero(sh_rest.any(axis=(1, 2)))
    return sh_rest[: rows[-1] + 1 if len(rows) else 0]
