"""A scene in another frame: its files and its cameras together show the same pictures."""

from __future__ import annotations

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
import summaries
import torch
from facts import assert_facts, raises
from scenes import random_splats
from tiny_scene import make_inputs
from tiny_stages import run_export

from recon_cli.config.export import ExportConfig, read_matrix
from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, FormatError, StageError
from recon_cli.export.coordinate_frame import choose_frame
from recon_cli.io.colmap import read_images, read_pinholes, read_points
from recon_cli.io.training_scene import PlacedCapture, load_scene
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.similarity import Similarity
from recon_cli.splats.ply import read_ply, read_ply_points, write_ply
from recon_cli.splats.registry import read_splats
from recon_cli.splats.spz import load_spz, unpack
from recon_cli.train.fit.train_data import read_config, write_config
from recon_cli.workspace.atomic import write_json

TURN = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0], [0.48, 0.64, 0.6]])
MOVED = Similarity(2.5, TURN, np.array([3.0, -2, 1]))
AXES = {"z": [0.0, 0, 1], "y": [0.0, 1, 0], "-y": [0.0, -1, 0]}
# Files that keep every value: what float32 leaves of turned means, quaternions and coefficients.
EXACT = 1e-4


@pytest.fixture
def inputs(tmp_path):
    """ingest and sfm of the tiny scene, and Gaussians of degree 3 that stand for a training."""
    given = make_inputs(tmp_path)
    (tmp_path / "train").mkdir()
    splats = random_splats(60, dtype=torch.float32)
    splats.means[:, 2] = 3 + 0.3 * splats.means[:, 2]  # before all cameras
    splats.log_scales.clamp_(-2.5, -1.5)
    splats.sh_rest.clamp_(-0.9, 0.9)  # what an .spz holds
    assert splats.sh_degree == 3
    write_ply(tmp_path / "train" / "splats.ply", splats)
    write_config(tmp_path / "train", RunConfig(max_size=48))
    (tmp_path / "out").mkdir()
    return StageInputs({**given.folders, "train": tmp_path / "train"})


def up_is_z(inputs):
    world = replace(summaries.WORLD, evidence=replace(summaries.EVIDENCE, up_found=True))
    write_json(inputs.folders["place"] / "world.json", world.to_json())


def exported(inputs, **options):
    """The folder of an export and its summary."""
    out = inputs.folders["train"].parent / "out"
    return out, run_export(ExportConfig(**options), inputs, out, StageContext())


def flat(similarity):
    return tuple(similarity.matrix.ravel().tolist())


def of_colmap(sparse):
    """The cameras of a COLMAP model by name."""
    inner = read_pinholes(sparse)
    return {name: inner[name].pinhole(viewmat)
            for name, _, viewmat in read_images(sparse / "images.bin")}


def of_transforms(path):
    """The cameras of a transforms.json by name: camera to world, with OpenGL's axes."""
    value = json.loads(path.read_text())
    return {frame["file_path"].removeprefix("images/"): Camera(
        value["w"], value["h"], value["fl_x"], value["fl_y"], value["cx"], value["cy"],
        np.linalg.inv(np.array(frame["transform_matrix"]) @ np.diag([1.0, -1, -1, 1])))
        for frame in value["frames"]}


def pictures(splats, cameras):
    """The cameras' views, by name."""
    with torch.no_grad():
        return {name: render(splats, camera, splats.background, 3, backend="torch").rgb
                for name, camera in cameras.items()}


def most_apart(one, other):
    assert one.keys() == other.keys()
    assert max(float(value.max()) for value in one.values()) > 0.3  # they show something
    return max(float((one[name] - other[name]).abs().max()) for name in one)


@pytest.mark.integration
@pytest.mark.parametrize("options", [
    {"transform": flat(MOVED)},
    {"transform": flat(MOVED), "scale_between": ("000000.png", "000006.png", 3.0)},
    *({"up": name} for name in AXES),
], ids=str)
def test_files_and_cameras_that_are_handed_out_show_the_same_pictures(inputs, options):
    # No .sog: its palette cannot hold 60 Gaussians of 60 different colours in any frame.
    out, _ = exported(
        inputs, format="compressed.ply,spz,glb,html,colmap,transforms.json", **options)
    before = pictures(read_ply(inputs.folders["train"] / "splats.ply"),
                      of_colmap(inputs.folders["place"] / "undistorted" / "sparse"))
    for cameras in (of_colmap(out / "sparse" / "0"), of_transforms(out / "transforms.json")):
        for name in ("ply", "glb"):
            after = pictures(read_splats(out / f"splats.{name}"), cameras)
            assert most_apart(before, after) < EXACT, name
        for name in ("compressed.ply", "spz", "html"):  # within the steps of each
            after = pictures(read_splats(out / f"splats.{name}"), cameras)
            assert most_apart(before, after) < 0.05, name


