import contextlib
import json
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from facts import raises
from sfm_inputs import every_nth, run, write_inputs

from recon_cli.context import StageContext
from recon_cli.errors import SfmError
from recon_cli.io.colmap import read_images, read_scene
from recon_cli.io.images import read_png
from recon_cli.sfm import database
from recon_cli.sfm.job import STEPS
from recon_cli.workspace.atomic import clear_leftovers
from recon_cli.workspace.steps import StepFolder
from recon_cli.workspace.summaries import PlaceSummary

STEP, COUNT = 4, 12  # every 4th frame of the sample: few, and each still overlaps the next
BLANK = "000099.png"  # a grey frame, held out, that can find no camera
FILTERED = "000012.png"  # the one frame whose denoised twin differs
FEATURES = 2048
MODEL = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")

# A parent of its own, to be killed; its arguments: inputs, output, features.
RUN = """
import sys
from pathlib import Path
from recon_cli.config.stages import SfmConfig
from recon_cli.stages import sfm
from recon_cli.context import StageContext, StageInputs
base = Path(sys.argv[1])
sfm.run(SfmConfig(max_features=int(sys.argv[3])),
        StageInputs({"ingest": base / "ingest"}), Path(sys.argv[2]),
        StageContext(threads=2))
"""


def workers():
    """The mapping processes that this test process has started."""
    return [
        child for child in psutil.Process().children(recursive=True)
        if "recon_cli.sfm.mapping.worker" in " ".join(child.cmdline())
    ]


@pytest.fixture(scope="module")
def room(tmp_path_factory, sample_video):
    """Twelve frames of the sample room and a blank one."""
    images = every_nth(sample_video, STEP, COUNT)
    images[BLANK] = np.full_like(images["000000.png"], 128)
    return write_inputs(
        tmp_path_factory.mktemp("room"), images, filtered=[FILTERED],
        held_out=["000000.png", "000040.png", BLANK])


@pytest.fixture(scope="module")
def mapped(room, tmp_path_factory):
    """(output folder, summary, what was recorded) of an uninterrupted run."""
    out, seen = tmp_path_factory.mktemp("mapped"), []
    ctx = StageContext(threads=2, record=lambda *done: seen.append(done))
    return out, run(room, out, ctx=ctx, max_features=FEATURES), seen


@pytest.mark.integration
def test_every_frame_that_shows_the_room_gets_a_camera(mapped):
    _, summary, _ = mapped
    assert summary.frames == COUNT + 1
    assert summary.registered == COUNT
    assert summary.unregistered == summary.unregistered_held_out == (BLANK,)


@pytest.mark.integration
def test_the_summary_is_json_and_has_plausible_figures(mapped):
    _, summary, _ = mapped
    text = json.dumps(summary.to_json(), allow_nan=False)
    assert PlaceSummary.from_json(json.loads(text)) == summary
    assert summary.points > 300
    assert summary.mean_track_length > 2
    assert 0 < summary.reprojection_error_px < 1
    assert summary.median_triangulation_angle_deg > 5
    assert summary.models[0] == COUNT
    assert set(summary.seconds) == {"features", "matches", "model"}
    camera, = summary.cameras
    assert camera["frames"] == COUNT
    assert camera["focal_px"] == pytest.approx(300, rel=0.03)  # the room was rendered with 300


@pytest.mark.integration
def test_camera_centres_agree_with_the_rendered_path(mapped, shared_data):
    out, _, _ = mapped
    lines = (shared_data / "rooms" / "office" / "traj.txt").read_text().splitlines()
    poses = read_images(out / "sparse" / "images.bin")
    found = np.array([-view[:3, :3].T @ view[:3, 3] for _, _, view in poses])
    truth = np.array([
        np.array(lines[int(name[:6])].split(), float).reshape(4, 4)[:3, 3] for name, _, _ in poses])
    # The walk is 7 m long; all 100 frames come within 0.3 cm, twelve of them within 1.
    assert similarity_rmse(found, truth) < 0.03


def similarity_rmse(found, truth):
    """Root mean square distance after the best similarity (Umeyama 1991), units of `truth`."""
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ flip) / (a**2).sum()
    return np.sqrt(((scale * a @ (u @ flip @ vt).T - b) ** 2).sum(axis=1).mean())


