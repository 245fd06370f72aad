"""Commands that describe, convert and report start without libraries that take seconds."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from report_workspace import make_workspace

from recon_cli.render.numba.backend import warm_up
from recon_cli.scene.splat_arrays import SplatArrays
from recon_cli.splats.ply import write_ply
from recon_cli.splats.registry import FORMATS

HEAVY = {"torch", "scipy.spatial", "scipy.sparse", "pycolmap", "skimage", "trimesh", "ray"}


def imported_by(*words: object) -> set[str]:
    """Returns the packages of HEAVY, and numba, that a command has imported when it ends."""
    code = f"""
import sys
from recon_cli.cli import main
assert main({[*map(str, words)]}) == 0
print("imported", *({HEAVY | {'numba'}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return set(done.stdout.splitlines()[-1].split()[1:])


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    warm_up()  # kernels that are not there are compiled, by a process with torch
    rng = np.random.default_rng(0)
    values = [rng.normal(size=shape).astype(np.float32)
              for shape in ((60, 3), (60, 4), (60, 3), (60,), (60, 3), (60, 15, 3))]
    write_ply(tmp_path / "a.ply", SplatArrays(*values))
    return tmp_path / "a.ply"


@pytest.mark.integration
@pytest.mark.parametrize("name", ["ply", "spz", "compressed.ply"])
def test_a_file_is_converted_and_described_without_torch(scene: Path, name: str) -> None:
    out = scene.with_name(f"b.{name}")
    assert imported_by("convert", scene, out, "--max-loss", 40) == {"numba"}
    assert imported_by("info", out) == {"numba"}
    assert len(FORMATS[name].read(out)) == 60


@pytest.mark.integration
def test_a_report_is_written_without_torch(tmp_path: Path) -> None:
    workspace = make_workspace(tmp_path)
    assert imported_by("report", "-w", workspace) == set()
