"""Which stages run and which do not, and that a killed run can be resumed."""


import dataclasses
import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import fake_stages
import pytest
from facts import assert_facts, raises
from fake_stages import NAMES, STEPS, bring, job_at, stale

from recon_cli.commands.workspace import status_table
from recon_cli.config.settings import Settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.errors import (
    BackendError,
    FormatError,
    InputError,
    ManifestError,
    StageError,
    WorkspaceError,
)
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job
from recon_cli.workspace.digests import digest_file
from recon_cli.workspace.manifest import NAME


def written(job: Job, stage: str) -> str:
    return (job.workspace.folder(stage) / "result.txt").read_text()


def test_train_runs_denoise_and_sfm_first(tmp_path: Path) -> None:
    (tmp_path / "room.mp4").write_text("x")
    job = job_at(tmp_path / "ws")
    bring(job, "ingest", video=tmp_path / "room.mp4")
    assert bring(job, "train") == ["denoise", "sfm", "place", "train"]


@pytest.mark.parametrize(("verb", "gone", "command"), [
    ("train", ["ingest"], "`recon ingest VIDEO`"),
    ("evaluate", ["train"], "`recon train`"),
    ("prune", ["train", "place"], "`recon train`"),
    ("export", ["train"], "`recon train`"),
])
def test_training_is_never_implicit_and_the_command_to_type_is_named(
    job: Job, verb: str, gone: list[str], command: str
) -> None:
    for name in gone:
        shutil.rmtree(job.workspace.folder(name))
    with raises(StageError, "eval" if verb == "evaluate" else verb, gone[0]) as caught:
        bring(job, verb, again=True)
    assert command in caught.value.hint
    assert caught.value.exit_code == 4
    assert fake_stages.ran == []


def test_the_command_to_type_is_one_that_the_shell_and_the_verb_take(job: Job) -> None:
    changes = {"sfm": {"scale_between": ("my frame.png", "b.png", 1.5)}, "denoise": {"mode": "off"}}
    changes["sfm"]["max_features"] = 500
    bring(job, "denoise", "sfm", "place", changes=changes)
    look = job.inspect()
    assert plan.command(look, look.check("denoise")) == "denoise --off"
    for name in ("sfm", "place"):  # which are one verb, with the options of both
        assert plan.command(look, look.check(name)) == (
            "sfm --max-features 500 --scale-between 'my frame.png' b.png 1.5")


def test_a_stage_keeps_the_options_it_was_made_with_when_others_need_it(job: Job) -> None:
    bring(job, "train", changes={"train": {"iterations": 100}})
    assert bring(job, "evaluate") == ["evaluate"]  # although the default is 2000
    assert list(stale(job)) == ["prune", "export"]


def test_explicit_settings_win_over_what_a_stage_was_made_with(job: Job) -> None:
    bring(job, "train", changes={"train": {"iterations": 100, "seed": 3}})
    set_now = job_at(job.workspace.root, {"train": {"iterations": 200}})
    with raises(StageError, "train.iterations", 100, 200) as caught:
        bring(set_now, "evaluate")
    assert_facts(caught.value.hint, "recon train --seed 3")


def test_a_verb_does_the_same_whatever_was_typed_before(job: Job) -> None:
    bring(job, "train", changes={"train": {"iterations": 100}})
    assert bring(job, "train") == ["train"]
    manifest = job.workspace.manifest("train")
    assert manifest
    assert manifest.key.config["iterations"] is None


def test_a_stage_that_runs_implicitly_keeps_its_options(job: Job, folder: Path) -> None:
    bring(job, "sfm", changes={"sfm": {"pairs": "exhaustive"}})
    (folder / "room.mp4").write_text("another video")
    bring(job, "ingest")
    assert bring(job, "train") == ["denoise", "sfm", "place", "train"]
    manifest = job.workspace.manifest("sfm")
    assert manifest
    assert manifest.key.config["pairs"] == "exhaustive"


def test_a_missing_stage_makes_those_behind_it_stale_only_if_it_comes_out_otherwise(
    job: Job,
) -> None:
    shutil.rmtree(job.workspace.folder("place"))
    assert list(stale(job)) == ["place"]
    assert bring(job, "export") == []
    assert bring(job, "evaluate", changes={"evaluate": {"max_size": 50}}) == ["place", "evaluate"]
    shutil.rmtree(job.workspace.folder("place"))
    other: Settings = {"sfm": {"max_features": 999}}
    with raises(StageError, "train", "output"):
        bring(job_at(job.workspace.root, other), "evaluate", again=True)


def test_a_stale_optional_stage_is_left_out_with_a_notice(
    job: Job, caplog: pytest.LogCaptureFixture
) -> None:
    other: Settings = {"prune": {"ratio": 0.25}}
    assert bring(job_at(job.workspace.root, other), "evaluate") == ["evaluate"]
    assert set(fake_stages.seen["evaluate"].folders) == {"ingest", "place", "train"}
    assert_facts(caplog.text, "prune", "eval", "stale", "prune.ratio", "automatic -> 0.25")


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
    assert set(manifest.key.upstream) == {"ingest", "place"}
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
    with raises(WorkspaceError, "MB", "free"):
        bring(job, "sfm", "train", changes=changes)
    assert written(job, "train") == before
    assert "sfm" not in stale(job)


