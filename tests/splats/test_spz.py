"""SPZ: each parameter within its step, axes turned, every version read, bombs and lies refused."""

import gzip
import struct

import numpy as np
import pytest
import torch
from facts import assert_facts, raises
from splat_cases import N, edge_splats, few, greatest, plain, rotation_error, unit

from recon_cli.errors import FormatError
from recon_cli.scene.harmonics import basis_rest
from recon_cli.splats.spz import load_spz, write_spz

MIB = 1 << 20
STEP = 1 / 64  # of harmonics as they are written: every other of the 256 numbers of the format


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(("degree", "colored"), [(0, N), (1, N), (2, 1), (3, N), (3, 300)])
def test_each_parameter_is_within_half_a_step(tmp_path, version, degree, colored):
    splats = edge_splats(degree, colored)
    write_spz(tmp_path / "a.spz", splats, version=version)
    back = load_spz(tmp_path / "a.spz").splats
    assert len(back) == N
    assert back.sh_degree == degree
    assert greatest(back.means, splats.means) <= 0.5 / 4096 + 1e-9
    assert greatest(back.log_scales, splats.log_scales) <= 0.5 / 16 + 1e-6
    assert greatest(back.opacities, splats.opacities) <= 0.5 / 255 + 1e-7
    assert greatest(back.sh_dc, splats.sh_dc) <= 0.5 / 255 / 0.15 + 1e-6
    if degree:
        assert len(back.sh_rest) == colored
        assert greatest(back.sh_rest, splats.sh_rest) <= 0.5 * STEP + 1e-7
    # Three components are off by half a step d at most. The largest, m = sqrt(1 - a^2 - b^2 - c^2),
    # is off by (a + b + c) d / m at most, and no component is larger than m.
    step = np.sqrt(0.5) / 511
    assert rotation_error(back, splats) <= 3 * 0.5 * step + 2 * step**2


def test_versions_hold_the_same_values(tmp_path):
    write_spz(tmp_path / "3.spz", edge_splats(), version=3)
    write_spz(tmp_path / "4.spz", edge_splats(), version=4)
    three, four = load_spz(tmp_path / "3.spz").splats, load_spz(tmp_path / "4.spz").splats
    for name, value in three.parameters().items():
        assert torch.equal(value, getattr(four, name)), name


@pytest.mark.parametrize("version", [3, 4])
def test_bytes_stay_when_a_file_is_read_and_written_again(tmp_path, version):
    write_spz(tmp_path / "a.spz", edge_splats(), version=version)
    once = load_spz(tmp_path / "a.spz").splats
    write_spz(tmp_path / "b.spz", once, version=version)
    again = load_spz(tmp_path / "b.spz").splats
    for name, value in once.parameters().items():
        if name != "quats":  # two components of one size may change places
            assert torch.equal(value, getattr(again, name)), name
    assert rotation_error(once, again) <= 2e-3


def test_the_values_in_the_file_are_those_of_the_scene(tmp_path):
    """As splat-transform, Spark and Niantic's ply_to_spz write them: nothing is turned."""
    splats = few(4)
    splats.means[:] = torch.tensor([1.0, 2.0, 4.0])
    splats.quats[:] = torch.tensor([0.8, 0.1, -0.3, 0.5])
    write_spz(tmp_path / "a.spz", splats)
    body = np.frombuffer(plain(tmp_path / "a.spz"), np.uint8)[16:]
    places, harmonics = body[:9], body[4 * 20:4 * 65].reshape(4, 15, 3)
    wide = np.zeros((3, 4), np.uint8)
    wide[:, :3] = places.reshape(3, 3)
    assert ((wide.view("<i4")[:, 0] << 8 >> 8) / 4096).tolist() == [1, 2, 4]
    assert np.abs((harmonics[0] - 128.0) / 128 - splats.sh_rest[0].numpy()).max() <= 0.5 * STEP
    # The largest component w is left out (3 of xyzw); x, y and z keep their sign.
    word = int(body[4 * 16:4 * 17].view("<u4")[0])
    fields = [word >> shift & 1023 for shift in (20, 10, 0)]
    assert word >> 30 == 3
    signs = [-1 if field & 512 else 1 for field in fields]
    sizes = [(field & 511) / 511 * np.sqrt(0.5) for field in fields]
    length = np.linalg.norm([0.8, 0.1, 0.3, 0.5])
    assert signs == [1, -1, 1]
    assert np.allclose(sizes, np.array([0.1, 0.3, 0.5]) / length, atol=1e-3)


