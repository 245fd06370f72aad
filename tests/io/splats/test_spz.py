"""SPZ: each parameter within its step, axes turned, every version read, bombs and lies refused."""

import gzip
import struct

import numpy as np
import pytest
import torch
from splat_cases import N, edge_splats, few, greatest, plain, rotation_error, unit

from recon_cli.errors import FormatError
from recon_cli.io.splats.spz import read_spz, write_spz
from recon_cli.scene.harmonics import basis_rest

MIB = 1 << 20
STEP = 1 / 64  # of harmonics as they are written: every other of the 256 numbers of the format


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize(("degree", "colored"), [(0, N), (1, N), (2, 1), (3, N), (3, 300)])
def test_each_parameter_is_within_half_a_step(tmp_path, version, degree, colored):
    splats = edge_splats(degree, colored)
    write_spz(tmp_path / "a.spz", splats, version=version)
    back = read_spz(tmp_path / "a.spz")
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
    three, four = read_spz(tmp_path / "3.spz"), read_spz(tmp_path / "4.spz")
    for name, value in three.parameters().items():
        assert torch.equal(value, getattr(four, name)), name


@pytest.mark.parametrize("version", [3, 4])
def test_bytes_stay_when_a_file_is_read_and_written_again(tmp_path, version):
    write_spz(tmp_path / "a.spz", edge_splats(), version=version)
    once = read_spz(tmp_path / "a.spz")
    write_spz(tmp_path / "b.spz", once, version=version)
    again = read_spz(tmp_path / "b.spz")
    for name, value in once.parameters().items():
        if name != "quats":  # two components of one size may change places
            assert torch.equal(value, getattr(again, name)), name
    assert rotation_error(once, again) <= 2e-3


def test_the_file_has_y_up_and_z_back(tmp_path):
    """The colour along d of the scene is the colour along the turned d of the file's values."""
    splats = few(4)
    splats.means[:] = torch.tensor([1.0, 2.0, 4.0])
    splats.quats[:] = torch.tensor([0.8, 0.1, -0.3, 0.5])
    write_spz(tmp_path / "a.spz", splats)
    body = np.frombuffer(plain(tmp_path / "a.spz"), np.uint8)[16:]
    places, harmonics = body[:9], body[4 * 20:].reshape(4, 15, 3)
    wide = np.zeros((3, 4), np.uint8)
    wide[:, :3] = places.reshape(3, 3)
    assert ((wide.view("<i4")[:, 0] << 8 >> 8) / 4096).tolist() == [1, -2, -4]
    direction = torch.tensor([[0.36, 0.48, 0.8]], dtype=torch.float64)
    turned = direction * torch.tensor([1, -1, -1])
    ours = basis_rest(direction, 3) @ splats.sh_rest[0].double()
    theirs = basis_rest(turned, 3) @ torch.from_numpy((harmonics[0] - 128.0) / 128)
    assert torch.allclose(ours, theirs, atol=15 * 0.5 * STEP)
    # The largest component w is left out (3 of xyzw), x stays, y and z change their sign.
    word = int(body[4 * 16:4 * 17].view("<u4")[0])
    fields = [word >> shift & 1023 for shift in (20, 10, 0)]
    assert word >> 30 == 3
    signs = [-1 if field & 512 else 1 for field in fields]
    sizes = [(field & 511) / 511 * np.sqrt(0.5) for field in fields]
    length = np.linalg.norm([0.8, 0.1, 0.3, 0.5])
    assert signs == [1, 1, -1]
    assert np.allclose(sizes, np.array([0.1, 0.3, 0.5]) / length, atol=1e-3)


def test_version_2_is_version_3_with_bytes_of_rotations(tmp_path):
    splats = edge_splats()
    for version in (2, 3):
        write_spz(tmp_path / f"{version}.spz", splats, version=version)
    two, three = read_spz(tmp_path / "2.spz"), read_spz(tmp_path / "3.spz")
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
    back = read_spz(tmp_path / "b.spz")
    wanted = np.array([[1, 0, 0, 0], [0.5, 0.5, 0.5, -0.5], [0, 0, 1, 0]])
    assert np.allclose(back.quats, wanted, atol=1.5 / 127.5)
    assert torch.equal(back.means, read_spz(tmp_path / "a.spz").means)