@pytest.mark.integration
def test_harmonics_that_did_not_turn_would_be_seen(inputs):
    """The bound above means nothing unless this exceeds it."""
    out, _ = exported(inputs, format="colmap", transform=flat(MOVED))
    before = pictures(read_ply(inputs.folders["train"] / "splats.ply"),
                      of_colmap(inputs.folders["place"] / "undistorted" / "sparse"))
    after = read_ply(out / "splats.ply")
    after.sh_rest = read_ply(inputs.folders["train"] / "splats.ply").sh_rest
    assert most_apart(before, pictures(after, of_colmap(out / "sparse" / "0"))) > 0.2


def test_points_move_with_the_scene(inputs):
    out, _ = exported(inputs, format="points.ply,colmap", transform=flat(MOVED))
    own, _ = read_points(inputs.folders["place"] / "undistorted" / "sparse" / "points3D.bin")
    sparse, _ = read_points(out / "sparse" / "0" / "points3D.bin")
    assert np.allclose(np.sort(sparse, axis=0), np.sort(MOVED.points(own), axis=0))
    points, _ = read_ply_points(out / "points.ply")
    splats = read_ply(inputs.folders["train"] / "splats.ply")
    solid = splats.means[splats.opacities >= 0.5].double().numpy()
    assert np.allclose(points, MOVED.points(solid), atol=1e-5)


def test_the_transform_is_recorded_after_the_scale_with_what_was_measured(inputs):
    out, summary = exported(
        inputs, transform=flat(MOVED), scale_between=("000000.png", "5,5,5", 3.0))
    record = json.loads((out / "transform.json").read_text())
    assert summary.transform == record["similarity"]
    assert record["measurement"]["a"] == "000000.png"
    found = Similarity.from_json(record["similarity"])
    ends = np.array([record["measurement"]["a_xyz"], record["measurement"]["b_xyz"]])
    metres = 3.0 / np.linalg.norm(ends[0] - ends[1])
    assert np.allclose(found.matrix, MOVED.matrix @ Similarity(scale=metres).matrix)



@pytest.mark.parametrize("name", AXES)
def test_where_up_was_not_found_the_cameras_say_it_and_this_is_said(inputs, name, caplog):
    caplog.set_level(logging.WARNING, "recon")
    frame = choose_frame(ExportConfig(up=name), PlacedCapture.read(inputs.folders), None)
    found = frame.similarity.rotation @ [0, -1, 0]  # the tiny cameras have y down
    assert np.allclose(found, AXES[name], atol=1e-6)
    assert_facts("\n".join(caplog.messages), "mean", "cameras")


COMMENTS = {"z": b"comment Vertical Axis: z\n", "-y": b"", "y": b"comment Vertical Axis: +y\n"}