def test_version_2_is_version_3_with_bytes_of_rotations(tmp_path):
    splats = edge_splats()
    for version in (2, 3):
        write_spz(tmp_path / f"{version}.spz", splats, version=version)
    two, three = load_spz(tmp_path / "2.spz").splats, load_spz(tmp_path / "3.spz").splats
    assert plain(tmp_path / "2.spz")[4] == 2
    for name, value in three.parameters().items():
        if name != "quats":
            assert torch.equal(getattr(two, name), value), name
    # With d = sqrt(3) / 255 the most by which (x, y, z) is off, w^2 is off by 2 d + d^2 at most,
    # and so w by the root of that, or by 1.05 d / w where w is not small.
    apart = torch.minimum(*(
        (unit(two.quats) - sign * unit(splats.quats)).norm(dim=1) for sign in (1, -1)))
    d, w = np.sqrt(3) / 255, unit(splats.quats)[:, 0].abs()
    assert apart.max() <= np.sqrt(2 * d + 2 * d**2)
    assert apart[w > 0.3].max() <= d * np.sqrt(1 + (1.05 / 0.3)**2)


def test_rotations_of_version_2_are_bytes_of_x_y_z(tmp_path):
    splats = few(3, 0)
    write_spz(tmp_path / "a.spz", splats)
    data = plain(tmp_path / "a.spz")
    body = data[16:16 + 16 * 3]
    vectors = np.array([[0, 0, 0], [0.5, -0.5, 0.5], [0, -1, 0]])
    rotations = np.rint(vectors * 127.5 + 127.5).astype(np.uint8).tobytes()
    (tmp_path / "b.spz").write_bytes(
        gzip.compress(b"NGSP" + struct.pack("<I", 2) + data[8:16] + body + rotations))
    back = load_spz(tmp_path / "b.spz").splats
    wanted = np.array([[1, 0, 0, 0], [0.5, 0.5, -0.5, 0.5], [0, 0, -1, 0]])
    assert np.allclose(back.quats, wanted, atol=1.5 / 127.5)
    assert torch.equal(back.means, load_spz(tmp_path / "a.spz").splats.means)


@pytest.mark.parametrize(("far", "bits"), [(8.0, 12), (2047.9, 12), (2048.0, 11), (32767.9, 8)])
def test_positions_get_the_bits_that_the_extent_leaves(tmp_path, far, bits):
    splats = edge_splats(0, far=far)
    write_spz(tmp_path / "a.spz", splats)
    assert plain(tmp_path / "a.spz")[13] == bits
    assert greatest(load_spz(tmp_path / "a.spz").splats.means, splats.means) <= 0.5 / 2**bits + 1e-9


def test_what_is_too_large_is_made_smaller_with_a_warning(tmp_path, caplog):
    splats = few()
    splats.log_scales[2, 1] = 6.1
    write_spz(tmp_path / "a.spz", splats)
    assert_facts(caplog.text, 1, "Gaussians", "smaller")
    assert load_spz(tmp_path / "a.spz").splats.log_scales[2, 1] == 5.9375


def test_what_does_not_fit_is_refused_and_nothing_written(tmp_path):
    path = tmp_path / "a.spz"
    with raises(FormatError, 40000, "origin"):
        write_spz(path, edge_splats(far=40000.0))
    splats = few()
    splats.sh_rest[0, 3, 1], splats.sh_rest[1, 0, 0] = np.inf, np.nan
    with raises(FormatError, "sh_rest", 2):
        write_spz(path, splats)
    with raises(FormatError, "Gaussians"):
        write_spz(path, splats.select(torch.arange(0)))
    with raises(ValueError, "version 1"):
        write_spz(path, few(), version=1)
    assert list(tmp_path.iterdir()) == []


