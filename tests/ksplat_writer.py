"""Writes .ksplat files of each compression level by hand."""

from __future__ import annotations

import struct

import numpy as np

from recon_cli.scene.splats import TERMS

N, FULL = 7, 3  # two full buckets of three, and one more with the last Gaussian
CENTRES = np.array([[1.0, 2, 3], [-4, 0, 5], [100, 0, 0]], np.float32)
SIDE, STEPS = 5.0, 32767
LEAST, MOST = -0.75, 1.25  # of the coefficients at level 2


def values(degree: int) -> dict[str, np.ndarray]:
    """Gaussians whose numbers float16, and the steps of buckets and bytes, hold exactly."""
    rng = np.random.default_rng(1)
    bucket = np.minimum(np.arange(N) // FULL, 2)
    steps = rng.integers(0, 2 * STEPS, (N, 3))
    means = (steps - STEPS) * (SIDE / 2 / STEPS) + CENTRES[bucket]
    sh = rng.integers(0, 256, (N, 3 * TERMS[degree])) / 255 * (MOST - LEAST) + LEAST
    quats = np.array([[3, 4, 0, 0], [0, 3, 4, 0], [4, 0, 3, 0], [5, 0, 0, 0]]) / 5
    return {
        "steps": steps, "means": means, "scales": 2.0 ** rng.integers(-9, 2, (N, 3)),
        "quats": quats[np.arange(N) % 4].astype(np.float16),
        "rgba": rng.integers(1, 255, (N, 4)), "sh": sh}


def ksplat(level: int, degree: int, *, sections: int = 1) -> bytes:
    """The bytes of a file with the same section once or more."""
    table, kinds = values(degree), (("<f4", "<f4"), ("<f2", "<f2"), ("<f2", "u1"))[level]
    sh = table["sh"]
    if level == 2:
        sh = np.rint((sh - LEAST) / (MOST - LEAST) * 255)
    rows = b"".join(
        (table["means"] if level == 0 else table["steps"])[at].astype(
            "<f4" if level == 0 else "<u2").tobytes()
        + table["scales"][at].astype(kinds[0]).tobytes()
        + table["quats"][at].astype(kinds[0]).tobytes()
        + table["rgba"][at].astype("u1").tobytes() + sh[at].astype(kinds[1]).tobytes()
        for at in range(N))
    data = struct.pack("<I", N - 2 * FULL) + CENTRES.tobytes() + rows
    header = bytearray(4096)
    header[:2] = 0, 1
    struct.pack_into("<IIIIH", header, 4, sections, sections, sections * N, sections * N, level)
    struct.pack_into("<ff", header, 36, LEAST, MOST)
    section = bytearray(1024)
    struct.pack_into("<IIIIfH", section, 0, N, N, FULL, 3, SIDE, 12)
    struct.pack_into("<IIIIH", section, 24, STEPS, len(data), 2, 1, degree)
    return bytes(header + section * sections + data * sections)
