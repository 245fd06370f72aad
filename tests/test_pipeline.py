"""What runs and what does not, why a result is stale, and that a killed run can be resumed."""

import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import fake_stages
import pytest
from fake_stages import NAMES, STEPS, bring, job_at, stale

from recon_cli import pipeline
from recon_cli.config import ComputeConfig
from recon_cli.errors import (
    BackendError,
    ConfigError,
    InputError,
    ManifestError,
    StageError,
    WorkspaceError,
)
from recon_cli.manifest import NAME
from recon_cli.pipeline import Job
from recon_cli.settings import Settings

AFTER = {name: NAMES[NAMES.index(name):] for name in NAMES}  # a stage and all behind it


@pytest.fixture(autouse=True)
def _no_actions() -> None:
    fake_stages.actions.clear()
    fake_stages.ran.clear()


@pytest.fixture(scope="module")
def _finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished")
    (folder / "room.mp4").write_text("a video")
    bring(job_at(folder / "ws"), *NAMES, video=folder / "room.mp4")
    return folder


@pytest.fixture
def folder(_finished: Path, tmp_path: Path) -> Path:
    """A folder that holds room.mp4 and a workspace ws in which every stage is fresh."""
    shutil.copytree(_finished, tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def job(folder: Path) -> Job:
    """A job whose stages are all fresh; its input is the video in `folder`."""
    job = job_at(folder / "ws")
    bring(job, "ingest", video=folder / "room.mp4")
    fake_stages.ran.clear()
    return job


def written(job: Job, stage: str) -> str:
    return (job.workspace.folder(stage) / "result.txt").read_text()


def test_a_finished_workspace_is_fresh_and_nothing_runs_twice(job: Job) -> None:
    assert stale(job) == {}
    assert bring(job, *NAMES) == []


def test_again_runs_what_is_fresh(job: Job) -> None:
    assert bring(job, "train", again=True) == ["train"]
    assert stale(job) == {}


@pytest.mark.parametrize(("section", "field", "value", "expected"), [
    ("ingest", "max_size", 100, AFTER["ingest"]),
    ("denoise", "mode", "off", AFTER["denoise"]),
    ("sfm", "pairs", "sequential", AFTER["sfm"]),
    ("train", "iterations", 100, AFTER["train"]),
    ("prune", "ratio", 0.25, AFTER["prune"]),
    ("evaluate", "max_size", 99, ["evaluate"]),
    ("export", "model", "base", ["export"]),
    ("sfm", "max_minutes", 1.0, []),
    ("train", "checkpoint_every", 7, []),
    ("compute", "threads", 1, []),
])
def test_a_changed_field_makes_exactly_its_stage_and_those_behind_it_stale(
    job: Job, section: str, field: str, value: object, expected: list[str]
) -> None:
    changed = stale(job_at(job.workspace.root, {section: {field: value}}))
    assert list(changed) == expected
    if expected:
        assert changed[section][0].startswith(f"{section}.{field} changed: ")


def test_the_reason_names_the_field_and_both_values(job: Job) -> None:
    changed = stale(job_at(job.workspace.root, {"train": {"iterations": 100}}))
    assert changed["train"] == ("train.iterations changed: 2000 -> 100",)
    assert changed["export"][0] == "train is stale"


def test_an_identical_rerun_upstream_makes_nothing_stale(job: Job) -> None:
    before = job.workspace.manifest("sfm")
    assert bring(job, "sfm", changes={"sfm": {"seed": 5}}) == ["sfm"]
    after = job.workspace.manifest("sfm")
    assert before
    assert after
    assert before.basis.fingerprint != after.basis.fingerprint
    assert before.digest == after.digest
    assert stale(job) == {}


def test_another_result_upstream_makes_everything_behind_it_stale(job: Job) -> None:
    bring(job, "sfm", changes={"sfm": {"max_features": 500}})
    changed = stale(job)
    assert list(changed) == AFTER["train"]
    assert changed["train"] == ("sfm's output changed",)


def test_volatile_outputs_take_no_part(job: Job) -> None:
    bring(job, "train", again=True)  # its log.jsonl holds the time
    (job.workspace.folder("sfm") / "database.db").unlink()
    assert stale(job) == {}


def test_an_output_changed_by_hand_makes_its_stage_stale(job: Job) -> None:
    (job.workspace.folder("train") / "result.txt").write_text("better")
    assert stale(job)["train"] == ("output result.txt was changed by hand",)
    (job.workspace.folder("train") / "result.txt").unlink()
    assert stale(job)["train"] == ("output result.txt is missing",)


def test_a_newer_version_of_a_stage_makes_its_results_stale(job: Job) -> None:
    newer = [replace(row, version=row.version + (row.name == "evaluate")) for row in job.table]
    assert stale(replace(job, table=newer)) == {"evaluate": ("stage version 1 -> 2",)}


def test_a_changed_input_is_named(job: Job, folder: Path) -> None:
    (folder / "room.mp4").write_text("another video")
    changed = stale(job)
    assert list(changed) == NAMES
    assert changed["ingest"] == ("the input room.mp4 changed",)
    with pytest.raises(StageError, match=r"train needs ingest.*the input room.mp4 changed") as e:
        bring(job, "train")
    assert e.value.hint == "Run `recon ingest` first."


def test_an_input_that_is_gone_makes_nothing_stale_but_is_said(job: Job, folder: Path) -> None:
    (folder / "room.mp4").unlink()
    assert stale(job) == {}
    assert pipeline.status(job)[0].notices == (f"the input {folder / 'room.mp4'} is gone",)
    assert bring(job, "train", "ingest") == []
    with pytest.raises(InputError):
        bring(job, "ingest", again=True)


def test_a_touched_or_moved_input_is_the_same_input(job: Job, folder: Path) -> None:
    (folder / "room.mp4").rename(folder / "moved.mp4")
    assert bring(job, "ingest", video=folder / "moved.mp4") == []
    assert pipeline.status(job)[0].notices == ()


def test_another_input_is_taken_and_named(job: Job, folder: Path) -> None:
    (folder / "other.mp4").write_text("other")
    assert bring(job, "ingest", video=folder / "other.mp4") == ["ingest"]
    assert stale(job)["denoise"] == ("ingest's output changed",)


def test_ingest_without_an_input_takes_that_of_the_last_time(job: Job, folder: Path) -> None:
    assert bring(job, "ingest", changes={"ingest": {"max_size": 100}}) == ["ingest"]
    assert fake_stages.seen["ingest"].sources == (folder / "room.mp4",)


def test_ingest_without_any_input_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="needs an input") as caught:
        bring(job_at(tmp_path / "ws"), "ingest")
    assert caught.value.exit_code == 2