def test_what_lies_outside_the_bytes_is_clamped(tmp_path):
    splats = few()
    splats.log_scales[0, 0], splats.sh_dc[0, 0], splats.sh_rest[0, 0, 0] = -13, 7, -4
    write_spz(tmp_path / "a.spz", splats)
    back = load_spz(tmp_path / "a.spz").splats
    assert back.log_scales[0, 0] == -10
    assert back.sh_dc[0, 0] == pytest.approx(0.5 / 0.15)
    assert back.sh_rest[0, 0, 0] == -1


def with_extension(path, kind, payload):
    """Adds an extension to a file that has none, where its version has them."""
    record = struct.pack("<II", kind, len(payload)) + payload
    data = path.read_bytes()
    if data[:4] != b"NGSP":
        data = plain(path)
        data = gzip.compress(data[:14] + b"\2" + data[15:] + record)
    else:
        data = data[:14] + b"\2" + data[15:16] + struct.pack("<I", 32 + len(record)) + (
            bytes(12) + record + data[32:])
    path.write_bytes(data)


@pytest.mark.parametrize("version", [2, 3, 4])
@pytest.mark.parametrize("kind", [0xADBE0002, 0x12340001])
def test_extensions_that_change_nothing_are_passed_over(tmp_path, version, kind):
    path = tmp_path / "a.spz"
    write_spz(path, few(), version=version)
    wanted = load_spz(path).splats
    with_extension(path, kind, b"\4\0\0\0")
    assert torch.equal(load_spz(path).splats.means, wanted.means)


# Numbers of the extension and the signs that lead to "rdf", or "rfu" where up is along z; checked
# against @adobe/spz 0.2.3, the library of Niantic and Adobe.
@pytest.mark.parametrize(("number", "signs", "up"), [
    (4, [1, -1, -1], "-y"), (6, [1, 1, 1], "-y"), (7, [-1, -1, 1], "-y"), (8, [1, -1, 1], "-y"),
    (1, [-1, 1, -1], "-y"), (12, [1, 1, 1], "z"), (16, [1, -1, 1], "z"), (10, [1, 1, -1], "z"),
])
@pytest.mark.parametrize("version", [2, 3, 4])
def test_the_axes_that_a_file_names_are_turned_into_ours(tmp_path, number, signs, up, version):
    path = tmp_path / "a.spz"
    write_spz(path, few(), version=version)
    stored = load_spz(path).splats
    with_extension(path, 0xADBE0003, struct.pack("<I", number))
    scene = load_spz(path)
    assert scene.up == up
    assert torch.equal(scene.splats.means, stored.means * torch.tensor(signs))
    # The colour along d of the scene is the one along the d that the signs make of it in the file.
    direction = torch.tensor([[0.36, 0.48, 0.8]], dtype=torch.float64)
    ours = basis_rest(direction, 3) @ scene.splats.sh_rest[0].double()
    theirs = basis_rest(direction * torch.tensor(signs), 3) @ stored.sh_rest[0].double()
    assert torch.allclose(ours, theirs, atol=1e-6)


def test_a_file_that_names_no_axes_stays_and_those_given_win(tmp_path):
    path = tmp_path / "a.spz"
    write_spz(path, few())
    stored = load_spz(path).splats
    assert load_spz(path).up is None
    turned = load_spz(path, axes="rub").splats
    assert torch.equal(turned.means, stored.means * torch.tensor([1, -1, -1]))
    with_extension(path, 0xADBE0003, struct.pack("<I", 0))  # unspecified
    assert torch.equal(load_spz(path).splats.means, stored.means)
    with_extension(path, 0xADBE0003, struct.pack("<I", 4))  # RUB
    assert torch.equal(load_spz(path).splats.means, stored.means * torch.tensor([1, -1, -1]))
    assert torch.equal(load_spz(path, axes="rdf").splats.means, stored.means)