@pytest.mark.integration
def test_the_scene_can_be_read_with_its_twins(mapped):
    out, summary, _ = mapped
    scene = read_scene(
        out / "undistorted", held_out=frozenset({"000000.png", "000040.png", BLANK}),
        validation=0.1)
    assert len(scene.train) + len(scene.validation) == COUNT - 2
    assert [view.name for view in scene.test] == ["000000.png", "000040.png"]
    assert scene.unregistered_test == (BLANK,)
    assert len(scene.points) == summary.points
    assert (scene.train[0].camera.width, scene.train[0].camera.height) == (
        summary.cameras[0]["width"], summary.cameras[0]["height"])


@pytest.mark.integration
def test_twins_are_identical_exactly_where_nothing_was_denoised(mapped):
    out, _, _ = mapped
    images, twins = out / "undistorted" / "images", out / "undistorted" / "denoised"
    names = sorted(path.name for path in images.iterdir())
    assert names == sorted(path.name for path in twins.iterdir())
    same = [name for name in names if (images / name).read_bytes() == (twins / name).read_bytes()]
    assert same == [name for name in names if name != FILTERED]
    difference = read_png(images / FILTERED).astype(int) - read_png(twins / FILTERED)
    assert np.abs(difference).mean() < 20  # the same view, blurred


@pytest.mark.integration
def test_undistortion_keeps_pixels_and_has_no_blank_border(mapped):
    out, _, _ = mapped
    rgb = read_png(out / "undistorted" / "images" / "000012.png")
    edges = np.concatenate([rgb[0], rgb[-1], rgb[:, 0], rgb[:, -1]])
    assert (edges.max(axis=1) > 0).all()


@pytest.mark.integration
def test_the_folder_holds_what_others_read_and_no_leftovers(mapped):
    out, _, _ = mapped
    assert sorted(path.name for path in out.iterdir()) == [
        "database.db", "log.txt", "parts", "sparse", "steps.jsonl", "undistorted", "verdict.json",
        "world.json"]
    scale, world = (json.loads((out / name).read_text()) for name in ("verdict.json", "world.json"))
    assert world["evidence"]["scale_spread"] == max(
        scale["scale"]["error"], scale["scale"]["drift"]) > 0
    assert sorted(path.name for path in (out / "undistorted").iterdir()) == [
        "denoised", "images", "sparse"]
    for folder in (out / "sparse", out / "undistorted" / "sparse"):
        assert sorted(path.name for path in folder.iterdir()) == list(MODEL)


@pytest.mark.integration
def test_progress_is_recorded_in_order_up_to_the_last_step(mapped):
    _, _, seen = mapped
    mapping = [each for each in seen if each[1] == len(STEPS) * (COUNT + 1)]
    assert mapping == sorted(mapping)
    assert mapping[-1][0] >= 2 * (COUNT + 1)  # features and matches, which a crash leaves
    assert set(seen[len(mapping):]) == {(0, COUNT)}  # of place, which begins anew


def rows_written(path, step):
    """Returns `database.progress` of a copy: a look at the file itself may lock it for pycolmap."""
    with tempfile.TemporaryDirectory() as folder:
        for suffix in ("", "-wal"):
            with contextlib.suppress(FileNotFoundError):
                shutil.copy(path.with_name(path.name + suffix), folder)
        return database.progress(Path(folder) / path.name, step)


def rows(path, table):
    with contextlib.closing(sqlite3.connect(path)) as opened:
        return opened.execute(f"SELECT * FROM {table} ORDER BY 1").fetchall()


def kill_when(base, out, reached):
    """Runs the stage in a process of its own and kills that, and only that, when `reached()`."""
    out.mkdir(exist_ok=True)
    parent = subprocess.Popen([sys.executable, "-c", RUN, str(base), str(out), str(FEATURES)])
    while not reached():
        assert parent.poll() is None, "the run ended before it could be killed"
        time.sleep(0.005)
    children = psutil.Process(parent.pid).children(recursive=True)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    _, alive = psutil.wait_procs(children, timeout=20)
    assert not alive, "the mapping process outlived its parent"
    clear_leftovers(out)  # as a workspace does before a run resumes


def noted(out, step):
    return StepFolder(out).is_finished(step)


