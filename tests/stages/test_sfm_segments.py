"""Sfm in segments: real frames, killed processes, and a segment that shows nothing."""

import json
import signal
import subprocess
import sys
import threading
import time
from importlib import import_module

import numpy as np
import psutil
import pytest
from facts import assert_facts, raises
from sfm_inputs import every_nth, run, write_inputs

from recon_cli.context import StageContext
from recon_cli.errors import SfmError
from recon_cli.io.colmap import read_images
from recon_cli.workspace.steps import StepFolder

STEP, COUNT = 3, 30  # every third frame of the sample: two segments of 18, 7 of them in both
FEATURES = 2048

# A parent of its own, to be killed; its arguments: inputs, output.
RUN = f"""
import sys
from pathlib import Path
from recon_cli.config.stages import SfmConfig
from recon_cli.stages import sfm
from recon_cli.context import StageContext, StageInputs
base = Path(sys.argv[1])
sfm.run(SfmConfig(max_features={FEATURES}, segments="2"),
        StageInputs({{"ingest": base / "ingest"}}), Path(sys.argv[2]),
        StageContext(threads=2))
"""

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def room(tmp_path_factory, sample_video):
    images = every_nth(sample_video, STEP, COUNT)
    return write_inputs(tmp_path_factory.mktemp("room"), images, fps=30)


@pytest.fixture(scope="module")
def mapped(room, tmp_path_factory):
    out = tmp_path_factory.mktemp("mapped")
    return out, run(room, out, max_features=FEATURES, segments="2")


def rmse(out, shared_data):
    """Of the camera centres against the rendered path, metres."""
    lines = (shared_data / "rooms" / "office" / "traj.txt").read_text().splitlines()
    poses = read_images(out / "sparse" / "images.bin")
    found = np.array([-view[:3, :3].T @ view[:3, 3] for _, _, view in poses])
    truth = np.array([
        np.array(lines[int(name[:6])].split(), float).reshape(4, 4)[:3, 3] for name, _, _ in poses])
    a, b = found - found.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ flip) / (a**2).sum()
    return np.sqrt(((scale * a @ (u @ flip @ vt).T - b) ** 2).sum(axis=1).mean())


def test_two_segments_of_a_room_become_one_model(mapped, shared_data):
    out, summary = mapped
    assert summary.registered == COUNT
    assert summary.segments == 2
    assert summary.trusted
    assert summary.apart == ()
    assert rmse(out, shared_data) < 0.03


def test_the_record_says_what_supported_the_join(mapped):
    out, _ = mapped
    record = json.loads((out / "segments.json").read_text(encoding="utf-8"))
    assert record["groups"] == [[0, 1]]
    join, = record["joins"]
    assert join["made"]
    assert len(join["witnesses"]) >= 2
    assert not (out / "segments").exists()


def noted(folder, step):
    return StepFolder(folder).is_finished(step)


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_killed_segment_is_mapped_again_and_a_killed_run_goes_on(mapped, room, tmp_path):
    """The rest is mapped on one thread, one segment at a time, to the same bytes."""
    out = tmp_path / "out"
    out.mkdir()
    parent = subprocess.Popen([sys.executable, "-c", RUN, str(room), str(out)])
    worker = None
    while worker is None:
        assert parent.poll() is None
        worker = next((child for child in psutil.Process(parent.pid).children(recursive=True)
                       if "/segments/1/job.json" in " ".join(child.cmdline())), None)
        time.sleep(0.05)
    worker.kill()
    while not (noted(out / "segments" / "0", "model") and noted(out / "segments" / "1", "model")):
        assert parent.poll() is None, "the run ended with its killed segment"
        time.sleep(0.02)
    kept = (out / "segments" / "0" / "parts" / "1" / "images.bin").stat().st_mtime_ns
    children = psutil.Process(parent.pid).children(recursive=True)
    parent.kill()
    parent.wait()
    psutil.wait_procs(children, timeout=20)
    assert (out / "segments" / "0" / "parts" / "1" / "images.bin").stat().st_mtime_ns == kept
    summary = run(room, out, ctx=StageContext(threads=1), max_features=FEATURES, segments="2",
                  jobs=1)
    assert summary.registered == COUNT
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (out / "sparse" / name).read_bytes() == (
            mapped[0] / "sparse" / name).read_bytes(), name


def test_a_segment_that_shows_nothing_is_told_and_the_others_are_kept(
    sample_video, tmp_path, caplog
):
    images = every_nth(sample_video, 2, 50)
    names = sorted(images)
    for name in names[28:]:  # the last of three segments, and the end of the one before
        images[name] = np.full_like(images[name], 128)
    base = write_inputs(tmp_path, images, fps=30)
    summary = run(base, tmp_path / "out", max_features=FEATURES, segments="3")
    assert_facts(caplog.text, 2, names[28], names[49], "Segment", "features")
    assert 26 <= summary.registered <= 28
    assert set(names[28:]) <= set(summary.unregistered)


def test_photos_are_cut_by_what_they_show(sample_video, tmp_path, shared_data):
    images = every_nth(sample_video, STEP, COUNT)
    base = write_inputs(tmp_path, images)  # without times they are no video
    summary = run(base, tmp_path / "out", max_features=FEATURES, segments="2")
    assert summary.segments == 2
    assert summary.registered == COUNT
    assert rmse(tmp_path / "out", shared_data) < 0.03


@pytest.fixture
def cluster(monkeypatch):
    pytest.importorskip("ray")
    yield from import_module("ray_clusters").cluster_for(monkeypatch)


@pytest.mark.slow
def test_segments_on_a_cluster_give_the_same_bytes_though_a_node_is_lost(
    mapped, room, cluster, tmp_path
):
    clusters = import_module("ray_clusters")
    nodes = [cluster.add_node(num_cpus=1, object_store_memory=clusters.STORE_BYTES)
             for _ in range(2)]
    cluster.wait_for_nodes()
    out, lost = tmp_path / "out", []
    out.mkdir()

    def kill() -> None:
        while not (found := [each for each in psutil.process_iter(["cmdline"])
                             if f"{out}/segments/1/job.json" in (each.info["cmdline"] or [])]):
            time.sleep(0.02)
        lost.append(clusters.node_of(found[0], nodes))
        cluster.remove_node(lost[0], allow_graceful=False)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    summary = run(room, out, max_features=FEATURES, segments="2", on="ray")
    assert lost
    assert summary.registered == COUNT
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (out / "sparse" / name).read_bytes() == (
            mapped[0] / "sparse" / name).read_bytes(), name


def test_a_capture_without_segments_is_told_to_stay_on_this_machine(room, tmp_path, caplog):
    with caplog.at_level("INFO"), raises(SfmError, "minutes"):
        run(room, tmp_path / "out", on="ray", max_minutes=0.01)
    assert_facts(caplog.text, "machine", "--segments")
