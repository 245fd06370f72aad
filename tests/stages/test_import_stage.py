"""The files of import, their frame, and their scores on the views."""

import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import summaries
import torch
from facts import assert_facts, raises
from foreign import truth
from scenes import random_splats
from tiny_scene import make_inputs
from tiny_stages import run_export

from recon_cli.config.export import ExportConfig
from recon_cli.config.stages import ImportConfig, PruneConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, FormatError, InputError, ReconstructionError
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import transformed
from recon_cli.splats.axes import turn_from
from recon_cli.splats.format import WriteSettings
from recon_cli.splats.glb import write_glb
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.splats.registry import FORMATS, load_splats
from recon_cli.splats.spz import write_spz
from recon_cli.stages import evaluate, import_scene, prune
from recon_cli.train.fit.train_data import read_config
from recon_cli.workspace.atomic import write_json
from recon_cli.workspace.export_formats import EXPORT_FORMATS
from recon_cli.workspace.records import ImportRecord

TURN = np.array([[0.0, -1, 0], [0.6, 0, 0.8], [-0.8, 0, 0.6]])
WORLD = Similarity(2.5, TURN, np.array([3.0, -1, 2]))  # from the source's frame to the workspace's
CONTEXT = StageContext(backend="numba")


@pytest.fixture
def inputs(tmp_path):
    given = make_inputs(tmp_path / "views")
    world = replace(summaries.WORLD, similarity=WORLD.to_json())
    write_json(given.folders["place"] / "world.json", world.to_json())
    return given


def brought_in(path, given, out, **options):
    out.mkdir()
    folders = StageInputs(given.folders if given else {}, (path,))
    return import_scene.run(ImportConfig(**options), folders, out, CONTEXT)


def written(path, splats):
    write_ply(path, splats)
    return path


def test_the_scene_of_the_workspace_is_taken_as_it_is(inputs, tmp_path):
    path = written(tmp_path / "a.ply", truth())
    summary = brought_in(path, inputs, tmp_path / "train")
    assert (tmp_path / "train" / "splats.ply").read_bytes() == path.read_bytes()
    assert (summary.imported_from, summary.frame) == ("a.ply", "workspace")
    assert summary.training_psnr_db > 40  # nothing but 8 bits apart
    assert summary.notices is None


def test_a_scene_of_the_source_is_moved_and_its_harmonics_turned(inputs, tmp_path):
    colored = random_splats(60, seed=0, dtype=torch.float32).with_degree(1).sh_rest
    whole = truth().with_degree(1)
    whole.sh_rest = 0.2 * colored
    path = written(tmp_path / "a.ply", transformed(whole, WORLD.inverse()))
    summary = brought_in(path, inputs, tmp_path / "train")
    assert summary.frame == "source"
    back = read_ply(tmp_path / "train" / "splats.ply")
    assert torch.allclose(back.means, whole.means, atol=1e-4)
    assert torch.allclose(back.log_scales, whole.log_scales, atol=1e-5)
    assert torch.allclose(back.sh_rest, whole.sh_rest, atol=1e-5)
    assert not torch.allclose(read_ply(path).sh_rest, whole.sh_rest, atol=1e-2)
    assert summary.tried_psnr_db["source"] > summary.tried_psnr_db["workspace"] + 10
    assert summary.transform == WORLD.to_json()


def test_a_scene_in_the_wrong_frame_is_said_to_be_so_wherever_it_is_scored(
    inputs, tmp_path, caplog
):
    path = written(tmp_path / "a.ply", transformed(truth(), WORLD.inverse()))
    with caplog.at_level(logging.WARNING, "recon"):
        summary = brought_in(path, inputs, tmp_path / "train", frame="workspace")
    assert_facts(summary.notices[0], "frame", "cameras")
    assert summary.notices[0] in caplog.text
    assert summary.training_psnr_db < summary.flat_psnr_db
    (tmp_path / "evaluate").mkdir()
    folders = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    evaluate.run(evaluate.EvaluateConfig(), folders, tmp_path / "evaluate", CONTEXT)
    assert_facts((
        tmp_path / "evaluate" / "table.txt").read_text(), "frame", "cameras")


def test_a_scene_that_is_only_a_little_off_is_doubted(inputs, tmp_path):
    off = Similarity(translation=np.array([0.15, 0.1, 0.0]))
    path = written(tmp_path / "a.ply", transformed(truth(), off))
    summary = brought_in(path, inputs, tmp_path / "train", frame="workspace")
    assert_facts(summary.notices[0], "differs", "little")


def test_without_views_nothing_is_moved_and_the_record_says_so(tmp_path):
    path = written(tmp_path / "a.ply", truth())
    summary = brought_in(path, None, tmp_path / "train")
    assert summary.views == 0
    record = json.loads((tmp_path / "train" / "import.json").read_text())
    assert (record["gaussians"], record["views"], record["z_up"]) == (60, False, False)
    assert (tmp_path / "train" / "splats.ply").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_comes_in(tmp_path, name):
    path = tmp_path / EXPORT_FORMATS[name].file
    FORMATS[name].write(path, truth())
    summary = brought_in(path, None, tmp_path / "train")
    assert (summary.format, summary.gaussians) == (name, 60)
    assert len(read_ply(tmp_path / "train" / "splats.ply")) == 60
    assert read_config(tmp_path / "train").max_gaussians == 60


