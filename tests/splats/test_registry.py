"""Formats by the names of their files: each reads back what it wrote, and none takes another's."""

import pytest
import torch
from archive_splats import room

from recon_cli.errors import FormatError
from recon_cli.splats.registry import FORMATS, format_of, read_splats
from recon_cli.workspace.export_formats import EXPORT_FORMATS

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
def test_a_file_under_the_name_of_another_format_is_refused(name, tmp_path):
    path = tmp_path / "room"
    FORMATS[name].write(path, room(40, degree=0))
    for other in FORMATS.keys() - {name, "splat"}:
        renamed = tmp_path / EXPORT_FORMATS[other].file
        renamed.parent.mkdir(exist_ok=True)
        renamed.write_bytes(path.read_bytes())
        with pytest.raises(FormatError) as caught:
            read_splats(renamed)
        assert caught.value.hint


def test_an_unknown_ending_is_refused_with_those_that_are_known(tmp_path):
    with pytest.raises(FormatError, match="known format") as caught:
        read_splats(tmp_path / "room.xyz")
    assert ".spz" in caught.value.hint