@pytest.mark.parametrize(("far", "bits"), [(1.0, 12), (2047.9, 12), (2048.0, 11), (32767.9, 8)])
def test_positions_get_the_bits_that_the_extent_leaves(tmp_path, far, bits):
    splats = edge_splats(0, far=far)
    write_spz(tmp_path / "a.spz", splats)
    assert plain(tmp_path / "a.spz")[13] == bits
    assert greatest(read_spz(tmp_path / "a.spz").means, splats.means) <= 0.5 / 2**bits + 1e-9


def test_what_is_too_large_is_made_smaller_with_a_warning(tmp_path, caplog):
    splats = few()
    splats.log_scales[2, 1] = 6.1
    write_spz(tmp_path / "a.spz", splats)
    assert "1 Gaussians are made smaller" in caplog.text
    assert read_spz(tmp_path / "a.spz").log_scales[2, 1] == 5.9375


def test_what_does_not_fit_is_refused_and_nothing_written(tmp_path):
    path = tmp_path / "a.spz"
    with pytest.raises(FormatError, match="40000 units from the origin"):
        write_spz(path, edge_splats(far=40000.0))
    splats = few()
    splats.sh_rest[0, 3, 1], splats.sh_rest[1, 0, 0] = np.inf, np.nan
    with pytest.raises(FormatError, match=r"sh_rest \(2\)"):
        write_spz(path, splats)
    with pytest.raises(FormatError, match="no Gaussians"):
        write_spz(path, splats.select(torch.arange(0)))
    with pytest.raises(ValueError, match="version 1"):
        write_spz(path, few(), version=1)
    assert list(tmp_path.iterdir()) == []


def test_what_lies_outside_the_bytes_is_clamped(tmp_path):
    splats = few()
    splats.log_scales[0, 0], splats.sh_dc[0, 0], splats.sh_rest[0, 0, 0] = -13, 7, -4
    write_spz(tmp_path / "a.spz", splats)
    back = read_spz(tmp_path / "a.spz")
    assert back.log_scales[0, 0] == -10
    assert back.sh_dc[0, 0] == pytest.approx(0.5 / 0.15)
    assert back.sh_rest[0, 0, 0] == -127 / 128  # of y, which is negated: 4 becomes the byte 255


def test_extensions_are_passed_over_unless_they_change_what_values_mean(tmp_path):
    path = tmp_path / "a.spz"
    for version in (3, 4):
        for kind, harmless in [(0xADBE0002, True), (0x12340001, True), (0xADBE0003, False)]:
            write_spz(path, few(), version=version)
            wanted = read_spz(path)
            record = struct.pack("<II", kind, 4) + b"\4\0\0\0"
            if version == 3:
                data = plain(path)
                data = gzip.compress(data[:14] + b"\2" + data[15:] + record)
            else:
                data = path.read_bytes()
                data = data[:14] + b"\2" + data[15:16] + struct.pack("<I", 32 + len(record)) + (
                    bytes(12) + record + data[32:])
            path.write_bytes(data)
            if harmless:
                assert torch.equal(read_spz(path).means, wanted.means)
            else:
                with pytest.raises(FormatError, match="extension 0xadbe0003"):
                    read_spz(path)


@pytest.mark.parametrize("version", [3, 4])
def test_many_equal_gaussians_are_read_back(tmp_path, version):
    """They pack far better than any scene and must not be taken for a bomb."""
    splats = few(1).map(lambda value: value.repeat(150_000, *[1] * (value.dim() - 1)))
    write_spz(tmp_path / "a.spz", splats, version=version)
    assert len(read_spz(tmp_path / "a.spz")) == 150_000
