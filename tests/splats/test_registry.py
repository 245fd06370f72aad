"""Formats by content and by name: each reads back what it wrote, under any name."""

import zipfile
from pathlib import PurePath

import pytest
import torch
from archive_splats import room
from facts import raises

from recon_cli.errors import FormatError
from recon_cli.splats.format import WriteSettings
from recon_cli.splats.registry import FORMATS, format_of, load_splats, read_splats
from recon_cli.workspace.export_formats import READABLE

pytestmark = pytest.mark.floors


@pytest.mark.parametrize("name", FORMATS)
def test_each_format_reads_what_it_wrote_by_the_end_of_its_name(name, tmp_path):
    splats = room(40, degree=0)
    path = tmp_path / ("LOD-META.JSON" if name == "lod" else f"room.{name.upper()}")
    FORMATS[name].write(path, splats)
    assert format_of(path).name == name
    back = read_splats(path)
    assert len(back) == 40
    centre = splats.means.mean(0)  # .splat and .sog have an order of their own
    assert torch.allclose(back.means.mean(0), centre, atol=2e-3)


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "splat"])
def test_a_file_is_read_by_its_content_under_any_name(name, tmp_path):
    path = tmp_path / "room"
    FORMATS[name].write(path, room(40, degree=0))
    wanted = FORMATS[name].read(path)
    for other in [row.file for row in READABLE if row.name != name] + ["room.bin"]:
        renamed = tmp_path / PurePath(other).name
        renamed.write_bytes(path.read_bytes())
        assert format_of(renamed).name == name
        assert torch.equal(read_splats(renamed).means, wanted.means)


def test_an_unpacked_sog_is_read_by_its_meta_json(tmp_path):
    FORMATS["sog"].write(tmp_path / "a.sog", room(40, degree=1), WriteSettings(antialiased=True))
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "out")
    wanted, back = load_splats(tmp_path / "a.sog"), load_splats(tmp_path / "out" / "meta.json")
    assert torch.equal(back.splats.sh_rest, wanted.splats.sh_rest)
    assert back.antialiased


@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ("splat", "html")])
def test_a_file_that_is_cut_short_is_refused_under_any_name(name, tmp_path):
    path = tmp_path / "room"
    FORMATS[name].write(path, room(40, degree=0))
    for end in (path.name, "room.spz", "room.ply"):
        (tmp_path / end).write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        with pytest.raises(FormatError) as caught:
            read_splats(tmp_path / end)
        assert caught.value.hint


def test_an_unknown_ending_is_refused_with_those_that_are_known(tmp_path):
    with raises(FormatError, "known", "format") as caught:
        read_splats(tmp_path / "room.xyz")
    assert ".spz" in caught.value.hint