def test_what_holds_no_scene_is_refused(tmp_path):
    (tmp_path / "a.txt").write_text("text")
    empty = written(tmp_path / "e.ply", truth().select(torch.zeros(60, dtype=torch.bool)))
    for path, fact in ((tmp_path / "a.txt", "format"), (empty, "Gaussians")):
        with raises(FormatError, path.name, fact):
            brought_in(path, None, tmp_path / f"out-{path.stem}")
    with raises(InputError, 2, "files"):
        import_scene.run(ImportConfig(), StageInputs({}, (empty, empty)), tmp_path, CONTEXT)


def test_views_without_one_to_look_at_are_refused(inputs, tmp_path):
    path = inputs.folders["ingest"] / "frames.json"
    frames = json.loads(path.read_text())
    for frame in frames["frames"]:
        frame["held_out"] = True
    path.write_text(json.dumps(frames))
    with raises(ReconstructionError, "training", "view"):
        brought_in(written(tmp_path / "a.ply", truth()), inputs, tmp_path / "train")


def test_an_imported_scene_is_pruned_like_a_trained_one(inputs, tmp_path):
    brought_in(written(tmp_path / "a.ply", truth()), inputs, tmp_path / "train")
    folders = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    (tmp_path / "prune").mkdir()
    config = PruneConfig(ratio=0.25, recovery=24)
    summary = prune.run(config, folders, tmp_path / "prune", CONTEXT)
    assert (summary.gaussians_before, summary.gaussians) == (60, 45)
    assert summary.iterations == summary.recovery_steps == 24
    assert summary.validation_psnr_db_before > 40
    assert summary.validation_psnr_db > 35
    with raises(ConfigError, "imported"):
        prune.run(PruneConfig(at="mid"), folders, tmp_path / "prune", CONTEXT)


def test_a_score_says_that_the_views_may_have_been_trained_on(inputs, tmp_path):
    brought_in(written(tmp_path / "a.ply", truth()), inputs, tmp_path / "train")
    folders = StageInputs({**inputs.folders, "train": tmp_path / "train"})
    (tmp_path / "evaluate").mkdir()
    evaluate.run(evaluate.EvaluateConfig(), folders, tmp_path / "evaluate", CONTEXT)
    metrics = json.loads((tmp_path / "evaluate" / "metrics.json").read_text())
    assert metrics["imported_from"] == "a.ply"
    assert metrics["models"]["base"]["train_seconds"] is None
    table = (tmp_path / "evaluate" / "table.txt").read_text()
    assert_facts(table, "trained", "held-out", "views")


def test_a_scene_that_wants_antialiasing_is_said_to(tmp_path):
    path = written(tmp_path / "a.ply", truth())
    path.write_bytes(path.read_bytes().replace(
        b"element", b"comment SplatRenderMode: mip\nelement", 1))
    (notice,) = brought_in(path, None, tmp_path / "train").notices
    assert_facts(notice, "a.ply", "antialiased")


def in_record(folder):
    return json.loads((folder / "import.json").read_text())


@pytest.mark.parametrize("name", [name for name in FORMATS if name != "splat"])
@pytest.mark.parametrize("wanted", [[0, 0, 1], [0, -1, 0], [0, 1, 0]])
def test_an_exported_scene_comes_back_with_the_same_axis_up(tmp_path, name, wanted):
    """Without views: every format that is written and has room for it says what is up."""
    path = tmp_path / Path(EXPORT_FORMATS[name].file).name
    FORMATS[name].write(path, truth(), WriteSettings(up=np.array(wanted, float)))
    brought_in(path, None, tmp_path / "train")
    assert ImportRecord.read(tmp_path / "train").up().tolist() == wanted
    back = read_ply(tmp_path / "train" / "splats.ply").means
    distance = torch.cdist(back, truth().means)  # some formats have another order
    assert distance.min(dim=0).values.max() < 5e-3
    assert distance.min(dim=1).values.max() < 5e-3


@pytest.mark.parametrize(("axes", "up", "signs"), [
    ("z-up", [0, 0, 1], [1, 1, 1]), ("y-down", [0, -1, 0], [1, 1, 1]),
    ("rub", [0, -1, 0], [1, -1, -1]), ("luf", [0, -1, 0], [-1, -1, 1]),
    ("rfu", [0, 0, 1], [1, 1, 1]), ("rbu", [0, 0, 1], [1, -1, 1]),
])
@pytest.mark.parametrize("name", ["ply", "spz"])
def test_axes_that_are_given_win_over_what_the_file_says(tmp_path, name, axes, up, signs):
    path = tmp_path / f"a.{name}"
    if name == "ply":
        write_ply(path, truth(), comments=["Vertical Axis: z"])
    else:
        write_spz(path, truth(), up="z")
    brought_in(path, None, tmp_path / "train", axes=axes)
    assert ImportRecord.read(tmp_path / "train").up().tolist() == up
    back = read_ply(tmp_path / "train" / "splats.ply")
    assert torch.allclose(back.means, truth().means * torch.tensor(signs), atol=1e-3)


