"""Hand-written .ksplat files of each compression level are read."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import torch
from ksplat_writer import N, ksplat, values
from spark import assert_spark_agrees

from recon_cli.scene.splats import SH_C0
from recon_cli.splats.registry import load_splats, read_splats

if TYPE_CHECKING:
    from browser import WatchedPage

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
