"""A .sog that lies about anything is refused, before memory is taken for the lie."""

import contextlib
import io
import json
import struct
import warnings
import zipfile

import archive_splats
import damage
import numpy as np
import pytest
from examples import examples
from facts import raises
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from recon_cli.errors import FormatError
from recon_cli.splats.sog import encode_webp, load_sog, write_sog

COUNT = 70  # a palette of 5, images of 9 x 8


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    """The entries of a file by name."""
    path = tmp_path_factory.mktemp("sog") / "a.sog"
    write_sog(path, archive_splats.room(COUNT))
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def pack(entries, method=zipfile.ZIP_DEFLATED):
    data = io.BytesIO()
    with warnings.catch_warnings():  # of names that are there twice
        warnings.simplefilter("ignore")
        with zipfile.ZipFile(data, "w", method) as archive:
            for name, content in entries.items() if isinstance(entries, dict) else entries:
                archive.writestr(name, content)
    return data.getvalue()


def with_meta(good, edit):
    meta = json.loads(good["meta.json"])
    edit(meta)
    return {**good, "meta.json": json.dumps(meta)}


def plain(width, height, channels=3, value=0):
    return encode_webp(np.full((height, width, channels), value, np.uint8))


def claimed(width, height):
    """An image of 9x8 pixels that says that it is larger."""
    data = bytearray(plain(9, 8))
    assert data[12:16] == b"VP8L"
    bits = int.from_bytes(data[21:25], "little")
    assert bits & 0xFFFFFFF == 8 | 7 << 14
    data[21:25] = (bits >> 28 << 28 | width - 1 | height - 1 << 14).to_bytes(4, "little")
    return bytes(data)


def read(tmp_path, data):
    (tmp_path / "a.sog").write_bytes(data)
    with damage.little_memory():
        return load_sog(tmp_path / "a.sog").splats


def refused(tmp_path, data, said):
    with pytest.raises(FormatError, match=said):
        read(tmp_path, data)
    assert [path.name for path in tmp_path.iterdir()] == ["a.sog"]


def test_what_is_changed_below_is_whole(tmp_path, good):
    assert len(read(tmp_path, pack(good))) == COUNT


@pytest.mark.parametrize(("data", "said"), [
    (b"", "not a .sog"), (b"ply\n", "not a .sog"), (b"PK\x03\x04" + bytes(50), "not a .sog"),
    (pack({}), "not a .sog"), (pack({"a": ""}), "no entry 'meta.json'"),
    (pack({"meta.json": "{"}), "cannot be read"),
    (pack({"meta.json": "[" * 100_000}), "cannot be read"),
    (pack({"meta.json": '{"version":' + "9" * 5000 + "}"}), "cannot be read"),
    (pack({"meta.json": "[]"}), "not an object"), (pack({"meta.json": "{}"}), "version = None"),
    (pack({"meta.json": b"\xff\xfe"}), "cannot be read"),
    (pack({"meta.json": '{"version": 2, "count": NaN}'}), "NaN is not a number"),
    (pack({"meta.json": '{"means": {"shape": [1, 3]}}'}), "version 1"),
    (pack({"meta.json": '{"version": 3}'}), "version 3"),
    (pack({"meta.json": " " * (2 << 20)}), "more than 1048576 bytes"),
    (pack({f"{at}": "" for at in range(70)}), "more than 64 entries"),
])
def test_what_is_no_sog_is_refused(tmp_path, data, said):
    refused(tmp_path, data, said)


def test_a_missing_file_is_refused(tmp_path):
    with raises(FormatError):
        load_sog(tmp_path / "none.sog")


@pytest.mark.parametrize("name", [
    "../evil", "/etc/evil", "a/../../evil", "..\\evil", "C:\\evil", "C:evil"])
def test_an_entry_that_leaves_the_archive_is_refused(tmp_path, good, name):
    refused(tmp_path, pack({**good, name: b"x"}), "leaves the archive")