@pytest.mark.parametrize("up", [None, "z", "-y", "y"])
@pytest.mark.parametrize("version", [2, 3])
def test_up_is_in_the_header_of_gzip_and_no_extension_is_written(tmp_path, version, up):
    """three.js refuses files with an extension; every program skips the comment of gzip."""
    path = tmp_path / "a.spz"
    write_spz(path, few(), version=version, up=up, antialiased=up == "z")
    data = plain(path)
    assert len(data) == 16 + len(few()) * (64 if version == 2 else 65)  # and nothing behind it
    assert data[14] == (up == "z")  # flags: no extension
    scene = load_spz(path)
    assert (scene.up, scene.antialiased) == (up, up == "z")
    path.write_bytes(data)
    assert torch.equal(scene.splats.means, load_spz(path).splats.means)


@pytest.mark.parametrize(("up", "number", "signs", "read"), [
    ("z", 12, [1, 1, 1], "z"), ("-y", 6, [1, 1, 1], "-y"), ("y", 4, [1, -1, -1], "-y")])
def test_version_4_names_the_axes_of_its_values(tmp_path, up, number, signs, read):
    path = tmp_path / "a.spz"
    write_spz(path, few(), version=4)
    stored = load_spz(path)
    assert stored.up is None
    write_spz(path, few(), version=4, up=up)
    assert struct.pack("<III", 0xADBE0003, 4, number) in path.read_bytes()
    scene = load_spz(path)
    assert scene.up == read
    assert torch.equal(scene.splats.means, stored.splats.means * torch.tensor(signs))


@pytest.mark.parametrize(("size", "bits"), [(1e-2, 12), (1e-3, 14), (1e-4, 18), (1e-9, 23)])
def test_positions_get_the_bits_that_fine_gaussians_need(tmp_path, size, bits):
    """Half a step is 1/32 of the median Gaussian at most, as far as 24 bits hold the scene."""
    splats = edge_splats(0, far=0.9)
    splats.means.clamp_(-0.9, 0.9)
    splats.log_scales[:] = np.log(size)
    write_spz(tmp_path / "a.spz", splats)
    assert plain(tmp_path / "a.spz")[13] == bits
    off = greatest(load_spz(tmp_path / "a.spz").splats.means, splats.means)
    assert off <= 0.5 / 2**bits + 1e-9
    assert off <= size / 32 or bits == 23


def test_version_1_has_positions_of_16_bits(tmp_path):
    path = tmp_path / "a.spz"
    write_spz(path, few(), version=2)
    wanted, data = load_spz(path).splats, plain(path)
    n = len(few())
    halves = wanted.means.numpy().astype("<f2")
    head = data[:4] + struct.pack("<I", 1) + data[8:16]
    path.write_bytes(gzip.compress(head + halves.tobytes() + data[16 + 9 * n:]))
    back = load_spz(path).splats
    assert np.array_equal(back.means.numpy(), halves.astype(np.float32))
    for name in ("quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest"):
        assert torch.equal(getattr(back, name), getattr(wanted, name)), name


def test_harmonics_of_degree_4_are_cut_to_degree_3_with_a_warning(tmp_path, caplog):
    path = tmp_path / "a.spz"
    write_spz(path, few())
    wanted, data = load_spz(path).splats, plain(path)
    n, start = len(few()), 16 + 20 * len(few())
    harmonics = np.frombuffer(data[start:], np.uint8).reshape(n, 15, 3)
    more = np.concatenate([harmonics, np.full((n, 9, 3), 7, np.uint8)], axis=1)
    path.write_bytes(data[:12] + b"\4" + data[13:start] + more.tobytes())
    assert torch.equal(load_spz(path).splats.sh_rest, wanted.sh_rest)
    assert_facts(caplog.text, 4, 3, "degree")


@pytest.mark.integration
@pytest.mark.parametrize("version", [3, 4])
def test_many_equal_gaussians_are_read_back(tmp_path, version):
    """They pack far better than any scene and must not be taken for a bomb."""
    splats = few(1).map(lambda value: value.repeat(150_000, *[1] * (value.dim() - 1)))
    write_spz(tmp_path / "a.spz", splats, version=version)
    assert len(load_spz(tmp_path / "a.spz").splats) == 150_000