@pytest.mark.parametrize("new", [True, False])
@pytest.mark.parametrize("failure", [
    None, FormatError("a frame cannot be read"), ValueError("a library's own error")])
def test_a_workspace_that_is_renamed_in_mid_run_is_continued_at_its_new_place(
    job: Job, folder: Path, tmp_path: Path, failure: Exception | None, new: bool
) -> None:
    job, name = (job_at(tmp_path / "new"), "ingest") if new else (job, "train")
    video, moved = folder / "room.mp4", tmp_path / "moved"

    def rename() -> None:
        job.workspace.root.rename(moved)
        if failure is not None:
            raise failure

    fake_stages.actions[name] = rename
    with raises(WorkspaceError, "renamed", "deleted") as caught:
        bring(job, name, video=video if new else None, again=True)
    assert "-w" in caught.value.hint
    assert not job.workspace.root.exists()
    fake_stages.actions.clear()
    assert bring(job_at(moved), name, video=video if new else None, again=not new) == [name]
    assert not list(moved.glob(".partial/*/"))


def test_a_run_refused_at_its_start_leaves_nothing_to_resume(job: Job) -> None:
    def refuse() -> None:
        raise InputError("not this file")

    fake_stages.actions["train"] = refuse
    shutil.rmtree(job.workspace.folder("train"))
    with pytest.raises(InputError):
        bring(job, "train")
    assert plan.status(job)[4].state == "missing"
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
    one = plan.status(job)[4]
    assert (one.state, one.done, one.total) == ("partial", 0, 0)
    assert_facts(status_table([one]), "partial", "just", "begun")
    with raises(StageError, "unfinished", "begun") as caught:
        bring(job, "prune", again=True)
    assert_facts(caught.value.hint, "recon train --iterations 100")
    bring(job, "sfm", "place", changes={"sfm": {"max_features": 500}})
    assert plan.status(job)[4].state == "missing"


@pytest.mark.integration
def test_killed_and_run_again_gives_what_an_uninterrupted_run_gives(job: Job) -> None:
    expected = written(job, "train")
    shutil.rmtree(job.workspace.folder("train"))
    process = subprocess.Popen(
        [sys.executable, fake_stages.__file__, str(job.workspace.root), "train"],
        env={**os.environ, "SLOW_TRAIN": "1"})
    try:
        started = time.monotonic()
        while plan.status(job)[4].done < 2:
            assert time.monotonic() - started < 60
            time.sleep(0.05)
        with raises(WorkspaceError, process.pid, "process") as caught:
            bring(job, "train")
        assert caught.value.exit_code == 7
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    one = plan.status(job)[4]
    assert one.state == "partial"
    assert 2 <= one.done < one.total == STEPS
    unfinished = job.workspace.partial_run("train")
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


def test_another_part_makes_stale_what_comes_behind_and_the_same_one_nothing(job):
    assert stale(job) == {}
    assert bring(job, "sfm", "place", changes={"sfm": {"part": 2}}) == ["place"]
    assert list(stale(job)) == ["train", "prune", "evaluate", "export"]
    (reason,) = stale(job_at(job.workspace.root, {"sfm": {"part": 1}}))["place"]
    assert_facts(reason, "sfm.part", 2, 1)


def test_views_that_sfm_made_before_place_was_a_stage_are_fresh(job):
    root, now = job.workspace.root, job.workspace.manifest("place")
    sfm = job.workspace.manifest("sfm")
    shutil.rmtree(root / "sfm")
    (root / "place").rename(root / "sfm")
    (root / "sfm" / "undistorted").mkdir()
    shutil.copy(root / "sfm" / "result.txt", root / "sfm" / "world.json")
    outputs = {name: digest_file(root / "sfm" / name)
               for name in ("result.txt", "world.json", "table.txt")}
    old = dataclasses.replace(now, outputs=outputs, key=dataclasses.replace(
        sfm.key, config={**sfm.key.config, **now.key.config},
        upstream={name: now.key.upstream[name] for name in ("ingest", "denoise")}))
    old.write(root / "sfm")
    for name in ("train", "prune", "evaluate", "export"):
        known = job.workspace.manifest(name)
        dataclasses.replace(known, key=dataclasses.replace(known.key, upstream={
            "sfm" if need == "place" else need: digest
            for need, digest in known.key.upstream.items()})).write(root / name)
    assert job.workspace.folder("place") == root / "sfm"
    assert stale(job) == {}
    assert bring(job, *NAMES) == []
    assert list(stale(job_at(root, {"sfm": {"gravity": "off"}}))) == NAMES[NAMES.index("place"):]
    assert bring(job, "place", changes={"sfm": {"gravity": "off"}}) == ["place"]
    assert job.workspace.folder("place") == root / "place"
    assert (root / "sfm" / "undistorted").is_dir()
    assert "sfm" not in stale(job)
