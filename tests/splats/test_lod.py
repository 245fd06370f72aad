"""lod-meta.json: levels that tile a scene, read back, and refused when they are damaged."""

import json
import os
import re
import shutil

import archive_splats
import pytest
import torch
from facts import raises

from recon_cli.errors import FormatError
from recon_cli.splats import lod
from recon_cli.splats.lod import load_lod, make_levels, write_lod
from recon_cli.splats.registry import read_splats
from recon_cli.splats.sog import Unpacked, load_sog, read_files, write_sog


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(lod, "_LEAF", 100)
    monkeypatch.setattr(lod, "_FILE", 400)


def written(folder, splats=None, **options):
    levels = make_levels(archive_splats.room(2000) if splats is None else splats)
    folder.mkdir(exist_ok=True)
    write_lod(folder / "lod-meta.json", levels, **options)
    return levels


def meta_of(folder):
    return json.loads((folder / "lod-meta.json").read_text())


def leaves(node):
    if "lods" in node:
        return [node]
    return [leaf for child in node["children"] for leaf in leaves(child)]


def test_each_level_has_a_quarter_of_the_one_before(tmp_path):
    levels = written(tmp_path)
    assert [len(level) for level in levels] == [2000, 500, 125, 31]
    meta = meta_of(tmp_path)
    assert (meta["lodLevels"], meta["counts"], meta["count"]) == (4, [2000, 500, 125, 31], 2656)


def test_the_leaves_hold_every_gaussian_of_every_level_once(tmp_path):
    levels = written(tmp_path)
    meta = meta_of(tmp_path)
    files = [read_files(Unpacked(tmp_path / name)).as_tensors() for name in meta["filenames"]]
    assert len(files) > len(levels)
    for level, splats in enumerate(levels):
        seen = {file: torch.zeros(len(part), dtype=torch.int64) for file, part in enumerate(files)}
        for leaf in leaves(meta["tree"]):
            part = leaf["lods"].get(str(level))
            if part is None:
                continue
            rows = slice(part["offset"], part["offset"] + part["count"])
            seen[part["file"]][rows] += 1
            means = files[part["file"]].means[rows]
            assert (means >= torch.tensor(leaf["bound"]["min"]) - 1e-3).all()
            assert (means <= torch.tensor(leaf["bound"]["max"]) + 1e-3).all()
        own = [file for file, name in enumerate(meta["filenames"]) if name.startswith(f"{level}_")]
        assert sum(len(files[file]) for file in own) == len(splats)
        assert all((counts == (file in own)).all() for file, counts in seen.items())


def test_no_leaf_holds_more_than_it_may_and_boxes_hold_their_children(tmp_path):
    written(tmp_path)
    tree = meta_of(tmp_path)["tree"]
    assert max(leaf["lods"]["0"]["count"] for leaf in leaves(tree)) <= 150
    open_nodes = [tree]
    while open_nodes:
        node = open_nodes.pop()
        for child in node.get("children", []):
            assert all(a <= b for a, b in zip(
                node["bound"]["min"], child["bound"]["min"], strict=True))
            assert all(a >= b for a, b in zip(
                node["bound"]["max"], child["bound"]["max"], strict=True))
            open_nodes.append(child)


@pytest.mark.integration
def test_the_scene_comes_back_as_exactly_as_from_a_sog(tmp_path):
    splats = archive_splats.room(2000)
    written(tmp_path, splats)
    write_sog(tmp_path / "a.sog", splats)
    back, same = read_splats(tmp_path / "lod-meta.json"), load_sog(tmp_path / "a.sog").splats
    rows, others = archive_splats.matched(splats, back), archive_splats.matched(splats, same)
    for name, tolerance in (("means", 1e-4), ("quats", 0.02), ("log_scales", 0.02),
                            ("sh_dc", 0.02)):
        value = getattr(splats, name)
        if name == "quats":
            value = archive_splats.unit(value)
            error = 1 - (value[rows] * back.quats).sum(1).abs()
            assert error.max() < 1e-3
            continue
        error = (value[rows] - getattr(back, name)).abs().max()
        assert error <= (value[others] - getattr(same, name)).abs().max() + tolerance
    assert back.sh_degree == 3


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_scene_of_which_some_have_coefficients_comes_back_in_its_degree(tmp_path, degree):
    splats = archive_splats.room(600, degree=degree)
    if degree:
        splats.sh_rest = splats.sh_rest[:250].clone()
    written(tmp_path, splats)
    back = load_lod(tmp_path / "lod-meta.json").splats
    assert (len(back), back.sh_degree) == (600, degree)


def test_a_single_gaussian_is_one_leaf(tmp_path):
    written(tmp_path, archive_splats.room(1))
    assert set(meta_of(tmp_path)["tree"]) == {"bound", "lods"}
    assert len(load_lod(tmp_path / "lod-meta.json").splats) == 1


