"""SPZ: each parameter within its step, axes turned, every version read, bombs and lies refused."""

import gzip
import struct
import tracemalloc

import numpy as np
import pytest
import torch
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_cases import (
    N,
    damaged,
    edge_splats,
    greatest,
    read_or_refused,
    rotation_error,
    unit,
)

from recon_cli.errors import FormatError
from recon_cli.io.splats.spz import read_spz, write_spz
from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import Splats

MIB = 1 << 20
STEP = 1 / 64  # of harmonics as they are written: every other of the 256 numbers of the format


def few(count: int = 9, degree: int = 3) -> Splats:
    return edge_splats(degree).select(torch.arange(count))


def plain(path) -> bytes:
    """The bytes of a file of version 3 before gzip, which readers take as well."""
    return gzip.decompress(path.read_bytes())


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


def test_what_does_not_fit_is_refused_and_nothing_written(tmp_path):
    path = tmp_path / "a.spz"
    with pytest.raises(FormatError, match="40000 units from the origin"):
        write_spz(path, edge_splats(far=40000.0))
    splats = few()
    splats.log_scales[2, 1] = 6.1
    with pytest.raises(FormatError, match="1 Gaussians are too large"):
        write_spz(path, splats)
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


def header(version=3, count=9, degree=3, bits=12, flags=0, streams=0) -> bytes:
    return b"NGSP" + struct.pack("<IIBBBB", version, count, degree, bits, flags, streams)


@pytest.mark.parametrize(("change", "message"), [
    (lambda _: b"", "no SPZ"),
    (lambda data: b"ply" + data, "no SPZ"),
    (lambda data: data[:7], "truncated"),
    (lambda data: data[:-1], "truncated"),
    (lambda data: data + b"1", "more than its header"),
    (lambda data: header(version=1) + data[16:], "version 1"),
    (lambda data: header(version=5) + data[16:], "version 5"),
    (lambda data: header(degree=4) + data[16:], "degree 4"),
    (lambda data: header(bits=25) + data[16:], "25 fractional bits"),
    (lambda data: header(count=0) + data[16:], "promises 0"),
    (lambda data: header(count=10) + data[16:], "truncated"),
    (lambda data: header(count=8) + data[16:], "more than its header"),
    (lambda data: header(count=2**32 - 1) + data[16:], "promises 4294967295"),
    (lambda data: header(flags=2) + data[16:] + b"123", "truncated"),
    (lambda data: header(flags=2) + data[16:] + struct.pack("<II", 9, 4), "truncated"),
])
@pytest.mark.parametrize("zipped", [False, True])
def test_damaged_files_are_refused_with_the_reason(tmp_path, change, message, zipped):
    path = tmp_path / "a.spz"
    write_spz(path, few())
    data = change(plain(path))
    if zipped and message != "no SPZ":
        data = gzip.compress(data)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=message):
        read_spz(path)


@pytest.mark.parametrize(("change", "message"), [
    (lambda data: data[:20], "truncated"),
    (lambda data: data[:-1], "unpacked"),
    (lambda data: data + b"1", "more than its header"),
    (lambda data: header(4, 10, streams=6) + data[16:], "bytes where 90 belong"),
    (lambda data: header(4, 9, streams=5) + data[16:], "5 streams where 6 belong"),
    (lambda data: header(4, 9, 0, streams=6) + data[16:], "6 streams where 5 belong"),
    (lambda data: data[:16] + b"\0\0\0\0" + data[20:], "streams"),
    (lambda data: data[:16] + b"\xff\xff\xff\xff" + data[20:], "streams"),
    (lambda data: data[:32] + b"\xff" * 8 + data[40:], "unpacked|truncated"),
    (lambda data: data[:32] + bytes(8) + data[40:], "unpacked"),
    (lambda data: gzip.compress(data), "packed as older"),
])
def test_damaged_files_of_version_4_are_refused(tmp_path, change, message):
    path = tmp_path / "a.spz"
    write_spz(path, few(), version=4)
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(FormatError, match=message):
        read_spz(path)


def test_a_missing_file_and_a_damaged_gzip_are_refused(tmp_path):
    for path in (tmp_path / "none.spz", tmp_path):
        with pytest.raises(FormatError, match="cannot be read"):
            read_spz(path)
    path = tmp_path / "a.spz"
    write_spz(path, few())
    data = path.read_bytes()
    for bad in (data[:12], data[:-3], data[:40] + b"\0" + data[41:], data + b"more"):
        path.write_bytes(bad)
        with pytest.raises(FormatError):
            read_spz(path)


def refused_at(path, limit: int) -> str:
    """The refusal of a file, for which at most `limit` bytes were taken at any time."""
    tracemalloc.start()
    try:
        with pytest.raises(FormatError) as caught:
            read_spz(path)
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()
    return str(caught.value)


def test_a_gzip_that_unpacks_to_more_than_its_count_is_cut_off(tmp_path):
    path = tmp_path / "a.spz"
    write_spz(path, few())
    path.write_bytes(gzip.compress(plain(path) + bytes(200 * MIB)))
    assert "more than its header" in refused_at(path, 2 * MIB)


@pytest.mark.parametrize("known", [True, False])
def test_a_zstd_stream_that_unpacks_to_more_than_its_count_is_cut_off(tmp_path, known):
    path = tmp_path / "a.spz"
    write_spz(path, few(degree=0), version=4)
    data = path.read_bytes()
    sizes = [struct.unpack_from("<QQ", data, 32 + 16 * i) for i in range(5)]
    packer = zstandard.ZstdCompressor(write_content_size=known)
    bomb = packer.compress(bytes(200 * MIB))
    table = struct.pack("<QQ", len(bomb), sizes[0][1]) + data[48:112]
    path.write_bytes(data[:32] + table + bomb + data[112 + sizes[0][0]:])
    refused_at(path, 2 * MIB)


@pytest.mark.parametrize("version", [3, 4])
def test_a_count_that_no_file_of_this_size_holds_is_refused(tmp_path, version):
    path = tmp_path / "a.spz"
    write_spz(path, few(), version=version)
    data = plain(path) if version == 3 else path.read_bytes()
    data = data[:8] + struct.pack("<I", 50_000_000) + data[12:]
    path.write_bytes(gzip.compress(data) if version == 3 else data)
    assert "promises 50000000" in refused_at(path, 2 * MIB)


@pytest.mark.parametrize("version", [3, 4])
def test_many_equal_gaussians_are_read_back(tmp_path, version):
    """They pack far better than any scene and must not be taken for a bomb."""
    splats = few(1).map(lambda value: value.repeat(150_000, *[1] * (value.dim() - 1)))
    write_spz(tmp_path / "a.spz", splats, version=version)
    assert len(read_spz(tmp_path / "a.spz")) == 150_000


@settings(deadline=None, max_examples=300)
@given(seed=st.integers(0, 2**63), form=st.sampled_from(["plain", "inside gzip", "gzip", "zstd"]))
def test_a_damaged_file_gives_gaussians_or_a_format_error(tmp_path_factory, seed, form):
    path = tmp_path_factory.getbasetemp() / "fuzz.spz"
    write_spz(path, few(), version=4 if form == "zstd" else 3)
    data = path.read_bytes() if form in ("gzip", "zstd") else plain(path)
    data = damaged(data, seed)
    read_or_refused(read_spz, path, gzip.compress(data, 1) if form == "inside gzip" else data)
