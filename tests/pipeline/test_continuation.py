"""When a training continues the finished one, and how that changes its results."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
from pathlib import Path
from typing import Any

import fake_stages
import pytest
from facts import assert_facts, raises
from fake_stages import bring, seen, stale

from recon_cli.config.settings import Settings
from recon_cli.errors import StageError
from recon_cli.pipeline import plan
from recon_cli.pipeline.continuation import Start, may_resume
from recon_cli.pipeline.plan import Job, Target
from recon_cli.stages import stage
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.digests import read_source
from recon_cli.workspace.json_record import sha256_json
from recon_cli.workspace.manifest import NAME, Manifest


def longer(iterations: int, **others: Any) -> Settings:
    return {"train": {"iterations": iterations, **others}}


def manifest(job: Job) -> Manifest:
    found = job.workspace.manifest("train")
    assert found is not None
    return found


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.integration
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
    assert_facts(caplog.text, "train.sh_degree", 1)


def test_a_run_on_other_cameras_or_a_changed_result_begins_anew(job: Job) -> None:
    bring(job, "sfm", "place", changes={"sfm": {"max_features": 500}})
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
    assert plan.status(job)[4].state == "missing"
    bring(job, "train", changes=longer(6000))
    assert manifest(job).key.continues is None
    assert not (job.workspace.folder("train") / "kept.txt").exists()


def test_an_interrupted_run_does_not_go_on_from_another_result(job: Job) -> None:
    fake_stages.actions["train"] = interrupt
    with pytest.raises(KeyboardInterrupt):
        bring(job, "train", changes=longer(6000))
    fake_stages.actions.clear()
    partial = job.workspace.partial_run("train")
    assert partial is not None
    assert may_resume(job.workspace, partial)
    path = job.workspace.folder("train") / NAME
    other = dataclasses.replace(manifest(job), digest="0" * 64)
    other.write(path.parent)
    assert not may_resume(job.workspace, partial)


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
    with raises(StageError, "imported", "scene") as caught:
        plan.run(job, "train", [Target("train", config, start=Start.IMPORTED)], again=True)
    assert_facts(caught.value.hint, "recon import FILE")


def write_as_before_verbs(job: Job, finished: Manifest) -> None:
    """Writes a manifest as a version did that kept no verb."""
    folder = job.workspace.folder("train")
    finished.write(folder)
    content = json.loads((folder / NAME).read_text())
    del content["verb"], content["self"]
    (folder / NAME).write_text(json.dumps({**content, "self": sha256_json(content)}))


def test_a_result_of_before_verbs_were_kept_stays_fresh(job: Job) -> None:
    write_as_before_verbs(job, manifest(job))
    assert manifest(job).key.verb == ""
    assert stale(job) == {}


def test_a_scene_merged_by_the_verb_of_before_is_stale_and_trained_again(
    job: Job, tmp_path: Path
) -> None:
    (tmp_path / "block.ply").write_bytes(b"a block")
    finished = manifest(job)
    source = read_source(tmp_path / "block.ply", without=tmp_path / "ws")
    key = dataclasses.replace(
        finished.key, version=2, sources=(source,),
        config={"iterations": None, "max_size": None, "validation": 0.05})
    summary = {**finished.run.summary, "imported_from": "2 blocks", "blocks": 2}
    run = dataclasses.replace(finished.run, summary=summary)
    write_as_before_verbs(job, dataclasses.replace(finished, key=key, run=run))
    (reason,) = stale(job)["train"]
    assert_facts(reason, "`recon merge`")
    with pytest.raises(StageError) as caught:
        bring(job, "evaluate")
    assert_facts(caught.value.hint, "recon train")
    assert bring(job, "train") == ["train"]
    assert manifest(job).key.verb == "train"
    assert "train" not in stale(job)


def test_a_training_in_blocks_is_not_prolonged(
    job: Job, caplog: pytest.LogCaptureFixture
) -> None:
    finished = manifest(job)
    run = dataclasses.replace(finished.run, summary={**finished.run.summary, "blocks": 2})
    dataclasses.replace(finished, run=run).write(job.workspace.folder("train"))
    with caplog.at_level(logging.INFO, logger="recon"):
        bring(job, "train", changes=longer(6000))
    assert seen["train"].continues is None
    assert_facts(caplog.text, "finished", "trained", "blocks")
