"""The bytes of COLMAP's binary models, taken off one by one, and poses as every form has them."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError


class Reader:
    """Takes values off a file, and notices when it ends too soon or too late."""

    def __init__(self, path: Path, hint: str) -> None:
        self._path = path
        self._hint = hint
        self._at = 0
        try:
            self._data = path.read_bytes()
        except FileNotFoundError as error:
            raise FormatError(f"{path} is missing.", hint=hint) from error

    def take(self, layout: str) -> tuple[Any, ...]:
        """Returns the next values, laid out as `struct` says."""
        start = self._at
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self._data, start)

    def count(self, *, minimum: int) -> int:
        """Returns the next value, a number of entries of at least `minimum` bytes each."""
        (value,) = self.take("<Q")
        if value * minimum > len(self._data) - self._at:
            raise damaged(self._path, f"{value} entries promised", self._hint)
        return int(value)

    def text(self) -> str:
        """Returns the next text, which ends with a zero byte."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise damaged(self._path, "a name without an end", self._hint)
        value, self._at = self._data[self._at:end], end + 1
        return value.decode(errors="replace")

    def skip(self, size: int) -> None:
        """Passes over `size` bytes."""
        if self._at + size > len(self._data):
            raise damaged(self._path, f"only {len(self._data)} bytes", self._hint)
        self._at += size

    def end(self) -> None:
        """Raises FormatError when something is left."""
        if self._at != len(self._data):
            raise damaged(self._path, f"{len(self._data) - self._at} bytes too many", self._hint)


def rotation(quat: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the [3, 3] rotation of a quaternion, wxyz, of any length but zero."""
    quat = quat / np.abs(quat).max()  # so that squares stay finite
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])


def rigid(pose: Sequence[float]) -> NDArray[np.float64] | None:
    """Returns [4, 4] of a quaternion wxyz and a translation; None unless they are a pose."""
    if not np.isfinite(pose).all() or not any(pose[:4]):
        return None
    matrix = np.eye(4)
    matrix[:3, :3] = rotation(np.array(pose[:4]))
    matrix[:3, 3] = pose[4:]
    return matrix


def damaged(path: Path, what: str, hint: str) -> FormatError:
    """Returns the error for a file that ends too soon or holds what cannot be."""
    return FormatError(f"{path} is not a whole COLMAP model: {what}.", hint=hint)