def test_train_runs_denoise_and_sfm_first(tmp_path: Path) -> None:
    (tmp_path / "room.mp4").write_text("x")
    job = job_at(tmp_path / "ws")
    bring(job, "ingest", video=tmp_path / "room.mp4")
    assert bring(job, "train") == ["denoise", "sfm", "train"]


@pytest.mark.parametrize(("verb", "gone", "message", "hint"), [
    ("train", ["ingest"], "train needs ingest, which is missing", "`recon ingest VIDEO`"),
    ("evaluate", ["train"], "eval needs train, which is missing", "`recon train`"),
    ("prune", ["train", "sfm"], "prune needs train, which is missing", "`recon train`"),
    ("export", ["train"], "export needs train, which is missing", "`recon train`"),
])
def test_training_is_never_implicit_and_the_command_to_type_is_named(
    job: Job, verb: str, gone: list[str], message: str, hint: str
) -> None:
    for name in gone:
        shutil.rmtree(job.workspace.folder(name))
    with pytest.raises(StageError, match=message) as caught:
        bring(job, verb, again=True)
    assert hint in caught.value.hint
    assert caught.value.exit_code == 4
    assert fake_stages.ran == []


def test_a_stage_keeps_the_options_it_was_made_with_when_others_need_it(job: Job) -> None:
    bring(job, "train", changes={"train": {"iterations": 100}})
    assert bring(job, "evaluate") == ["evaluate"]  # although the default is 2000
    assert list(stale(job)) == ["prune", "export"]


def test_explicit_settings_win_over_what_a_stage_was_made_with(job: Job) -> None:
    bring(job, "train", changes={"train": {"iterations": 100, "seed": 3}})
    set_now = job_at(job.workspace.root, {"train": {"iterations": 200}})
    with pytest.raises(StageError, match=r"train\.iterations changed: 100 -> 200") as caught:
        bring(set_now, "evaluate")
    assert caught.value.hint == "Run `recon train --seed 3` first."


def test_a_verb_does_the_same_whatever_was_typed_before(job: Job) -> None:
    bring(job, "train", changes={"train": {"iterations": 100}})
    assert bring(job, "train") == ["train"]
    manifest = job.workspace.manifest("train")
    assert manifest
    assert manifest.basis.config["iterations"] == 2000


def test_a_stage_that_runs_implicitly_keeps_its_options(job: Job, folder: Path) -> None:
    bring(job, "sfm", changes={"sfm": {"pairs": "exhaustive"}})
    (folder / "room.mp4").write_text("another video")
    bring(job, "ingest")
    assert bring(job, "train") == ["denoise", "sfm", "train"]
    manifest = job.workspace.manifest("sfm")
    assert manifest
    assert manifest.basis.config["pairs"] == "exhaustive"


def test_a_missing_stage_makes_those_behind_it_stale_only_if_it_comes_out_otherwise(
    job: Job,
) -> None:
    shutil.rmtree(job.workspace.folder("sfm"))
    assert list(stale(job)) == ["sfm"]
    assert bring(job, "export") == []
    assert bring(job, "evaluate", changes={"evaluate": {"max_size": 50}}) == ["sfm", "evaluate"]
    shutil.rmtree(job.workspace.folder("sfm"))
    other: Settings = {"sfm": {"max_features": 999}}
    with pytest.raises(StageError, match="eval needs train, which is stale: sfm's output changed"):
        bring(job_at(job.workspace.root, other), "evaluate", again=True)