def test_a_glb_in_axes_that_are_given_is_read_as_it_is_stored(tmp_path):
    write_glb(tmp_path / "a.glb", truth())  # (x, y, z) becomes (x, z, -y)
    brought_in(tmp_path / "a.glb", None, tmp_path / "train", axes="rub")
    back = read_ply(tmp_path / "train" / "splats.ply").means
    assert torch.allclose(back, truth().means[:, [0, 2, 1]] * torch.tensor([1, -1, 1]), atol=1e-5)


def far_away(path, place):
    """Writes the scene with double positions at a place."""
    write_ply(path, truth())
    head, data = path.read_bytes().split(b"end_header\n", 1)
    for axis in b"xyz":
        line = b"property float %c\n" % axis
        head = head.replace(line, line.replace(b"float", b"double"))
    rest = np.frombuffer(data, "<f4").reshape(60, -1)
    rows = np.zeros(60, [("means", "<f8", 3), ("rest", "<f4", rest.shape[1] - 3)])
    rows["means"], rows["rest"] = rest[:, :3] + np.array(place), rest[:, 3:]
    path.write_bytes(head + b"end_header\n" + rows.tobytes())
    return path


def test_a_scene_in_map_coordinates_is_moved_and_says_by_how_much(tmp_path, caplog):
    path = far_away(tmp_path / "a.ply", [448262.25, 5411932.5, 301.5])
    summary = brought_in(path, None, tmp_path / "train")
    origin = in_record(tmp_path / "train")["origin"]
    back = read_ply(tmp_path / "train" / "splats.ply")
    place = np.array([448262.25, 5411932.5, 301.5])
    assert np.allclose(back.means.double().numpy() + origin,
                       truth().means.double().numpy() + place, atol=1e-5)
    assert Similarity.from_json(summary.transform).translation.tolist() == [-x for x in origin]
    assert_facts(summary.notices[0], "0.25")
    assert sum("rounds" in record.getMessage() for record in caplog.records) == 1


def test_a_scene_in_map_coordinates_fits_cameras_that_are_in_them_too(inputs, tmp_path):
    place = np.array([448262.25, 5411932.5, 301.5])
    world = Similarity(translation=-place)
    record = replace(summaries.WORLD, similarity=world.to_json())
    write_json(inputs.folders["place"] / "world.json", record.to_json())
    summary = brought_in(far_away(tmp_path / "a.ply", place), inputs, tmp_path / "train")
    assert summary.frame == "source"
    assert summary.training_psnr_db > 40
    back = read_ply(tmp_path / "train" / "splats.ply")
    assert torch.allclose(back.means, truth().means, atol=1e-4)
    assert summary.transform == world.to_json()
    assert "origin" not in in_record(tmp_path / "train")
    assert summary.notices is None


def test_an_spz_that_does_not_fit_the_views_is_said_to_have_other_axes_perhaps(inputs, tmp_path):
    write_spz(tmp_path / "a.spz", turn_from("rub", truth()))
    summary = brought_in(tmp_path / "a.spz", inputs, tmp_path / "train")
    assert "--axes rub" in summary.notices[1]
    summary = brought_in(tmp_path / "a.spz", inputs, tmp_path / "again", axes="rub")
    assert summary.notices is None
    assert summary.frame == "workspace"


@pytest.mark.integration
def test_what_was_trained_with_antialiasing_is_recorded_said_and_exported(tmp_path):
    write_ply(tmp_path / "a.ply", truth(), comments=["SplatRenderMode: mip"])
    summary = brought_in(tmp_path / "a.ply", None, tmp_path / "train")
    assert "Mip-Splatting" in summary.notices[0]
    assert ImportRecord.read(tmp_path / "train").antialiased
    config = ExportConfig(format="spz,sog,ply", max_loss=30)
    (tmp_path / "export").mkdir()
    run_export(config, StageInputs({"train": tmp_path / "train"}), tmp_path / "export", CONTEXT)
    for name in config.formats:
        assert load_splats(tmp_path / "export" / f"splats.{name}").antialiased, name


def test_a_scene_that_was_moved_is_exported_with_the_point_it_was_moved_from(tmp_path):
    brought_in(far_away(tmp_path / "a.ply", [448262.25, 5411932.5, 301.5]), None,
               tmp_path / "train")
    (tmp_path / "export").mkdir()
    run_export(ExportConfig(), StageInputs({"train": tmp_path / "train"}), tmp_path / "export",
               CONTEXT)
    record = json.loads((tmp_path / "export" / "transform.json").read_text())
    assert record["origin"] == in_record(tmp_path / "train")["origin"]
