"""Hand-written .ksplat files of each compression level are read; damaged ones are refused."""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from spark import assert_spark_agrees
from splat_cases import damaged

from recon_cli.errors import FormatError
from recon_cli.scene.splats import SH_C0, TERMS
from recon_cli.splats.registry import load_splats, read_splats

if TYPE_CHECKING:
    from browser import WatchedPage

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


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_each_compression_level_is_read(level: int, degree: int, tmp_path: Path) -> None:
    path = tmp_path / "room.ksplat"
    path.write_bytes(ksplat(level, degree))
    scene, table = load_splats(path), values(degree)
    splats = scene.splats
    assert torch.allclose(splats.means.double(), torch.tensor(table["means"]), atol=1e-5)
    assert torch.allclose(splats.scales.double(), torch.tensor(table["scales"]), rtol=1e-6)
    assert torch.allclose(splats.quats.double(), torch.tensor(table["quats"]).double())
    assert torch.allclose(
        splats.opacities, torch.tensor(table["rgba"][:, 3] / 255).float(), atol=1e-6)
    colors = SH_C0 * splats.sh_dc + 0.5
    assert torch.allclose(colors, torch.tensor(table["rgba"][:, :3] / 255).float(), atol=1e-6)
    assert splats.sh_degree == degree
    assert scene.up is None


def test_coefficients_lie_channel_after_channel_within_a_degree(tmp_path: Path) -> None:
    path = tmp_path / "room.ksplat"
    path.write_bytes(ksplat(0, 2))
    rest, sh = read_splats(path).sh_rest, values(2)["sh"]
    for channel in range(3):
        first = torch.tensor(sh[:, 3 * channel: 3 * channel + 3]).float()
        second = torch.tensor(sh[:, 9 + 5 * channel: 14 + 5 * channel]).float()
        assert torch.equal(rest[:, :3, channel], first)
        assert torch.equal(rest[:, 3:, channel], second)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_spark_reads_the_same(level: int, page: WatchedPage, tmp_path: Path) -> None:
    path = tmp_path / "room.ksplat"
    path.write_bytes(ksplat(level, 2))
    assert_spark_agrees(page, path, read_splats(path))


def test_sections_are_read_one_after_the_other(tmp_path: Path) -> None:
    path = tmp_path / "room.ksplat"
    path.write_bytes(ksplat(1, 1, sections=3))
    means = read_splats(path).means
    assert len(means) == 3 * N
    assert torch.equal(means[:N], means[2 * N:])


@pytest.mark.parametrize(("offset", "change", "said"), [
    (1, b"\2", "version 0.2"), (20, b"\3", "level 3"), (4, b"\xff\xff\xff\xff", "ends before"),
    (16, b"\x08", "states 8 Gaussians"), (4096 + 40, b"\3", "degree 3"),
    (4096, b"\xff\xff", "truncated"), (4096 + 8, b"\1", "buckets for 3"),
    (4096 + 20, b"\4", "is damaged")])
def test_a_header_that_contradicts_the_file_is_refused(
    offset: int, change: bytes, said: str, tmp_path: Path
) -> None:
    data = bytearray(ksplat(1, 0))
    data[offset: offset + len(change)] = change
    path = tmp_path / "room.ksplat"
    path.write_bytes(data)
    with pytest.raises(FormatError, match=said) as caught:
        read_splats(path)
    assert caught.value.hint


@pytest.mark.parametrize("seed", range(60))
def test_a_damaged_file_is_read_or_refused(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "room.ksplat"
    path.write_bytes(damaged(ksplat(seed % 3, 1), seed))
    with suppress(FormatError):
        assert len(read_splats(path))