def test_two_entries_of_one_name_are_refused(tmp_path, good):
    refused(tmp_path, pack([*good.items(), ("sh0.webp", b"other")]), "two entries of one name")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_compression_that_does_not_stop_at_a_bound_is_refused(tmp_path, good, method):
    refused(tmp_path, pack(good, method), "compressed unusually")


@pytest.mark.integration
@pytest.mark.parametrize("name", [
    "means_l.webp", "means_u.webp", "scales.webp", "quats.webp", "sh0.webp", "shN_centroids.webp",
    "shN_labels.webp"])
def test_a_bomb_is_not_unpacked(tmp_path, good, name):
    refused(tmp_path, pack({**good, name: bytes(64 << 20)}), "unpacks to more than")


@pytest.mark.integration
@pytest.mark.parametrize("claimed", [0, 5, 1 << 31])
def test_a_size_in_the_directory_that_is_a_lie_is_refused(tmp_path, good, claimed):
    data = bytearray(pack({**good, "sh0.webp": bytes(64 << 20)}))
    at = data.rindex(b"PK\x01\x02", 0, data.rindex(b"sh0.webp"))
    struct.pack_into("<I", data, at + 24, claimed)
    refused(tmp_path, bytes(data), "cannot be unpacked|unpacks to more|not an image")


def test_a_wrong_checksum_is_refused(tmp_path, good):
    data = pack(good, zipfile.ZIP_STORED)
    place = data.index(good["quats.webp"]) + 40
    refused(tmp_path, data[:place] + bytes([data[place] ^ 1]) + data[place + 1:], "unpacked")


@pytest.mark.parametrize("name", ["means_u.webp", "sh0.webp", "shN_centroids.webp", "meta.json"])
def test_a_missing_entry_is_refused(tmp_path, good, name):
    refused(tmp_path, pack({key: data for key, data in good.items() if key != name}),
            f"no entry '{name}'")


@pytest.mark.parametrize(("name", "image", "said"), [
    ("means_l.webp", plain(9, 7), "9x7 pixels for 70"),
    ("scales.webp", plain(8, 9), "8x9 pixels, needed are 9x8"),
    ("quats.webp", claimed(16383, 16383), "16383x16383 pixels for 70"),
    ("means_l.webp", claimed(16383, 16383), "16383x16383 pixels for 70"),
    ("means_l.webp", claimed(1000, 1000), "needed are 1000x1000|not an image"),
    ("shN_centroids.webp", plain(64 * 8, 1), "512x1 pixels for 960"),
    ("shN_centroids.webp", plain(64 * 15, 2), "960x2 pixels, needed are 960x1"),
    ("sh0.webp", b"RIFF1234WEBPVP8Lxxxx", "not an image"), ("sh0.webp", b"", "not an image"),
    ("sh0.webp", b"GIF89a" + bytes(20), "not an image"),
    ("quats.webp", plain(9, 8, 4), "without their greatest"),
    ("shN_labels.webp", plain(9, 8, 3, 255), "label 65535 of a palette"),
])
def test_an_image_that_is_not_what_it_should_be_is_refused(tmp_path, good, name, image, said):
    refused(tmp_path, pack({**good, name: image}), said)


def test_an_image_with_losses_is_refused(tmp_path, good):
    lossy = io.BytesIO()
    Image.fromarray(np.zeros((8, 9, 3), np.uint8)).save(lossy, "WEBP", quality=90)
    refused(tmp_path, pack({**good, "sh0.webp": lossy.getvalue()}), "lossy compression")


def test_an_animation_is_refused(tmp_path, good):
    frames = [Image.fromarray(np.full((8, 9, 3), value, np.uint8)) for value in (0, 200)]
    moving = io.BytesIO()
    frames[0].save(moving, "WEBP", lossless=True, save_all=True, append_images=frames[1:])
    refused(tmp_path, pack({**good, "sh0.webp": moving.getvalue()}), "not a single image")


