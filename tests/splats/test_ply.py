"""The .ply of INRIA: what we write is what it should be, and bad files are refused."""

import tracemalloc

import numpy as np
import pytest
import torch
from facts import assert_facts, raises
from scenes import random_splats, with_harmonics
from splat_cases import rewritten

from recon_cli.errors import FormatError
from recon_cli.splats.ply import read_ply, write_ply


@pytest.fixture
def splats():
    return random_splats(20, dtype=torch.float32)


def test_what_is_written_reads_back_to_the_bit(tmp_path, splats):
    write_ply(tmp_path / "a.ply", splats)
    back = read_ply(tmp_path / "a.ply")
    for name, value in splats.parameters().items():
        assert torch.equal(getattr(back, name), value), name


@pytest.mark.parametrize("colored", [1, 13, 20])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_any_degree_and_share_reads_back_to_the_bit(tmp_path, splats, degree, colored):
    few = with_harmonics(splats, degree, colored)
    write_ply(tmp_path / "a.ply", few)
    back = read_ply(tmp_path / "a.ply")
    assert back.sh_degree == degree
    for name, value in few.parameters().items():
        assert torch.equal(getattr(back, name), value), name


@pytest.mark.parametrize(("degree", "rest"), [(0, 0), (1, 9), (2, 24), (3, 45)])
def test_a_file_holds_the_coefficients_of_its_degree_and_no_more(tmp_path, splats, degree, rest):
    path = tmp_path / "a.ply"
    write_ply(path, with_harmonics(splats, degree, 7))
    head, data = path.read_bytes().split(b"end_header\n", 1)
    assert head.count(b"f_rest_") == rest
    table = np.frombuffer(data, "<f4").reshape(20, 17 + rest)
    assert (table[:7, 9:9 + rest] != 0).all()
    assert (table[7:, 9:9 + rest] == 0).all()  # they have none
    assert torch.equal(torch.from_numpy(table[:, -4:].copy()), splats.quats)


@pytest.mark.parametrize("degree", range(4))
def test_where_nobody_has_coefficients_the_file_has_none(tmp_path, splats, degree):
    path = tmp_path / "a.ply"
    write_ply(path, with_harmonics(splats, degree, 0))
    assert b"f_rest" not in path.read_bytes()
    back = read_ply(path)
    assert len(back) == 20
    assert len(back.sh_rest) == back.sh_degree == 0


def test_rows_of_zeros_between_others_stay_and_those_at_the_end_go(tmp_path, splats):
    splats.sh_rest[3] = 0
    splats.sh_rest[11:] = 0
    write_ply(tmp_path / "a.ply", splats)
    back = read_ply(tmp_path / "a.ply")
    assert torch.equal(back.sh_rest, splats.sh_rest[:11])
    assert torch.equal(back.means, splats.means)


def test_the_layout_is_the_one_of_inria(tmp_path, splats):
    path = tmp_path / "a.ply"
    write_ply(path, splats)
    head, data = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in head.decode().splitlines() if "property" in line]
    assert names[:9] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert names[9:54] == [f"f_rest_{i}" for i in range(45)]
    assert names[54:] == ["opacity", "scale_0", "scale_1", "scale_2",
                          "rot_0", "rot_1", "rot_2", "rot_3"]
    row = np.frombuffer(data, "<f4").reshape(20, 62)[3]
    assert row[:3].tolist() == splats.means[3].tolist()
    # channel-major: all of red, then green, then blue
    assert row[9:24].tolist() == splats.sh_rest[3, :, 0].tolist()
    assert row[54] == splats.logit_opacities[3]
    assert row[58:].tolist() == splats.quats[3].tolist()


def test_a_file_of_another_program_is_read(shared_data):
    folder = shared_data / "interop" / "metalsplatter" / "SplatIO" / "TestData"
    splats = read_ply(folder / "test-splat.3-points-from-train.ply")
    plain = np.frombuffer(
        (folder / "test-splat.3-points-from-train.splat").read_bytes(), np.uint8).reshape(3, 32)
    positions = plain[:, :12].copy().view("<f4")
    scales = plain[:, 12:24].copy().view("<f4")
    # .splat sorts by size; match each of its rows to the nearest of ours
    rows = torch.cdist(torch.from_numpy(positions), splats.means).argmin(1)
    assert sorted(rows.tolist()) == [0, 1, 2]
    assert torch.allclose(splats.means[rows], torch.from_numpy(positions), atol=1e-5)
    assert torch.allclose(splats.scales[rows], torch.from_numpy(scales), rtol=1e-4)
    alphas = torch.from_numpy(plain[:, 27] / 255.0).float()
    assert torch.allclose(splats.opacities[rows], alphas, atol=1.01 / 255)


