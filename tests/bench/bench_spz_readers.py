"""What other programs read in our .spz, against the .ply of the same scene.

`python tests/bench/bench_spz_readers.py` installs pinned packages of npm and PyPI into a temporary
folder (1 GB, minutes; open3d needs libusb-1.0) and prints a table of readers and versions of .spz.
"same" means that positions and rotations are those of the .ply, "turned" that signs of axes differ.
Spark is the one in recon's pages, in headless Chromium. Needs node, npm and Chromium.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.splats import Splats
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.splats.spz import write_spz

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from browser import launch_browser, watch_page
from spark import decode
from splat_cases import edge_splats

_NODE = Path(__file__).with_name("spz_readers.mjs")
_NPM = ("three@0.187.0", "@babylonjs/core@9.28.0", "@babylonjs/loaders@9.28.0", "@adobe/spz@0.2.3",
        "@playcanvas/splat-transform@3.7.0")
_PYPI = ("gsply==0.4.6", "open3d==0.20.0", "zstandard")
_PYTHON = {
    "gsply": "import gsply; found = gsply.read_spz(path); places, turns = found.means, found.quats",
    "open3d": "import open3d; found = open3d.t.io.read_point_cloud(path).point; "
              "places, turns = found.positions.numpy(), found.rot.numpy()",
}
_FILES = {"version 3": {}, "version 2": {"version": 2}, "version 4": {"version": 4}}
_NEAR = 2e-3  # of positions up to 5, of which Spark keeps float16
_SAME_TURN = 0.98  # of the product of two quaternions: version 2 is off by up to .16 where w is 0
Table = NDArray[np.float64]
Read = Callable[[Path], tuple[Table, Table | None]]  # positions [N, 3] and rotations wxyz [N, 4]


def read_by_node(library: str, path: Path) -> tuple[Table, Table | None]:
    """Returns what a library of npm reads."""
    found = json.loads(_run(["node", "spz_readers.mjs", library, str(path)], path.parent))
    rotations = found.get("rotations")
    return np.reshape(found["positions"], (-1, 3)), (
        None if rotations is None else np.reshape(rotations, (-1, 4))[:, [3, 0, 1, 2]])


def read_by_python(library: str, path: Path) -> tuple[Table, Table | None]:
    """Returns what a library of PyPI reads."""
    text = (f"import json, sys; path = {str(path)!r}; {_PYTHON[library]}; "
            "print('\\n' + json.dumps([places.tolist(), turns.tolist()]))")
    program = path.parent / "python" / ("Scripts" if os.name == "nt" else "bin") / "python"
    places, turns = json.loads(_run([str(program), "-c", text], path.parent).splitlines()[-1])
    return np.array(places), np.array(turns)


def read_by_splat_transform(path: Path) -> tuple[Table, Table | None]:
    """Returns what splat-transform reads."""
    out = path.with_suffix(".out.ply")
    _run(["node_modules/.bin/splat-transform", "-q", "-w", str(path), str(out)], path.parent)
    splats = read_ply(out)
    return splats.means.double().numpy(), splats.quats.double().numpy()


def read_by_spark(path: Path) -> tuple[Table, Table | None]:
    """Returns what Spark reads."""
    with launch_browser() as browser, watch_page(browser) as page:
        rows = np.array(decode(page, path)[0])
    return rows[:, :3], rows[:, [9, 6, 7, 8]]


READERS: dict[str, Read] = {
    "three.js 0.187.0": partial(read_by_node, "three"),
    "Babylon.js 9.28.0": partial(read_by_node, "babylon"),
    "Babylon.js without WebAssembly": partial(read_by_node, "babylon-without-wasm"),
    "Spark 2.2.0": read_by_spark,
    "splat-transform 3.7.0": read_by_splat_transform,
    "open3d 0.20.0": partial(read_by_python, "open3d"),
    "gsply 0.4.6": partial(read_by_python, "gsply"),
    "@adobe/spz 0.2.3": partial(read_by_node, "adobe"),
}


def _run(command: list[str], folder: Path) -> str:
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def compare(read: Read, path: Path, splats: Splats) -> str:
    """Returns how a reader has the file of these Gaussians."""
    try:
        places, turns = read(path)
    except Exception as error:  # whatever a program does with a file
        text = str(getattr(error, "stderr", "") or error)
        lines = [line.strip() for line in text.splitlines() if "Error: " in line]
        return "refused: " + (lines or [text])[0][:70]
    return describe(places, turns, splats)


def describe(places: Table, turns: Table | None, splats: Splats) -> str:
    """Returns whether positions and rotations are those of these Gaussians."""
    wanted, quats = splats.means.double().numpy(), splats.quats.double().numpy()
    for signs in product([1, -1], repeat=3):
        if places.shape == wanted.shape and np.allclose(places, wanted * signs, atol=_NEAR):
            break
    else:
        return "OTHER POSITIONS"
    if signs != (1, 1, 1):
        return "TURNED: " + " ".join(f"{'-+'[sign > 0]}{axis}" for sign, axis in zip(
            signs, "xyz", strict=True))
    if turns is None:
        return "same positions"
    units = [value / np.linalg.norm(value, axis=1, keepdims=True) for value in (turns, quats)]
    same = abs((units[0] * units[1]).sum(axis=1)).min() > _SAME_TURN
    return "same" if same else "OTHER ROTATIONS"


def install(folder: Path) -> None:
    """Installs the packages into a folder."""
    (folder / "package.json").write_text('{"private": true, "type": "module"}')
    (folder / _NODE.name).write_bytes(_NODE.read_bytes())
    _run(["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", *_NPM], folder)
    venv.create(folder / "python", with_pip=True)
    program = folder / "python" / ("Scripts" if os.name == "nt" else "bin") / "python"
    _run([str(program), "-m", "pip", "install", "-q", *_PYPI], folder)


@click.command()
@click.option("--folder", type=click.Path(path_type=Path), help="Keeps the packages there.")
def main(folder: Path | None) -> None:
    """Print a row for each reader."""
    with tempfile.TemporaryDirectory() as scratch:
        place = folder or Path(scratch)
        place.mkdir(exist_ok=True)
        if not (place / "python").exists():
            install(place)
        splats = edge_splats(3)
        splats.means.clamp_(-5, 5)
        splats.quats[:9] = splats.quats[9]  # one is zero, and others have two greatest components
        write_ply(place / "a.ply", splats)
        options: dict[str, Any]
        for name, options in _FILES.items():
            write_spz(place / f"{name}.spz".replace(" ", "-"), splats, up="-y", **options)
        click.echo(f"| reader | {' | '.join(_FILES)} |\n|---" + "|---" * len(_FILES) + "|")
        for reader, read in READERS.items():
            found = [compare(read, place / f"{name}.spz".replace(" ", "-"), splats)
                     for name in _FILES]
            click.echo(f"| {reader} | " + " | ".join(found) + " |")


if __name__ == "__main__":
    main()