@pytest.mark.parametrize("name", [None, *AXES])
def test_up_is_the_axis_that_was_asked_for_and_the_files_say_so(inputs, name):
    """The highest Gaussian of the scene has the greatest y in the .glb, whatever is up."""
    up_is_z(inputs)
    out, summary = exported(inputs, format="glb,spz", up=name)
    rotation = Similarity.from_json(summary.transform).rotation
    assert np.array_equal(rotation @ [0, 0, 1], AXES[name or "z"])  # to the bit
    assert np.array_equal(rotation @ [1, 0, 0], [1, 0, 0])  # and nothing else turns
    data = (out / "splats.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    value = json.loads(data[20:20 + length])
    at = value["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    highest = float(read_ply(inputs.folders["train"] / "splats.ply").means[:, 2].max())
    assert value["accessors"][at]["max"][1] == pytest.approx(highest, abs=1e-5)
    head = (out / "splats.ply").read_bytes().partition(b"end_header")[0]
    comment = COMMENTS[name or "z"]
    assert (b"Vertical Axis" in head) == bool(comment)
    assert comment in head
    header, _ = unpack(out / "splats.spz", (out / "splats.spz").read_bytes())
    assert (header.version, header.axes, header.up) == (3, None, name or "z")
    # with whatever name, the values are those of the .ply
    back = load_spz(out / "splats.spz").splats
    assert torch.allclose(back.means[:20], read_ply(out / "splats.ply").means[:20], atol=1e-3)


@pytest.mark.parametrize("version", [2, 4])
def test_an_spz_has_the_version_that_was_asked_for(inputs, version):
    out, _ = exported(inputs, format="spz", spz_version=version)
    header, _ = unpack(out / "splats.spz", (out / "splats.spz").read_bytes())
    assert header.version == version


@pytest.mark.parametrize("name", AXES)
def test_a_file_that_names_its_axes_is_checked_in_those(inputs, name):
    """Reading version 4 turns what has y up; the check of the written file must not."""
    _, summary = exported(inputs, format="spz", spz_version=4, up=name)
    assert abs(summary.files["spz"].psnr_change_db) < 0.5


@pytest.mark.integration
def test_a_page_stands_upright_in_any_frame(inputs):
    up_is_z(inputs)
    out, _ = exported(inputs, format="html", transform=flat(MOVED))
    text = (out / "splats.html").read_text(encoding="utf-8")
    start = text.index(">", text.index('<script id="views"')) + 1
    value = json.loads(text[start:text.index("</script>", start)])
    assert np.allclose(value["up"], TURN @ [0, 0, 1])
    scene = load_scene(inputs.folders, validation=read_config(inputs.folders["train"]).validation)
    cameras = of_colmap(inputs.folders["place"] / "undistorted" / "sparse")
    train = sorted(view.name for view in scene.train)
    for view, name in zip(value["views"], train, strict=True):
        pose = np.array(view["pose"]).reshape(3, 4)
        assert np.allclose(pose[:, 3], MOVED.points(cameras[name].center))
    assert "<title>Tiny</title>" in text


@pytest.mark.parametrize(("options", "error", "facts", "hint"), [
    ({"transform": tuple(np.diag([1.0, 2, 1, 1]).ravel().tolist())}, ConfigError, ["stretches"],
     "rotation"),
    ({"scale_between": ("000099.png", "000006.png", 1.0)}, ConfigError, ["000009.png"], ""),
    ({"crop": (1e5, 1e5, 1e5, 2e5, 2e5, 2e5)}, ConfigError, ["Gaussian", "centre"], "and"),
    ({"max_mb": 1e-4}, ConfigError, ["even"], ""),
    ({"max_mb": 1.0, "format": "colmap"}, ConfigError, ["--max-mb"], ""),
    ({"format": "mesh.ply,plan.svg"}, StageError, ["scale", "arbitrary"], "--scale-between"),
])
def test_what_cannot_be_exported_is_refused_before_anything_is_written(
    inputs, options, error, facts, hint
):
    with raises(error, *facts) as caught:
        exported(inputs, **options)
    assert hint in caught.value.hint
    assert list((inputs.folders["train"].parent / "out").iterdir()) == []


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_matrix_that_is_not_finite_is_refused(value):
    with raises(ConfigError, "transform"):
        ExportConfig(transform=(value, *flat(MOVED)[1:]))


def test_a_matrix_with_six_decimals_is_made_a_rotation(inputs):
    rounded = Similarity(1.5, TURN, np.zeros(3)).matrix.round(5) + 1e-5
    rounded[3] = [0, 0, 0, 1]
    _, summary = exported(inputs, transform=tuple(rounded.ravel().tolist()))
    found = Similarity.from_json(summary.transform)
    assert np.allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-12)
    assert found.scale == pytest.approx(1.5, abs=1e-4)


def test_transform_and_up_exclude_each_other():
    with raises(ConfigError, "transform"):
        ExportConfig(transform=flat(MOVED), up="y")


def test_a_file_gives_the_rows_of_its_matrix(tmp_path):
    write_json(tmp_path / "a.json", MOVED.matrix.tolist())
    assert tuple(read_matrix(str(tmp_path / "a.json"))) == flat(MOVED)


@pytest.mark.parametrize("value", [
    {}, [], [[1, 0, 0, 0]] * 3, [[1, 0, 0]] * 4, [["1", 0, 0, 0]] * 4, [[True, 0, 0, 0]] * 4,
    [[None, 0, 0, 0]] * 4, 5, list(range(16))])
def test_a_file_with_something_else_is_refused(tmp_path, value):
    write_json(tmp_path / "a.json", value)
    with raises(ConfigError, 4, "numbers"):
        read_matrix(str(tmp_path / "a.json"))


def test_a_file_that_is_missing_or_no_json_is_refused(tmp_path):
    (tmp_path / "b.json").write_text("[[1, 0")
    for name in ("a.json", "b.json"):
        with raises(FormatError, "JSON"):
            read_matrix(str(tmp_path / name))



def test_a_version_of_spz_that_is_not_written_is_refused():
    for version in (1, 5):
        with raises(ConfigError, "spz_version"):
            ExportConfig(spz_version=version)
