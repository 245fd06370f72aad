"""When a training goes on from the finished one, and what that means for its results."""

from __future__ import annotations

import logging
import shutil
from typing import Any

import fake_stages
import pytest
from fake_stages import bring, seen, stale

from recon_cli.config.settings import Settings
from recon_cli.errors import StageError
from recon_cli.pipeline import plan
from recon_cli.pipeline.continuation import Start
from recon_cli.pipeline.plan import Job, Target
from recon_cli.stages import stage
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.manifest import Manifest


def longer(iterations: int, **others: Any) -> Settings:
    return {"train": {"iterations": iterations, **others}}


def manifest(job: Job) -> Manifest:
    found = job.workspace.manifest("train")
    assert found is not None
    return found


def interrupt() -> None:
    raise KeyboardInterrupt


def test_more_steps_go_on_from_the_finished_run_and_are_recorded(job: Job) -> None:
    before = manifest(job)
    assert bring(job, "train", changes=longer(6000)) == ["train"]
    assert seen["train"].continues == job.workspace.folder("train")
    assert manifest(job).key.continues == before.digest
    assert bring(job, "train", changes=longer(6000)) == []
    assert set(stale(job)) == {"prune", "evaluate", "export"}


def test_the_start_is_part_of_the_fingerprint(job: Job) -> None:
    bring(job, "train", changes=longer(6000))
    further = manifest(job)
    bring(job, "train", changes=longer(6000), again=True)
    anew = manifest(job)
    assert (anew.key.continues, anew.key.config) == (None, further.key.config)
    assert anew.key.fingerprint != further.key.fingerprint
    assert anew.digest != further.digest


def test_a_run_goes_on_again_and_after_a_length_in_minutes(job: Job) -> None:
    bring(job, "train", changes={"train": {"minutes": 2.0}})
    assert manifest(job).key.continues is None
    for iterations in (6000, 9000):
        before = manifest(job)
        bring(job, "train", changes=longer(iterations))
        assert manifest(job).key.continues == before.digest


@pytest.mark.parametrize("changes", [
    longer(3000, seed=1), longer(2000), longer(6000, sh_degree=1), longer(6000, seed=1),
    {"train": {"minutes": 9.0}}, {"train": {"quality": "high"}}])
def test_any_other_change_begins_anew(job: Job, changes: Settings) -> None:
    bring(job, "train", changes=changes)
    assert (seen["train"].continues, manifest(job).key.continues) == (None, None)


def test_why_a_longer_run_begins_anew_is_told(job: Job, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="recon"):
        bring(job, "train", changes=longer(6000, sh_degree=1))
    assert "train begins anew: train.sh_degree changed: automatic -> 1" in caplog.text


def test_a_run_on_other_cameras_or_a_changed_result_begins_anew(job: Job) -> None:
    bring(job, "sfm", changes={"sfm": {"max_features": 500}})
    bring(job, "train", changes=longer(6000))
    assert seen["train"].continues is None
    (job.workspace.folder("train") / "result.txt").write_text("other bytes, of another size")
    bring(job, "train", changes=longer(9000))
    assert seen["train"].continues is None


def test_while_a_run_goes_on_the_finished_result_stays_and_is_used(job: Job) -> None:
    before = manifest(job)
    fake_stages.actions["train"] = interrupt
    with pytest.raises(KeyboardInterrupt):
        bring(job, "train", changes=longer(6000))
    assert stale(job) == {}
    assert bring(job, "evaluate", again=True) == ["evaluate"]
    fake_stages.actions.clear()
    partial = job.workspace.partial_run("train")
    assert partial is not None
    assert partial.key.continues == before.digest
    write_bytes(job.workspace.partial("train") / "kept.txt", b"of the interrupted run")
    bring(job, "train", changes=longer(6000))
    assert manifest(job).key.continues == before.digest
    assert (job.workspace.folder("train") / "kept.txt").exists()


def test_an_interrupted_run_whose_start_is_gone_begins_anew(job: Job) -> None:
    fake_stages.actions["train"] = interrupt
    with pytest.raises(KeyboardInterrupt):
        bring(job, "train", changes=longer(6000))
    fake_stages.actions.clear()
    write_bytes(job.workspace.partial("train") / "kept.txt", b"of the interrupted run")
    shutil.rmtree(job.workspace.folder("train"))
    assert plan.status(job)[3].state == "missing"
    bring(job, "train", changes=longer(6000))
    assert manifest(job).key.continues is None
    assert not (job.workspace.folder("train") / "kept.txt").exists()


def test_an_interrupted_run_that_began_anew_is_resumed_as_such(job: Job) -> None:
    fake_stages.actions["train"] = interrupt
    with pytest.raises(KeyboardInterrupt):
        bring(job, "train", changes=longer(6000), again=True)
    fake_stages.actions.clear()
    write_bytes(job.workspace.partial("train") / "kept.txt", b"of the interrupted run")
    bring(job, "train", changes=longer(6000))
    assert manifest(job).key.continues is None
    assert (job.workspace.folder("train") / "kept.txt").exists()


def test_without_an_imported_scene_there_is_none_to_start_from(job: Job) -> None:
    config = stage("train").config()
    with pytest.raises(StageError, match="no imported scene") as caught:
        plan.run(job, "train", [Target("train", config, start=Start.IMPORTED)], again=True)
    assert caught.value.hint == "Run `recon import FILE` first."
