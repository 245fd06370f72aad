"""SPZ files that are damaged or promise more than they hold."""

import gzip
import struct
import tracemalloc

import pytest
import zstandard
from examples import examples
from facts import assert_facts, raises
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_cases import damaged, few, plain, read_or_refused

from recon_cli.errors import FormatError
from recon_cli.splats.spz import FORMAT, load_spz, write_spz

MIB = 1 << 20
STEP = 1 / 64  # of harmonics as they are written: every other of the 256 numbers of the format

AXES = 0xADBE0003  # the extension


def header(version=3, count=9, degree=3, bits=12, flags=0, streams=0) -> bytes:
    return b"NGSP" + struct.pack("<IIBBBB", version, count, degree, bits, flags, streams)


@pytest.mark.parametrize(("change", "message"), [
    (lambda _: b"", "SPZ"),
    (lambda data: b"ply" + data, "SPZ"),
    (lambda data: data[:7], "truncated"),
    (lambda data: data[:-1], "truncated"),
    (lambda data: data + bytes(65), "more than its header"),
    (lambda data: header(version=0) + data[16:], "version 0"),
    (lambda data: header(version=1, count=12) + data[16:], "truncated"),
    (lambda data: header(version=5) + data[16:], "version 5"),
    (lambda data: header(degree=4) + data[16:], "truncated"),
    (lambda data: header(degree=5) + data[16:], "degree 5"),
    (lambda data: header(bits=25) + data[16:], "25 fractional bits"),
    (lambda data: header(count=0) + data[16:], "promises 0"),
    (lambda data: header(count=10) + data[16:], "truncated"),
    (lambda data: header(count=8) + data[16:], "more than its header"),
    (lambda data: header(count=2**32 - 1) + data[16:], "promises 4294967295"),
    (lambda data: header(flags=2) + data[16:] + b"123", "truncated"),
    (lambda data: header(flags=2) + data[16:] + struct.pack("<II", 9, 4), "truncated"),
    (lambda data: header(flags=2) + data[16:] + struct.pack("<II", AXES, 9), "truncated|names"),
    (lambda data: header(flags=2) + data[16:] + struct.pack("<III", AXES, 4, 17), "11000000"),
    (lambda data: header(flags=2) + data[16:] + struct.pack("<IIB", AXES, 1, 4), "names axes"),
    (lambda data: header(flags=2) + data[16:] + struct.pack("<III", AXES - 2, 4, 1), "0xadbe0001"),
])
@pytest.mark.parametrize("zipped", [False, True])
def test_damaged_files_are_refused_with_the_reason(tmp_path, change, message, zipped):
    path = tmp_path / "a.spz"
    write_spz(path, few())
    data = change(plain(path))
    if zipped and message != "SPZ":
        data = gzip.compress(data)
    path.write_bytes(data)
    with pytest.raises(FormatError, match=message):
        load_spz(path)


@pytest.mark.parametrize(("change", "message"), [
    (lambda data: data[:20], "truncated"),
    (lambda data: data[:-1], "unpacked"),
    (lambda data: data + bytes(65), "more than its header"),
    (lambda data: header(4, 10, streams=6) + data[16:], "bytes instead of 90"),
    (lambda data: header(4, 9, streams=5) + data[16:], "5 streams instead of 6"),
    (lambda data: header(4, 9, 0, streams=6) + data[16:], "6 streams instead of 5"),
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
        load_spz(path)


def test_a_missing_file_and_a_damaged_gzip_are_refused(tmp_path):
    for path in (tmp_path / "none.spz", tmp_path):
        with raises(FormatError):
            load_spz(path)
    path = tmp_path / "a.spz"
    write_spz(path, few())
    data = path.read_bytes()
    for bad in (data[:12], data[:-3], data[:40] + b"\0" + data[41:]):
        path.write_bytes(bad)
        with pytest.raises(FormatError):
            load_spz(path)


@pytest.mark.parametrize("version", [3, 4])
def test_bytes_behind_the_data_are_left_out_with_a_warning(tmp_path, version, caplog):
    path = tmp_path / "a.spz"
    write_spz(path, few(), version=version)
    wanted = load_spz(path).splats.means
    with path.open("ab") as file:
        file.write(b"\n")
    assert load_spz(path).splats.means.equal(wanted)
    assert_facts(caplog.text, 1, "bytes", "data")


def refused_at(path, limit: int) -> str:
    """The refusal of a file, for which at most `limit` bytes were taken at any time."""
    tracemalloc.start()
    try:
        with pytest.raises(FormatError) as caught:
            load_spz(path)
        assert tracemalloc.get_traced_memory()[1] < limit
    finally:
        tracemalloc.stop()
    return str(caught.value)


@pytest.mark.integration
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


@settings(max_examples=examples(300))
@given(seed=st.integers(0, 2**63), form=st.sampled_from(["plain", "inside gzip", "gzip", "zstd"]))
def test_a_damaged_file_gives_gaussians_or_a_format_error(tmp_path_factory, seed, form):
    path = tmp_path_factory.getbasetemp() / "fuzz.spz"
    write_spz(path, few(), version=4 if form == "zstd" else 3)
    data = path.read_bytes() if form in ("gzip", "zstd") else plain(path)
    data = damaged(data, seed)
    data = gzip.compress(data, 1) if form == "inside gzip" else data
    read_or_refused(FORMAT.read, path, data)
