"""Damaged and lying files of every format: refused with the reason and in little memory.

SAMPLES writes a good file of each format but lod, which has a folder of files (`test_lod`), and
ANY damages all of them alike; what only one format can have wrong stands in `splat_damages` and
`archive_damages`. Fuzzing ends the module.
"""

from __future__ import annotations

import gzip
import io
import json
import math
import struct
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import archive_splats
import damage
import pytest
import torch
from archive_damages import EXT, GLB, SOG, SOG_BOMBS, entries_of, node, number, parts_of, zipped
from examples import examples
from facts import assert_facts, raises
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ksplat_writer import ksplat
from PIL import Image
from rad_writer import DEFAULT, N, chunk, rad, values
from scenes import random_splats, with_harmonics
from splat_cases import damaged, few, plain, read_or_refused, rewritten
from splat_damages import (
    ASCII_PLY,
    COMPRESSED,
    HTML,
    KSPLAT,
    MIB,
    PLY,
    RAD,
    SPLAT,
    SPZ,
    SPZ_4,
    SPZ_BOMBS,
    ZIPPED_SPZ,
    ZSTD_BOMBS,
    Change,
    put,
    scene_of,
)

from recon_cli.errors import FormatError
from recon_cli.scene.splats import Splats
from recon_cli.splats.format import WriteSettings
from recon_cli.splats.glb import pack_glb
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.splats.registry import FORMATS
from recon_cli.workspace.export_formats import READABLE

READERS = {row.name: import_module(row.module).FORMAT.read for row in READABLE}
READERS["ply"] = read_ply  # which refuses what of another program's files is left out


def written(name: str, splats: Splats, **options: int) -> Callable[[Path], bytes]:
    def write(path: Path) -> bytes:
        FORMATS[name].write(path, splats, WriteSettings(options=options))
        return path.read_bytes()

    return write


def ply_as(form: str) -> Callable[[Path], bytes]:
    def write(path: Path) -> bytes:
        write_ply(path, random_splats(20, dtype=torch.float32))
        rewritten(path, form, tail=b"\nend_header\nBODY")
        return path.read_bytes()

    return write


SAMPLES: dict[str, Callable[[Path], bytes]] = {
    "ply": written("ply", random_splats(20, dtype=torch.float32)),
    "ply, degree 1": written("ply", with_harmonics(random_splats(
        5, dtype=torch.float32), 1, 4)),
    "ply, ascii": ply_as("ascii"),
    "ply, big-endian": ply_as("binary_big_endian"),
    "compressed.ply": written("compressed.ply", few(degree=1)),
    "compressed.ply, degree 0": written("compressed.ply", few(4, degree=0)),
    "splat": written("splat", few(degree=0)),
    "spz": written("spz", few(), spz_version=3),
    "spz, version 4": written("spz", few(), spz_version=4),
    "sog": written("sog", archive_splats.room(70)),  # a palette of 5, images of 9 x 8
    "glb": written("glb", archive_splats.room(20, degree=1)),
    "html": written("html", archive_splats.room(40)),
    "rad": lambda _: rad([chunk(values(), DEFAULT)], N),
    "ksplat": lambda _: ksplat(1, 0),
}


