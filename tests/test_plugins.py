"""Formats and layouts that another package adds by entry points."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from recon_cli.scene.splats import Splats
from recon_cli.splats.ply import read_ply, write_ply

FORMATS = """
from recon_cli.workspace.export_formats import ExportFormat

TOY = ExportFormat("toy", "gaussians", "splats.toy", "toy_recon.toy")
TAKEN = ExportFormat("spz", "gaussians", "splats.spz", "toy_recon.toy")
NO_ROW = 3
"""
TOY = """
from recon_cli.splats import ply
from recon_cli.splats.format import SplatFormat

FORMAT = SplatFormat(ply.FORMAT.load, ply.FORMAT.write_with)
"""
LAYOUT = """
import numpy as np

from recon_cli.datasets.layouts import Layout
from recon_cli.datasets.posed import PosedImage, PosedSet
from recon_cli.scene.camera import Lens


def read(path):
    lens = Lens("PINHOLE", 40, 30, (30.0, 30.0, 20.0, 15.0))
    return PosedSet("toy", (PosedImage("a.png", path / "a.png", lens, np.eye(4)),), sequence=False)


TOY = Layout("toy", "a toy", "toy.txt", lambda path: (path / "toy.txt").is_file(), read)
"""
POINTS = """[recon.formats]
toy = toy_recon.formats:TOY
taken = toy_recon.formats:TAKEN
no_row = toy_recon.formats:NO_ROW
missing = toy_recon.nowhere:ROW

[recon.layouts]
toy = toy_recon.layout:TOY
"""


@pytest.fixture
def python(tmp_path):
    """Runs Python where the package is installed."""
    package, info = tmp_path / "site" / "toy_recon", tmp_path / "site" / "toy_recon-1.0.dist-info"
    package.mkdir(parents=True)
    info.mkdir()
    for name, text in (("__init__", ""), ("formats", FORMATS), ("toy", TOY), ("layout", LAYOUT)):
        (package / f"{name}.py").write_text(text)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-recon\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(POINTS)

    def run(*words):
        code = f"import sys; sys.path.append({str(tmp_path / 'site')!r})\n{words[0]}"
        return subprocess.run(
            [sys.executable, "-c", code, *words[1:]], capture_output=True, text=True, check=False)

    return run


@pytest.mark.integration
def test_a_format_of_another_package_is_written_and_read(python, tmp_path):
    splats = Splats(torch.randn(5, 3), torch.randn(5, 4), torch.full((5, 3), -1.5),
                    torch.full((5,), 2.0), 0.5 * torch.randn(5, 3), torch.zeros(5, 0, 3))
    write_ply(tmp_path / "room.ply", splats)
    done = python("from recon_cli.__main__ import main; sys.argv[0] = 'recon'; main()", "convert",
                  str(tmp_path / "room.ply"), str(tmp_path / "room.toy"))
    assert done.returncode == 0, done.stderr
    assert torch.equal(read_ply(tmp_path / "room.toy").means, splats.means)
    for words in ("toy_recon.formats:TAKEN is left out", "toy_recon.formats:NO_ROW is left out",
                  "toy_recon.nowhere:ROW cannot be loaded"):
        assert words in done.stderr


@pytest.mark.integration
def test_a_layout_of_another_package_is_recognised_and_read(python, tmp_path):
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "toy.txt").touch()
    done = python(
        "from pathlib import Path\n"
        "from recon_cli.datasets.layouts import recognise, read_posed\n"
        "path = Path(sys.argv[1])\n"
        "print(recognise(path), read_posed(path).images[0].name)", str(tmp_path / "set"))
    assert done.stdout == "toy a.png\n", done.stderr
