"""SPZ, Niantic's compact format: 20 bytes a Gaussian and one for each coefficient, then packed.

https://github.com/nianticlabs/spz. Positions are fixed point numbers of 24 bits, log scales and
colours bytes, opacities bytes after the sigmoid, rotations the smallest three components of the
quaternion (bytes of x, y and z in version 2), harmonics bytes of 1/128. Axes are RUB (y up) where
the .ply and the scenes here are RDF: y and z are negated on the way, with the rotations and
harmonics that go along.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.splats.spz_container import SpzHeader, pack, unpack
from recon_cli.io.splats.values import (
    Bytes,
    Floats,
    as_splats,
    contents,
    from_smallest_three,
    logits_of_bytes,
    nearest_bytes,
    opacity_bytes,
    refuse_above,
    smallest_three,
    turned_about_x,
    writable,
)
from recon_cli.scene.splats import TERMS, Splats
from recon_cli.workspace.atomic import write_bytes

_FRACTIONAL_BITS = (8, 12)  # fewest and most that are written; 12 is Niantic's
_MOST = (1 << 23) - 1  # of a position, in fractions
_SCALE_STEPS, _SCALE_OFFSET = 16, 10  # byte = (log scale + 10) * 16
_LARGEST_SCALE = 255 / _SCALE_STEPS - _SCALE_OFFSET
_COLOR = 0.15  # byte = (0.15 * dc + 0.5) * 255, so that dc of -3.33 to 3.33 fit
_HARMONIC = 128
# In steps of 2 of the 256: a trained scene of degree 3 packs to 1/8.2 of its .ply in place of 1/7.0
# and loses nothing that shows (.003 dB); in steps of 4 it loses .2 dB. Niantic's program takes 8
# and 16.
_HARMONIC_STEP = 2
_MAGNITUDE = 511  # of a component of a rotation; 9 bits and a sign
_WXYZ, _XYZW = [3, 0, 1, 2], [1, 2, 3, 0]


VERSIONS = (2, 3, 4)  # that are read and written


def write_spz(path: Path, splats: Splats, *, version: int = 3) -> None:
    """Writes `splats` to `path`, whole or not at all; see `spz_bytes`.

    Raises:
        FormatError: there are no Gaussians, one is too large or too far away, or a parameter is
            not finite.
    """
    write_bytes(path, spz_bytes(path, splats, version=version))


def spz_bytes(
    path: Path, splats: Splats, *, version: int = 3, harmonic_step: int = _HARMONIC_STEP
) -> bytes:
    """Returns `splats` as an SPZ file.

    Log scales below -10 become -10, coefficients outside -1 to 127/128 and dc outside -3.33 to 3.33
    are clipped. Positions get the 12 fractional bits of Niantic's program, fewer in a scene that
    is wider than 2048 units, and never fewer than 8. Harmonics are in steps of 1/64 unless given.

    Args:
        path: of the file that they are for, for messages.
        splats: of any degree.
        version: 3, which all readers of today know; 2, for older ones, with coarser rotations;
            or 4.
        harmonic_step: in 1/128; 1 is the finest.

    Raises:
        FormatError: there are no Gaussians, one is too large or too far away, or a parameter is
            not finite.
    """
    if version not in VERSIONS:
        raise ValueError(f"version {version} of SPZ is not written, {VERSIONS} are")
    values = turned_about_x(writable(path, splats))
    means, quats, log_scales = (
        value.numpy() for value in (values.means, values.quats, values.log_scales))
    refuse_above(path, log_scales, _LARGEST_SCALE)
    bits = _fractional_bits(path, means)
    return pack(SpzHeader(version, len(splats), values.sh_degree, bits), [
        _position_bytes(means, bits),
        opacity_bytes(values.logit_opacities.numpy()),
        nearest_bytes(255 * (_COLOR * values.sh_dc.numpy() + 0.5)),
        nearest_bytes(_SCALE_STEPS * (log_scales + _SCALE_OFFSET)),
        _vector_bytes(quats) if version < 3 else _rotation_bytes(quats),
        nearest_bytes(_HARMONIC + harmonic_step * np.rint(
            values.sh_rest.numpy() * (_HARMONIC / harmonic_step))),
    ])


def read_spz(path: Path) -> Splats:
    """Returns the Gaussians of an SPZ file of version 2, 3 or 4, in the file's order and degree.

    Raises:
        FormatError: the file is missing, damaged, of another format or version, or promises more
            than it holds.
    """
    return spz_splats(path, contents(path))


def spz_splats(path: Path, data: bytes) -> Splats:
    """Returns the Gaussians of an SPZ file whose bytes are there already; see `read_spz`."""
    header, (places, opacities, colors, scales, rotations, harmonics) = unpack(path, data)
    n = header.count
    shape = (n, TERMS[header.sh_degree], 3)
    return turned_about_x(as_splats(path, {
        "means": _positions(places, header.fractional_bits),
        "quats": _rotations(rotations.reshape(n, -1)),
        "log_scales": _floats(scales).reshape(n, 3) / _SCALE_STEPS - _SCALE_OFFSET,
        "logit_opacities": logits_of_bytes(opacities),
        "sh_dc": (_floats(colors).reshape(n, 3) / 255 - 0.5) / _COLOR,
        "sh_rest": (_floats(harmonics).reshape(shape) - _HARMONIC) / _HARMONIC,
    }))


def _floats(data: Bytes) -> Floats:
    return data.astype(np.float32)


def _fractional_bits(path: Path, means: Floats) -> int:
    """Returns the most fractional bits with which every position fits."""
    farthest = float(np.abs(means).max())
    fewest, most = _FRACTIONAL_BITS
    for bits in range(most, fewest - 1, -1):
        if np.rint(farthest * 2.0**bits) <= _MOST:
            return bits
    raise FormatError(
        f"A Gaussian lies {farthest:g} units from the origin, too far for {path}: up to "
        f"{_MOST / 2.0**fewest:.0f} fit.", hint="Remove it, scale the scene down, or write a .ply.")


def _position_bytes(means: Floats, bits: int) -> Bytes:
    fixed = np.rint(means.astype(np.float64) * 2.0**bits).astype("<i4")
    return fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]


def _positions(data: Bytes, bits: int) -> Floats:
    wide = np.zeros((len(data) // 9, 3, 4), np.uint8)
    wide[:, :, 1:] = data.reshape(-1, 3, 3)
    fixed = wide.view("<i4")[:, :, 0] >> 8  # the shift carries the sign down
    return (fixed / 2.0**bits).astype(np.float32)


def _rotation_bytes(quats: Floats) -> Bytes:
    """Returns [N, 4] bytes of unit quaternions wxyz; in the file components are in order xyzw."""
    largest, others = smallest_three(quats[:, _XYZW])
    magnitude = np.rint(np.abs(others) * (np.sqrt(2) * _MAGNITUDE)).astype(np.uint32)
    fields = np.minimum(magnitude, _MAGNITUDE) | np.uint32(512) * (others < 0)
    words = largest.astype(np.uint32) << 30 | fields[:, 0] << 20 | fields[:, 1] << 10 | fields[:, 2]
    return np.ascontiguousarray(words, "<u4").view(np.uint8).reshape(-1, 4)


def _vector_bytes(quats: Floats) -> Bytes:
    """Returns [N, 3] bytes of x, y and z, where w is at least 0."""
    return nearest_bytes(np.where(quats[:, :1] < 0, -1, 1) * quats[:, 1:] * 127.5 + 127.5)


def _rotations(data: Bytes) -> Floats:
    """Returns quaternions wxyz from [N, 4] bytes, or from the [N, 3] of version 2."""
    if data.shape[1] == 3:
        vector = _floats(data) / 127.5 - 1
        real = np.sqrt(np.maximum(0, 1 - (vector * vector).sum(axis=1, keepdims=True)))
        return np.concatenate([real, vector], axis=1)
    word = np.ascontiguousarray(data).view("<u4")
    fields = word >> np.array([20, 10, 0], np.uint32) & 1023
    sizes = (fields & _MAGNITUDE) / (np.sqrt(2) * _MAGNITUDE)
    others = np.where(fields & 512, -sizes, sizes).astype(np.float32)
    largest: NDArray[np.int64] = (word[:, 0] >> 30).astype(np.int64)
    return from_smallest_three(largest, others)[:, _WXYZ]