def format_name(sample: str) -> str:
    return sample.partition(",")[0]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The bytes of an undamaged file of each format; of SPZ before gzip, too."""
    folder = tmp_path_factory.mktemp("good")
    found = {name: write(folder / str(at)) for at, (name, write) in enumerate(SAMPLES.items())}
    return {**found, "spz, plain": plain(folder / str(list(SAMPLES).index("spz")))}


def check_refused(path: Path, sample: str, data: bytes, facts: list[object]) -> str:
    """Returns the message of the refusal, for which little memory was taken and no file left."""
    path.write_bytes(data)
    # ten times more than any of these files; a compressed .ply needs no tables that last
    most = MIB if sample == "compressed.ply" else 48 * MIB
    with (raises(FormatError, *facts) as caught, warnings.catch_warnings(),
          damage.little_memory(most)):
        warnings.simplefilter("error")
        READERS[format_name(sample)](path)
    assert [one.name for one in path.parent.iterdir()] == [path.name]
    return caught.value.message


ANY: dict[str, Change] = {
    "nothing": lambda _: b"",
    "text": lambda _: b"no scene\n" * 20,
    "another format": lambda data: b"PK\x03\x04" + bytes(50) if data[:2] != b"PK" else b"glTF",
    "another in front": lambda data: b"ply\n" + data if data[:3] != b"ply" else b"RAD0" + data,
    "half": lambda data: data[:len(data) // 2],
    "an eighth": lambda data: data[:len(data) // 8],
    "seven bytes less": lambda data: data[:-7],
}
ANYTHING_ELSE = ("nothing", "text", "another format")


@pytest.mark.parametrize(("sample", "kind"), [
    (sample, kind) for sample in SAMPLES for kind in ANY
    if sample != "html" or kind in ANYTHING_ELSE  # the scene of a page lies in its middle
    if (sample, kind) != ("ply, ascii", "seven bytes less")])  # a number has fewer digits
def test_what_is_cut_or_something_else_is_refused(good, tmp_path, sample, kind):
    check_refused(tmp_path / "a", sample, ANY[kind](good[sample]), [tmp_path / "a"])


@pytest.mark.parametrize("name", [row.name for row in READABLE])
def test_a_missing_file_and_a_folder_are_refused(tmp_path, name):
    for path in (tmp_path / "none", tmp_path):
        with raises(FormatError, path):
            READERS[name](path)


TABLES = {
    "ply": PLY, "ply, ascii": ASCII_PLY, "compressed.ply": COMPRESSED, "splat": SPLAT,
    "spz, plain": SPZ, "spz": [*ZIPPED_SPZ, *SPZ_BOMBS], "spz, version 4": [*SPZ_4, *ZSTD_BOMBS],
    "sog": [*SOG, *SOG_BOMBS], "glb": GLB, "html": HTML, "rad": RAD, "ksplat": KSPLAT}


@pytest.mark.parametrize(("sample", "case"), [
    pytest.param(sample, case, id=f"{sample} {at}",
                 marks=[pytest.mark.integration] * (case in (*SPZ_BOMBS, *ZSTD_BOMBS, *SOG_BOMBS)))
    for sample, cases in TABLES.items() for at, case in enumerate(cases)])
def test_damage_of_one_format_is_refused_with_the_reason(good, tmp_path, sample, case):
    change, facts = case
    check_refused(tmp_path / "a", sample, change(good[sample]), facts)


def as_png(picture: bytes) -> bytes:
    data = io.BytesIO()
    Image.open(io.BytesIO(picture)).save(data, "PNG")
    return data.getvalue()


@pytest.mark.parametrize(("sample", "change"), [
    ("sog", lambda data: zipped({**entries_of(data), **{
        name: as_png(entries_of(data)[name]) for name in ("sh0.webp", "quats.webp")}})),
    ("glb", node(rotation=[0, 0, 0, 9])),
    ("glb", node(translation=[3e38, 3e38, 3e38])),
])
def test_what_is_unusual_is_read(good, tmp_path, sample, change):
    (tmp_path / "a").write_bytes(change(good[sample]))
    assert len(READERS[sample](tmp_path / "a")) == {"sog": 70, "glb": 20}[sample]


@pytest.mark.parametrize(("sample", "change"), [
    *(("glb", number(name, struct.pack("<f", value))) for name, value in (
        ("POSITION", math.nan), (f"{EXT}:SCALE", math.inf), (f"{EXT}:OPACITY", math.nan))),
    *(("splat", put(at, struct.pack("<f", value))) for at, value in (
        (4, math.nan), (16, math.inf), (16, math.nan)))])
def test_a_gaussian_that_is_not_finite_is_left_out_and_counted(
    good, tmp_path, caplog, sample, change
):
    (tmp_path / "a").write_bytes(good[sample])
    whole = READERS[sample](tmp_path / "a")
    (tmp_path / "a").write_bytes(change(good[sample]))
    left = READERS[sample](tmp_path / "a")
    assert torch.equal(left.means, whole.means[1:])
    assert torch.equal(left.sh_dc, whole.sh_dc[1:])
    assert_facts(caplog.text, 1, len(whole), "Gaussians", "left")


@pytest.mark.parametrize("sample", ["spz", "spz, version 4"])
def test_bytes_behind_the_data_are_left_out_with_a_warning(good, tmp_path, caplog, sample):
    (tmp_path / "a").write_bytes(good[sample])
    wanted = READERS["spz"](tmp_path / "a").means
    (tmp_path / "a").write_bytes(good[sample] + b"\n")
    assert torch.equal(READERS["spz"](tmp_path / "a").means, wanted)
    assert_facts(caplog.text, 1, "bytes", "data")


CAREFUL = settings(
    max_examples=examples(100), suppress_health_check=[HealthCheck.function_scoped_fixture])


def scene_alone(page: bytes) -> bytes:
    """The element with the scene, which is all of a page that is read."""
    place = scene_of(page)
    return page[page.rindex(b"<script", 0, place.start):place.stop + len(b"</script>")]


@pytest.mark.parametrize("sample", [*SAMPLES, "spz, plain", "spz, inside gzip"])
@CAREFUL
@given(seed=st.integers(0, 2**63))
def test_random_damage_gives_finite_gaussians_or_a_format_error(good, tmp_path, sample, seed):
    data = good["spz, plain" if sample == "spz, inside gzip" else sample]
    data = damaged(scene_alone(data) if sample == "html" else data, seed)
    if sample == "spz, inside gzip":
        data = gzip.compress(data, 1)
    read_or_refused(READERS[format_name(sample)], tmp_path / "a", data)


@pytest.mark.parametrize("part", ["sog entry", "sog meta", "glb tree", "glb numbers"])
@CAREFUL
@given(draws=st.data())
def test_random_damage_inside_gives_finite_gaussians_or_a_format_error(
    good, tmp_path, part, draws
):
    sample, part = part.split()
    if sample == "sog":
        entries = entries_of(good["sog"])
        name = "meta.json" if part == "meta" else draws.draw(st.sampled_from(sorted(entries)))
        entries[name] = (
            json.dumps(draws.draw(damage.changed_json(json.loads(entries[name]))))
            if part == "meta" else draws.draw(damage.changed_bytes(entries[name])))
        data = zipped(entries)
    else:
        tree, numbers = parts_of(good["glb"])
        data = (pack_glb(draws.draw(damage.changed_json(tree)), numbers) if part == "tree"
                else pack_glb(tree, draws.draw(damage.changed_bytes(numbers))))
    read_or_refused(READERS[sample], tmp_path / "a", data)
