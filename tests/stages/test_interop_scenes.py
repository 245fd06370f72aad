"""Files that other programs wrote come into a workspace and go out again."""

import pytest
import torch
from foreign import recon

from recon_cli.splats.registry import read_splats

pytestmark = pytest.mark.integration

FOLDERS = {"metal": "metalsplatter/SplatIO/TestData",
           "transform": "splat-transform/test/fixtures/splat", "engine": "playcanvas-engine",
           "viewer": "splat-viewer"}
FILES = {  # Gaussians
    "metal/test-splat.3-points-from-train.ply": 3,
    "metal/test-splat.3-points-from-train.splat": 3,
    "metal/test-splat.3-points-from-train.spz": 3,
    "transform/minimal-raw.spz": 4,
    "transform/minimal-v2.spz": 4,
    "transform/minimal-v3.spz": 4,
    "transform/minimal-v4.spz": 4,
    "transform/minimal.splat": 4,
    "transform/minimal.ksplat": 4,
    "engine/guitar.compressed.ply": 90_854,
    "engine/biker.compressed.ply": 152_746,
    "engine/biker.spz": 152_746,
    "viewer/model.splat": 124_495,
}


def found(shared_data, name):
    folder, file = name.split("/")
    return shared_data / "interop" / FOLDERS[folder] / file


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_another_program_is_imported_and_exported(shared_data, tmp_path, name):
    path = found(shared_data, name)
    assert recon("import", tmp_path / "ws", path, "--max-size", 120) == 0
    back, there = (read_splats(one) for one in (tmp_path / "ws" / "train" / "splats.ply", path))
    assert len(back) == FILES[name]
    for ours, theirs in zip(
            back.parameters().values(), there.parameters().values(), strict=True):
        assert torch.equal(ours, theirs)
    assert recon("export", tmp_path / "ws", "--format", "glb") == 0