def test_another_order_a_lower_degree_and_unknown_properties_are_read(tmp_path):
    names = ["rot_3", "rot_2", "rot_1", "rot_0", "extra", "opacity",
             "scale_2", "scale_1", "scale_0",
             *[f"f_rest_{i}" for i in range(9)], "f_dc_2", "f_dc_1", "f_dc_0", "z", "y", "x"]
    table = np.zeros(2, dtype=[(name, "<f8" if name == "extra" else "<f4") for name in names])
    for i, name in enumerate(names):
        table[name] = [i, i + 0.5]
    head = ["ply", "format binary_little_endian 1.0", "comment made elsewhere", "element vertex 2",
            *[f"property {'double' if n == 'extra' else 'float'} {n}" for n in names],
            "end_header\n"]
    path = tmp_path / "b.ply"
    path.write_bytes("\n".join(head).encode() + table.tobytes())
    back = read_ply(path)
    assert back.quats[0].tolist() == [3, 2, 1, 0]
    assert back.means[1].tolist() == [23.5, 22.5, 21.5]
    assert back.sh_rest[0].tolist() == [[9, 12, 15], [10, 13, 16], [11, 14, 17]]


FORMS = ["ascii", "binary_big_endian", "binary_little_endian"]


@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_read_to_the_bit(tmp_path, splats, form, kind):
    path = tmp_path / "a.ply"
    splats.quats[3] = 0  # stands for no rotation
    write_ply(path, splats)
    rewritten(path, form, kind, extra=["label", "time"], tail=b"\nend_header\r\nBODY")
    back = read_ply(path)
    for name, value in splats.parameters().items():
        assert torch.equal(getattr(back, name), value), name


@pytest.mark.parametrize("form", FORMS)
def test_elements_after_the_vertices_are_passed_over_where_their_size_is_known(
        tmp_path, splats, form):
    path = tmp_path / "a.ply"
    write_ply(path, splats)
    data = path.read_bytes()
    camera = b"1 2\n3 4\n" if form == "ascii" else bytes(8)
    tail = b"\nelement camera 2\nproperty short u\nproperty short v\nelement face 0\n"
    tail += b"property list uchar int vertex_indices\nend_header\nBODY"
    rewritten(path, form, tail=tail + camera)
    assert torch.equal(read_ply(path).means, splats.means)
    path.write_bytes(data)
    rewritten(path, form, tail=tail + camera[:4])
    with raises(FormatError, "truncated"):
        read_ply(path)


@pytest.mark.parametrize("form", FORMS)
def test_a_mesh_is_refused_by_what_it_is(tmp_path, splats, form):
    path = tmp_path / "a.ply"
    write_ply(path, splats)
    face = b"3 0 1 2\n" if form == "ascii" else b"\3" + bytes(12)
    rewritten(path, form, tail=b"\nelement face 1\nproperty list uchar int vertex_indices\n"
              b"end_header\nBODY" + face)
    with raises(FormatError, 1, "Gaussians") as caught:
        read_ply(path)
    assert "again" not in caught.value.hint  # another copy is a mesh as well


@pytest.mark.parametrize("tail", [b"\n", b"\r\n", bytes(3)])
def test_a_few_bytes_after_the_data_are_left_out_with_a_warning(tmp_path, splats, tail, caplog):
    path = tmp_path / "a.ply"
    write_ply(path, splats)
    with path.open("ab") as file:
        file.write(tail)
    assert torch.equal(read_ply(path).means, splats.means)
    assert_facts(caplog.text, len(tail), "bytes", "data")


def test_a_header_of_hundreds_of_kilobytes_is_read(tmp_path, splats):
    write_ply(tmp_path / "a.ply", splats, comments=["x" * 1000] * 300)
    assert torch.equal(read_ply(tmp_path / "a.ply").means, splats.means)
    write_ply(tmp_path / "a.ply", splats, comments=["x" * 1000] * 1100)
    with raises(FormatError):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize("form", FORMS)
def test_a_count_that_the_file_cannot_hold_takes_no_memory(tmp_path, splats, form):
    path = tmp_path / "a.ply"
    write_ply(path, splats)
    rewritten(path, form, tail=b"\nend_header\nBODY")
    path.write_bytes(path.read_bytes().replace(b"vertex 20", b"vertex 9000000000"))
    tracemalloc.start()
    try:
        with raises(FormatError, 9000000000, "vertex"):
            read_ply(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_a_failed_write_leaves_the_old_file(tmp_path, splats, monkeypatch):
    path = tmp_path / "a.ply"
    write_ply(path, splats)
    before = path.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with raises(OSError, 28):
        write_ply(path, splats.select(torch.arange(3)))
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["a.ply"]
