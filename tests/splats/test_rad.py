"""Files laid out as Spark writes .rad are read in every encoding.

What is written is read back, by Spark too.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import archive_splats
import numpy as np
import pytest
import torch
from facts import raises
from rad_writer import DEFAULT, FLOATS, HALVES, OTHERS, N, chunk, rad, values
from scipy.spatial import cKDTree
from spark import assert_spark_agrees, decode
from splat_cases import rotation_error

from recon_cli.errors import FormatError
from recon_cli.scene.splats import SH_C0, Splats
from recon_cli.splats.merge_tree import build_tree
from recon_cli.splats.rad import write_rad
from recon_cli.splats.registry import load_splats, read_splats

if TYPE_CHECKING:
    from browser import WatchedPage

@pytest.mark.parametrize(("encodings", "error"), [
    (FLOATS, 1e-6), (HALVES, 5e-3), (DEFAULT, 5e-2), (OTHERS, 5e-2)])
def test_every_encoding_is_read(encodings: dict[str, str], error: float, tmp_path: Path) -> None:
    path, table = tmp_path / "room.rad", values()
    path.write_bytes(rad([chunk(table, encodings)], N))
    scene = load_splats(path)
    splats = scene.splats
    assert scene.writer == "made by hand"
    expected = {
        "means": table["center"], "log_scales": np.log(table["scales"]),
        "quats": table["orientation"][:, [3, 0, 1, 2]],
        "sh_rest": np.concatenate(
            [table[f"sh{degree}"] for degree in (1, 2, 3)], axis=1).reshape(N, 15, 3)}
    for name, value in expected.items():
        assert abs(getattr(splats, name).numpy() - value).max() < error, name
    assert abs(splats.opacities.numpy() - table["alpha"][:, 0]).max() < error
    assert abs((SH_C0 * splats.sh_dc + 0.5).numpy() - table["rgb"]).max() < error


@pytest.mark.parametrize("encodings", [FLOATS, HALVES, DEFAULT, OTHERS])
def test_spark_reads_the_same(
    encodings: dict[str, str], page: WatchedPage, tmp_path: Path
) -> None:
    path = tmp_path / "room.rad"
    path.write_bytes(rad([chunk(values(), encodings)], N))
    assert_spark_agrees(page, path, read_splats(path))


def test_of_a_tree_the_ends_are_read_from_all_chunks(tmp_path: Path) -> None:
    table = values() | {
        "child_count": np.array([[2], [0], [3], [0], [0], [0]]), "child_start": np.ones((N, 1))}
    encodings = FLOATS | {"child_count": "u16", "child_start": "u32"}
    parts = [{name: value[rows] for name, value in table.items()}
             for rows in (slice(4), slice(4, None))]
    path = tmp_path / "room.rad"
    path.write_bytes(rad([chunk(part, encodings) for part in parts], N, lodTree=True))
    means = read_splats(path).means
    assert torch.equal(means, torch.tensor(table["center"][[1, 3, 4, 5]]).float())


def test_coefficients_may_lie_in_a_palette(tmp_path: Path) -> None:
    table = values()
    palette = {f"sh{degree}_code": table.pop(f"sh{degree}")[:2] for degree in (1, 2, 3)}
    labels = np.array([[0], [1], [1], [0], [1], [0]])
    path = tmp_path / "room.rad"
    path.write_bytes(rad([
        chunk({**table, **palette, "sh_label": labels}, FLOATS | {"sh_label": "u16"})],
        N, shCodeCount=2))
    rest = read_splats(path).sh_rest
    assert torch.equal(rest[1], rest[4])
    assert torch.equal(rest[3, :3].ravel(), torch.tensor(palette["sh1_code"][0]).float())
    path.write_bytes(rad([
        chunk({**table, **palette, "sh_label": labels + 1}, FLOATS | {"sh_label": "u16"})],
        N, shCodeCount=2))
    with raises(FormatError, 2, "label"):
        read_splats(path)


def nearest(splats: Splats, others: Splats) -> torch.Tensor:
    """The number of the Gaussian of `others` at the place of each of `splats`."""
    distance, found = cKDTree(others.means.numpy()).query(splats.means.numpy())
    assert distance.max() == 0
    return torch.from_numpy(found)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_what_is_written_is_read_back(degree: int, tmp_path: Path) -> None:
    splats, path = archive_splats.room(700, degree=degree), tmp_path / "room.rad"
    write_rad(path, splats)
    scene = load_splats(path)
    assert scene.writer == "recon"
    again = scene.splats.select(nearest(splats, scene.splats))
    assert torch.equal(again.means, splats.means)
    assert (again.log_scales - splats.log_scales).abs().max() < 5e-3
    assert (again.opacities - splats.opacities).abs().max() < 1.1e-3
    assert (again.sh_dc - splats.sh_dc).abs().max() < 5e-3
    if degree:
        most = splats.sh_rest.abs().max()
        assert (again.sh_rest - splats.sh_rest).abs().max() <= most / 127
    assert rotation_error(again, splats) < 1e-3


@pytest.mark.integration
def test_more_than_a_chunk_is_written_and_read(tmp_path: Path) -> None:
    splats, path = archive_splats.room(70_000, degree=0), tmp_path / "room.rad"
    write_rad(path, splats)
    assert path.read_bytes().count(b"RADC") == 2
    assert torch.equal(
        read_splats(path).means.sort(dim=0).values, splats.means.sort(dim=0).values)


def test_spark_finds_every_gaussian_of_a_written_file(page: WatchedPage, tmp_path: Path) -> None:
    splats, path = archive_splats.room(300, degree=1), tmp_path / "room.rad"
    write_rad(path, splats)
    rows, _ = decode(page, path)
    assert len(rows) == len(build_tree(splats).splats)
    distance, _ = cKDTree(np.array(rows)[:, :3]).query(splats.means.numpy())
    assert distance.max() < 2e-2  # it packs centres into float16


@pytest.mark.parametrize(("change", "said"), [
    ({"means": float("nan")}, "finite"), ({"sh_dc": 1e6}, "float16")])
def test_what_cannot_be_written_is_refused_and_leaves_no_file(
    change: dict[str, float], said: str, tmp_path: Path
) -> None:
    splats = archive_splats.room(20, degree=0)
    for name, value in change.items():
        getattr(splats, name)[3] = value
    with raises(FormatError, said):
        write_rad(tmp_path / "room.rad", splats)
    assert not list(tmp_path.iterdir())