@pytest.mark.integration
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_run_killed_in_every_step_ends_with_the_bytes_of_one_that_was_not(
    mapped, room, tmp_path
):
    uninterrupted, _, _ = mapped
    out = tmp_path / "out"
    kill_when(room, out, lambda: rows_written(out / "database.db", "features") >= 3)
    with (out / "database.db").open("r+b") as file:  # as a crash of the machine may leave it
        file.truncate(20_000)
    kill_when(room, out, lambda: rows_written(out / "database.db", "features") >= 3)
    kill_when(room, out, lambda: rows_written(out / "database.db", "matches") >= 5)
    kill_when(room, out, lambda: noted(out, "matches"))
    run(room, out, max_features=FEATURES)
    assert not [  # a list: of blobs that differ pytest would print every byte
        table for table in ("keypoints", "descriptors", "matches", "two_view_geometries")
        if rows(out / "database.db", table) != rows(uninterrupted / "database.db", table)]
    attempts, first = (
        StepFolder(folder).result("model")["rungs"]
        for folder in (out, uninterrupted))
    for attempt in (*attempts, *first):
        del attempt["seconds"]
    assert attempts == first
    for folder in ("sparse", "undistorted"):
        files = sorted(path for path in (uninterrupted / folder).rglob("*") if path.is_file())
        assert files
        for path in files:
            other = out / path.relative_to(uninterrupted)
            assert other.read_bytes() == path.read_bytes(), path
    assert sorted(path.name for path in out.iterdir()) == sorted(
        path.name for path in uninterrupted.iterdir())


@pytest.mark.slow
def test_the_model_depends_neither_on_threads_nor_on_what_else_runs(mapped, room, tmp_path):
    other, _, _ = mapped
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        run(room, tmp_path / "out", ctx=StageContext(threads=1), max_features=FEATURES)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    for name in MODEL:
        assert (tmp_path / "out" / "sparse" / name).read_bytes() == (
            other / "sparse" / name).read_bytes(), name
    assert read_pairs(tmp_path / "out") == read_pairs(other)


def read_pairs(out):
    """Matches and their geometry in a database."""
    with contextlib.closing(sqlite3.connect(out / "database.db")) as connection:
        return [list(connection.execute(f"SELECT * FROM {table}"))
                for table in ("matches", "two_view_geometries")]


@pytest.mark.integration
def test_a_finished_run_is_not_done_again(mapped, room):
    out, summary, _ = mapped
    before = (out / "parts").stat().st_ino
    assert run(room, out, max_features=FEATURES) == summary
    assert (out / "parts").stat().st_ino == before


@pytest.mark.integration
def test_running_out_of_time_is_a_failure_that_says_where_it_was(room, tmp_path):
    out = tmp_path / "out"
    with raises(SfmError, 0.01, "minutes", "step") as caught:
        run(room, out, max_minutes=0.01)
    assert "--max-minutes" in caught.value.hint
    assert not (out / "sparse").exists()
    assert not workers()


@pytest.mark.integration
def test_a_mapping_process_that_dies_is_a_failure_that_names_its_log(room, tmp_path):
    def kill():
        while not (found := workers()) or not (tmp_path / "out" / "database.db").exists():
            time.sleep(0.01)
        found[0].kill()

    thread = threading.Thread(target=kill)
    thread.start()
    with raises(SfmError, "SIGKILL") as caught:
        run(room, tmp_path / "out")
    thread.join()
    assert str(tmp_path / "out" / "log.txt") in caught.value.message
    assert "memory" in caught.value.hint


@pytest.mark.integration
def test_an_interrupt_ends_the_mapping_process_and_goes_on(room, tmp_path):
    def interrupt(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(room, tmp_path / "out", ctx=StageContext(record=interrupt))
    assert not workers()
    assert not (tmp_path / "out" / "job.json").exists()


@pytest.mark.integration
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs signals")
def test_ctrl_c_in_every_step_ends_the_mapping_process_at_once(room, tmp_path):
    """The waiting has a bound only so that the test ends; it came to 0.5 to 0.6 seconds."""
    out = tmp_path / "out"
    out.mkdir()
    for reached in (
        lambda: rows_written(out / "database.db", "features") >= 3,
        lambda: rows_written(out / "database.db", "matches") >= 5,
        lambda: noted(out, "matches"),
    ):
        parent = subprocess.Popen(
            [sys.executable, "-c", RUN, str(room), str(out), str(FEATURES)],
            stderr=subprocess.DEVNULL)
        while not reached():
            assert parent.poll() is None, "the run ended before it could be interrupted"
            time.sleep(0.005)
        family = [parent, *psutil.Process(parent.pid).children(recursive=True)]
        parent.send_signal(signal.SIGINT)
        assert parent.wait(timeout=60) != 0
        _, alive = psutil.wait_procs(family[1:], timeout=60)
        assert not alive