@pytest.mark.integration
def test_the_same_scene_gives_the_same_bytes_and_replaces_another(tmp_path):
    written(tmp_path / "a")
    written(tmp_path / "b", archive_splats.room(5000, seed=1))
    (tmp_path / "b" / "my_notes").mkdir()
    written(tmp_path / "b")
    names = [sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
             for folder in (tmp_path / "a", tmp_path / "b")]
    assert names[0] == names[1]
    for name in names[0]:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert (tmp_path / "b" / "my_notes").is_dir()


def test_an_environment_is_a_part_of_the_scene(tmp_path):
    written(tmp_path)
    shutil.copytree(tmp_path / "3_0", tmp_path / "env")
    meta = meta_of(tmp_path) | {"environment": "env/meta.json"}
    (tmp_path / "lod-meta.json").write_text(json.dumps(meta))
    assert len(load_lod(tmp_path / "lod-meta.json").splats) == 2000 + 31


def _first_leaf(meta):
    return leaves(meta["tree"])[0]["lods"]["0"]


DAMAGES = {
    "a later version": lambda meta: meta.update(version=2),
    "no tree": lambda meta: meta.pop("tree"),
    "no names": lambda meta: meta.pop("filenames"),
    "a file outside": lambda meta: meta["filenames"].__setitem__(0, "../0_0/meta.json"),
    "an absolute file": lambda meta: meta["filenames"].__setitem__(0, "/etc/meta.json"),
    "a file that is not there": lambda meta: meta["filenames"].__setitem__(0, "9_9/meta.json"),
    "a file of another kind": lambda meta: meta["filenames"].__setitem__(0, "0_0/sh0.webp"),
    "a file twice": lambda meta: (meta["filenames"].append(meta["filenames"][0]), leaves(
        meta["tree"])[1]["lods"].update({"0": _first_leaf(meta) | {
            "file": len(meta["filenames"]) - 1}})),
    "a file twice by another name": lambda meta: meta.update(
        environment=f"./{meta['filenames'][0]}"),
    "a file number too many": lambda meta: _first_leaf(meta).update(file=99),
    "a range beyond the file": lambda meta: _first_leaf(meta).update(count=2**31),
    "a range twice": lambda meta: leaves(meta["tree"])[1]["lods"].update({"0": _first_leaf(meta)}),
    "no count": lambda meta: _first_leaf(meta).pop("count"),
    "a level that is not a number": lambda meta: leaves(meta["tree"])[0].update(lods={"fine": {}}),
    "children that are not a list": lambda meta: meta["tree"].update(children={}),
    "a child that is not a node": lambda meta: meta["tree"]["children"].append(3),
    "a tree without leaves": lambda meta: meta.update(tree={}),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES.keys())
def test_a_damaged_index_is_refused(tmp_path, damage):
    written(tmp_path)
    meta = meta_of(tmp_path)
    damage(meta)
    (tmp_path / "lod-meta.json").write_text(json.dumps(meta))
    with pytest.raises(FormatError):
        load_lod(tmp_path / "lod-meta.json")


@pytest.mark.parametrize("name", ["meta.json", "means_l.webp", "shN_labels.webp"])
@pytest.mark.parametrize("keep", [0, 20])
def test_a_truncated_or_missing_file_is_refused(tmp_path, name, keep):
    written(tmp_path)
    path = tmp_path / "0_0" / name
    data = path.read_bytes()
    path.unlink()
    if keep:
        path.write_bytes(data[:keep])
    with pytest.raises(FormatError):
        load_lod(tmp_path / "lod-meta.json")


def test_many_files_may_not_claim_more_than_all_of_them_can_hold(tmp_path, monkeypatch):
    written(tmp_path)
    for name in meta_of(tmp_path)["filenames"]:
        path = tmp_path / name
        path.write_text(json.dumps(json.loads(path.read_text()) | {"count": 700_000}))
    monkeypatch.setattr(lod, "read_files", None)  # nothing is decoded
    with pytest.raises(FormatError) as caught:
        load_lod(tmp_path / "lod-meta.json")
    (count,) = re.findall(r"(\d+) Gaussians", caught.value.message)
    assert int(count) in (1_400_000, 2_100_000, 2_800_000, 3_500_000)


def test_a_pipe_among_the_files_is_not_waited_for(tmp_path):
    written(tmp_path)
    path = tmp_path / "0_0" / "means_l.webp"
    path.unlink()
    os.mkfifo(path)
    with raises(FormatError, "pipe"):
        load_lod(tmp_path / "lod-meta.json")


def test_names_in_a_file_do_not_lead_out_of_its_folder(tmp_path):
    written(tmp_path)
    path = tmp_path / "0_0" / "meta.json"
    meta = json.loads(path.read_text())
    meta["means"]["files"][0] = "../0_1/means_l.webp"
    path.write_text(json.dumps(meta))
    with raises(FormatError, "leaves", "folder"):
        load_lod(tmp_path / "lod-meta.json")
