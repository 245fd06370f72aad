"""A backdrop in a .ply: Gaussians for other programs, a backdrop for ours."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import random_splats, with_harmonics

from recon_cli.scene.backdrop import SPHERE_GAUSSIANS, Backdrop
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import SH_C0, transformed
from recon_cli.splats.ply import max_gaussians, read_ply, write_ply
from recon_cli.splats.ply_tables import read_header, read_tables

BACKDROP = Backdrop(0.33, 0.4, 1 / 3, 1.0, -2.0, 1e-3, 2.5)


@pytest.fixture
def splats():
    return replace(random_splats(20, dtype=torch.float32), backdrop=BACKDROP)


def same(one, other):
    return one.backdrop == other.backdrop and all(
        torch.equal(value, getattr(other, name)) for name, value in one.parameters().items())


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_it_reads_back_as_it_was(tmp_path, splats, degree):
    path, few = tmp_path / "a.ply", with_harmonics(splats, degree, 7)
    few = replace(few, backdrop=BACKDROP)
    write_ply(path, few)
    assert same(read_ply(path).with_degree(degree), few)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_so_it_does_in_another_world(tmp_path, splats, scale):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    moved = transformed(splats, Similarity(scale, turn, np.array([1e3, 0, 0])))
    write_ply(tmp_path / "a.ply", moved)
    assert same(read_ply(tmp_path / "a.ply"), moved)


def test_other_programs_read_the_sphere_as_the_last_gaussians(tmp_path, splats):
    write_ply(tmp_path / "a.ply", splats, {"error": np.arange(20, dtype=np.float32)})
    table = read_tables(read_header(tmp_path / "a.ply"))["vertex"]
    assert len(table) == 20 + SPHERE_GAUSSIANS
    sphere = table[20:]
    for i, value in enumerate(BACKDROP.color):
        assert SH_C0 * sphere[f"f_dc_{i}"] + 0.5 == pytest.approx(value, abs=1e-6)
    away = np.stack([sphere[name] for name in "xyz"], 1) - [BACKDROP.x, BACKDROP.y, BACKDROP.z]
    assert np.linalg.norm(away, axis=1).min() > BACKDROP.reach
    assert (1 / (1 + np.exp(-sphere["opacity"]))).min() == pytest.approx(0.99, abs=1e-4)
    assert sphere["error"].tolist() == [19.0] * SPHERE_GAUSSIANS  # nothing is known of it


@pytest.mark.parametrize("wrong", [
    b"comment backdrop", b"comment backdrop 1024 a b c d e f g",
    b"comment backdrop 0 1 1 1 0 0 0 1", b"comment backdrop 1024 1 1 1 0 0 0 1",
    b"comment backdrop 1024 1 1 1 0 0 nan 1",
    b"comment backdrop 99999999 1 1 1 0 0 0 1", b"comment backdrop 1 1 1 1 0 0 0 1",
    b"comment backdrop 1024 0.33 0.4 0.33"])
def test_a_comment_that_says_nothing_leaves_the_sphere_alone(tmp_path, splats, wrong):
    path = tmp_path / "a.ply"
    write_ply(path, splats)
    head, data = path.read_bytes().split(b"comment backdrop ", 1)
    path.write_bytes(head + wrong + b"\n" + data.split(b"\n", 1)[1])
    back = read_ply(path)
    assert (len(back), back.backdrop) == (20 + SPHERE_GAUSSIANS, None)


def test_a_sphere_that_a_program_changed_stays_what_it_made_of_it(tmp_path, splats):
    path = tmp_path / "a.ply"
    write_ply(path, replace(splats.with_sphere().select(torch.arange(300)), backdrop=BACKDROP))
    head, data = path.read_bytes().split(b"end_header\n", 1)
    total = 300 + SPHERE_GAUSSIANS
    row = len(data) // total
    head = head.replace(f"vertex {total}".encode(), f"vertex {total - 1}".encode())
    path.write_bytes(head + b"end_header\n" + data[:-row])  # one was deleted
    back = read_ply(path)
    assert (len(back), back.backdrop) == (total - 1, None)


@pytest.mark.parametrize("size", [0, 1000, 150_000, 200_000, 1_000_000])
def test_a_limit_in_bytes_counts_the_sphere(tmp_path, size):
    count = max_gaussians(size, 3, BACKDROP)
    path = tmp_path / "a.ply"
    for n in (count, count + 1)[count == 0:]:
        write_ply(path, replace(
            with_harmonics(random_splats(n, dtype=torch.float32), 3, n), backdrop=BACKDROP))
        assert (path.stat().st_size <= size) == (n == count)