def test_images_may_be_png(tmp_path, good):
    for name in ("sh0.webp", "quats.webp"):
        png = io.BytesIO()
        Image.open(io.BytesIO(good[name])).save(png, "PNG")
        good = {**good, name: png.getvalue()}
    assert len(read(tmp_path, pack(good))) == COUNT


@pytest.mark.parametrize(("count", "said"), [
    (0, "count = 0"), (-1, "count = -1"), (True, "count = True"), (70.0, "count = 70.0"),
    ("70", "count = '70'"), (73, "9x8 pixels for 73"), (10**9, "count = 1000000000"),
    (200_000_000, "200000000 Gaussians in"), (2**70, "count = ")])
def test_a_count_that_lies_is_refused(tmp_path, good, count, said):
    refused(tmp_path, pack(with_meta(good, lambda meta: meta.update(count=count))), said)


@pytest.mark.parametrize(("edit", "said"), [
    (lambda meta: meta["means"].update(mins=[0, 0]), "mins"),
    (lambda meta: meta["means"].update(mins=[0, 0, 1e300]), "mins"),
    (lambda meta: meta["means"].update(maxs=[0, 0, 90]), "not finite in means"),
    (lambda meta: meta["means"].update(files=["means_l.webp"]), "needed are 2 names"),
    (lambda meta: meta["scales"].update(codebook=[1.0]), "of a codebook of 1"),
    (lambda meta: meta["scales"].update(codebook=[0.0] * 257), "256 finite"),
    (lambda meta: meta["sh0"].update(codebook=["a"] * 256), "256 finite"),
    (lambda meta: meta["sh0"].update(codebook={}), "256 finite"),
    (lambda meta: meta["shN"].update(bands=4), "bands = 4"),
    (lambda meta: meta["shN"].update(count=0), "count = 0"),
    (lambda meta: meta["shN"].update(count=65537), "count = 65537"),
    (lambda meta: meta["shN"].update(count=65536), "960x1 pixels for 983040"),
    (lambda meta: meta["shN"].update(count=1), "of a palette of 1"),
    (lambda meta: meta.update(quats=None), "without quats"),
    (lambda meta: meta["quats"].update(files=["../../etc/passwd"]), "no entry"),
])
def test_a_meta_that_lies_is_refused(tmp_path, good, edit, said):
    refused(tmp_path, pack(with_meta(good, edit)), said)


def test_a_gaussian_takes_a_byte_in_files_of_millions(tmp_path, good):
    one = claimed(4000, 4000)
    entries = {name: one for name in good if name.endswith(".webp")}
    entries["meta.json"] = with_meta(
        good, lambda meta: meta.update(count=16_000_000))["meta.json"]
    refused(tmp_path, pack(entries), "16000000 Gaussians in")


def _survives(path, data):
    path.write_bytes(data)
    with contextlib.suppress(FormatError):
        assert load_sog(path).splats.means.shape[1] == 3


CAREFUL = settings(
    max_examples=examples(100), suppress_health_check=[HealthCheck.function_scoped_fixture])


@CAREFUL
@given(st.data())
def test_no_bytes_give_anything_but_gaussians_or_a_reason(tmp_path, good, data):
    method = data.draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))
    _survives(tmp_path / "a.sog", data.draw(damage.changed_bytes(pack(good, method))))


@CAREFUL
@given(st.data())
def test_no_entry_gives_anything_but_gaussians_or_a_reason(tmp_path, good, data):
    name = data.draw(st.sampled_from(sorted(good)))
    _survives(tmp_path / "a.sog", pack(
        {**good, name: data.draw(damage.changed_bytes(good[name]))}))


@CAREFUL
@given(st.data())
def test_no_meta_gives_anything_but_gaussians_or_a_reason(tmp_path, good, data):
    meta = data.draw(damage.changed_json(json.loads(good["meta.json"])))
    _survives(tmp_path / "a.sog", pack({**good, "meta.json": json.dumps(meta)}))
