"""A layout that another package adds by the entry point `recon.layouts`."""

import subprocess
import sys

import posed_sets
import pytest
from facts import assert_facts

READER = '''
import json

import numpy as np

from recon_cli.datasets.frame_table import FrameTable
from recon_cli.datasets.layouts import Layout
from recon_cli.datasets.posed import PosedImage


def fits(path):
    return (path / "toy.json").is_file()


def read(path):
    table = FrameTable(path)
    for row in json.loads((path / "toy.json").read_text()):
        with table.frame(row["file"]):
            pose = np.eye(4)
            pose[:3, 3] = row["place"]
            lens = table.lens((32, 24), tuple, (30.0, 30.0, 16.0, 12.0))
            table.add(PosedImage(
                row["file"], path / row["file"], lens, table.pose(pose.tolist)))
    return table.finish_tracked()


TOY = Layout("toy", "a toy capture", "toy.json and its pictures", fits, read)
TAKEN = Layout("colmap", "another COLMAP model", "toy.json", fits, read)
'''
ROWS = "[recon.layouts]\ntoy = toy_reader:TOY\ntaken = toy_reader:TAKEN\nlost = nowhere:ROW\n"
FIRST = {"recon": "", "the package": "import toy_reader\n"}


@pytest.fixture
def site(tmp_path):
    """Returns a folder where the package is installed."""
    info = tmp_path / "site" / "toy_reader-1.0.dist-info"
    info.mkdir(parents=True)
    (tmp_path / "site" / "toy_reader.py").write_text(READER)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: toy-reader\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(ROWS)
    return tmp_path / "site"


@pytest.fixture
def capture(tmp_path):
    folder = tmp_path / "capture"
    for name in "abcde":
        posed_sets.write_image(folder / f"{name}.png")
    (folder / "toy.json").write_text(
        '[{"file": "a.png", "place": [0, 0, 0]}, {"file": "b.png", "place": [1, 0, 0]},'
        ' {"file": "c.png", "place": [NaN, 0, 0]}]')
    return folder


def run(site, code, *words):
    code = f"import sys; sys.path.append({str(site)!r})\n{code}"
    return subprocess.run([sys.executable, "-c", code, *map(str, words)], capture_output=True,
                          text=True, check=False)


@pytest.mark.integration
@pytest.mark.parametrize("first", FIRST)
def test_its_captures_are_read_whichever_is_imported_first(site, capture, first):
    done = run(site, FIRST[first] + (
        "from pathlib import Path\n"
        "from recon_cli.datasets.layouts import describe, read_posed, recognise\n"
        "path = Path(sys.argv[1])\n"
        "posed = read_posed(path)\n"
        "print(recognise(path), len(posed.images), posed.images[1].viewmat[0, 3], posed.metric)\n"
        "print(describe(posed))\n"), capture)
    assert done.returncode == 0, done.stderr
    read, described = done.stdout.splitlines()
    assert read.split() == ["toy", "2", "-1.0", "True"]
    assert_facts(described, "toy", 2)
    for name in ("toy_reader:TAKEN", "nowhere:ROW"):  # a name that is taken, and no such module
        assert name in done.stderr
    assert "toy_reader:TOY" not in done.stderr


@pytest.mark.integration
def test_without_the_package_the_same_folder_holds_photos(tmp_path, capture):
    done = run(tmp_path, (
        "from pathlib import Path\n"
        "from recon_cli.datasets.layouts import recognise\n"
        "print(recognise(Path(sys.argv[1])))\n"), capture)
    assert done.stdout == "None\n", done.stderr