def test_a_stale_optional_stage_is_left_out_with_a_notice(
    job: Job, caplog: pytest.LogCaptureFixture
) -> None:
    other: Settings = {"prune": {"ratio": 0.25}}
    assert bring(job_at(job.workspace.root, other), "evaluate") == ["evaluate"]
    assert set(fake_stages.seen["evaluate"].folders) == {"ingest", "sfm", "train"}
    assert ("prune is left out of eval: it is stale: prune.ratio changed: 0.5 -> 0.25"
            in caplog.text)


def test_a_missing_optional_stage_is_left_out_in_silence(
    job: Job, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.rmtree(job.workspace.folder("prune"))
    assert bring(job, "export") == ["export"]
    assert "left out" not in caplog.text


def test_a_manifest_says_how_the_result_came_about(job: Job) -> None:
    manifest = job.workspace.manifest("train")
    assert manifest
    assert manifest.run.summary["steps"] == STEPS
    assert manifest.run.peak_memory_bytes > 1e6
    assert (manifest.run.device, manifest.run.backend) != (None, None)
    assert "numpy" in manifest.run.versions
    assert set(manifest.basis.upstream) == {"ingest", "sfm"}
    other = job.workspace.manifest("sfm")
    assert other
    assert (other.run.device, other.run.backend) == (None, None)


def test_a_backend_that_is_not_here_fails_before_any_work(
    job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    asked = Job(job.workspace, {}, ComputeConfig(device="cuda"), table=job.table)
    with pytest.raises(BackendError):
        bring(asked, "sfm", "train", again=True)
    assert fake_stages.ran == []


def test_a_failure_keeps_the_old_result_and_everything_finished_before(job: Job) -> None:
    before = written(job, "train")

    def fail() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    fake_stages.actions["train"] = fail
    changes: Settings = {"sfm": {"max_features": 500}, "train": {"iterations": 9}}
    with pytest.raises(WorkspaceError, match="MB free"):
        bring(job, "sfm", "train", changes=changes)
    assert written(job, "train") == before
    assert "sfm" not in stale(job)


def test_a_run_refused_at_its_start_leaves_nothing_to_resume(job: Job) -> None:
    def refuse() -> None:
        raise InputError("not this file")

    fake_stages.actions["train"] = refuse
    shutil.rmtree(job.workspace.folder("train"))
    with pytest.raises(InputError):
        bring(job, "train")
    assert pipeline.status(job)[3].state == "missing"
    assert job.workspace.scraps() == []


def test_a_broken_manifest_is_refused_and_again_replaces_it(job: Job) -> None:
    (job.workspace.folder("train") / NAME).write_text("{")
    with pytest.raises(ManifestError):
        bring(job, "train")
    assert bring(job, "train", again=True) == ["train"]
    assert stale(job) == {}


def test_an_interrupted_run_is_partial_until_what_it_reads_changes(job: Job) -> None:
    def interrupt() -> None:
        raise KeyboardInterrupt

    fake_stages.actions["train"] = interrupt
    with pytest.raises(KeyboardInterrupt):
        bring(job, "train", changes={"train": {"iterations": 100}})
    assert stale(job) == {}  # the old result is as good as before
    shutil.rmtree(job.workspace.folder("train"))
    one = pipeline.status(job)[3]
    assert (one.state, one.done, one.total) == ("partial", 0, 0)
    with pytest.raises(StageError, match="unfinished") as caught:
        bring(job, "prune", again=True)
    assert caught.value.hint == "Run `recon train --iterations 100` first."
    bring(job, "sfm", changes={"sfm": {"max_features": 500}})
    assert pipeline.status(job)[3].state == "missing"


def test_killed_and_run_again_gives_what_an_uninterrupted_run_gives(job: Job) -> None:
    expected = written(job, "train")
    shutil.rmtree(job.workspace.folder("train"))
    process = subprocess.Popen(
        [sys.executable, fake_stages.__file__, str(job.workspace.root), "train"],
        env={**os.environ, "SLOW_TRAIN": "0.3"})
    try:
        started = time.monotonic()
        while pipeline.status(job)[3].done < 2:
            assert time.monotonic() - started < 60
            time.sleep(0.05)
        with pytest.raises(WorkspaceError, match=f"process {process.pid}") as caught:
            bring(job, "train")
        assert caught.value.exit_code == 7
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    one = pipeline.status(job)[3]
    assert one.state == "partial"
    assert 2 <= one.done < one.total == STEPS
    unfinished = job.workspace.unfinished("train")
    assert unfinished
    assert unfinished.seconds >= 0.3  # at least one slow step
    kept = job.workspace.partial("train") / "step1.txt"
    before = kept.stat().st_mtime_ns
    assert bring(job, "train") == ["train"]
    assert written(job, "train") == expected
    assert (job.workspace.folder("train") / "step1.txt").stat().st_mtime_ns == before
    manifest = job.workspace.manifest("train")
    assert manifest
    assert manifest.run.seconds > unfinished.seconds
    assert stale(job) == {}
