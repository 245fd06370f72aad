"""Stale stages and their reasons, and the effect of inputs that changed, moved or went."""


from dataclasses import replace
from pathlib import Path

import fake_stages
import pytest
from facts import assert_facts, raises
from fake_stages import NAMES, bring, job_at, stale

from recon_cli.errors import ConfigError, InputError, StageError
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job
from recon_cli.workspace import manifest
from recon_cli.workspace.atomic import read_json
from recon_cli.workspace.summaries import IngestSummary

AFTER = {name: NAMES[NAMES.index(name):] for name in NAMES}  # a stage and all behind it


@pytest.mark.integration
def test_a_finished_workspace_is_fresh_and_nothing_runs_twice(job: Job) -> None:
    assert stale(job) == {}
    assert bring(job, *NAMES) == []


def test_again_runs_what_is_fresh(job: Job) -> None:
    assert bring(job, "train", again=True) == ["train"]
    assert stale(job) == {}


@pytest.mark.parametrize(("section", "field", "value", "expected"), [
    ("ingest", "max_size", 100, AFTER["ingest"]),
    ("denoise", "mode", "off", ["denoise", *AFTER["place"]]),
    ("sfm", "pairs", "sequential", AFTER["sfm"]),
    ("train", "iterations", 100, AFTER["train"]),
    ("prune", "ratio", 0.25, AFTER["prune"]),
    ("evaluate", "max_size", 99, ["evaluate"]),
    ("export", "model", "base", ["export"]),
    ("export", "scale_between", ("a.png", "b.png", 2.0), ["export"]),
    ("sfm", "gravity", "off", AFTER["place"]),
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
        assert changed[expected[0]][0].startswith(f"{section}.{field} changed: ")


def only(reasons: tuple[str, ...]) -> str:
    (reason,) = reasons
    return reason


def test_the_reason_names_the_field_and_both_values(job: Job) -> None:
    changed = stale(job_at(job.workspace.root, {"train": {"iterations": 100}}))
    assert_facts(only(changed["train"]), "train.iterations", "automatic", 100)
    assert_facts(changed["export"][0], "train")


def test_an_identical_rerun_upstream_makes_nothing_stale(job: Job) -> None:
    before = job.workspace.manifest("sfm")
    assert bring(job, "sfm", changes={"sfm": {"seed": 5}}) == ["sfm"]
    after = job.workspace.manifest("sfm")
    assert before
    assert after
    assert before.key.fingerprint != after.key.fingerprint
    assert before.digest == after.digest
    assert stale(job) == {}


def test_another_result_upstream_makes_everything_behind_it_stale(job: Job) -> None:
    bring(job, "sfm", changes={"sfm": {"max_features": 500}})
    changed = stale(job)
    assert list(changed) == AFTER["place"]
    assert_facts(only(changed["place"]), "sfm's")


def test_volatile_outputs_take_no_part(job: Job) -> None:
    bring(job, "train", again=True)  # its log.jsonl holds the time
    (job.workspace.folder("sfm") / "database.db").unlink()
    assert stale(job) == {}


def test_an_output_changed_by_hand_makes_its_stage_stale(job: Job) -> None:
    (job.workspace.folder("train") / "result.txt").write_text("better")
    assert_facts(only(stale(job)["train"]), "result.txt", "hand")
    (job.workspace.folder("train") / "result.txt").unlink()
    assert_facts(only(stale(job)["train"]), "result.txt", "missing")


@pytest.fixture
def trained(job: Job) -> Job:
    """A job whose training left a scene."""
    fake_stages.actions["train"] = lambda: (
        job.workspace.partial("train") / "splats.ply").write_text("a scene")
    bring(job, "train", again=True)
    fake_stages.actions.clear()
    bring(job, "prune", "evaluate", "export")
    return job


def updated(job: Job, name: str, by: int = 1) -> Job:
    """A job of a recon whose stage `name` is some versions later."""
    return replace(job, table=[
        replace(row, version=row.version + by * (row.name == name)) for row in job.table])


def test_a_result_of_an_older_version_is_made_again_where_it_is_asked_for(job: Job) -> None:
    now = next(row.version for row in job.table if row.name == "evaluate")
    newer = updated(job, "evaluate")
    ((name, reasons),) = stale(newer).items()
    assert name == "evaluate"
    assert_facts(only(reasons), "version", now, now + 1)
    assert bring(newer, "evaluate") == ["evaluate"]
    assert stale(newer) == {}


@pytest.mark.integration
@pytest.mark.parametrize("by", [1, -1])
@pytest.mark.parametrize("name", ["ingest", "denoise", "place", "train"])
def test_a_scene_of_another_version_is_scored_and_exported_with_a_notice_but_not_trained(
    trained: Job, name: str, by: int, caplog: pytest.LogCaptureFixture
) -> None:
    job, scene = updated(trained, name, by), trained.workspace.folder("train") / "splats.ply"
    word = "older" if by > 0 else "newer"
    states = {one.name: one.state for one in plan.status(job)}
    behind = [other for other in AFTER[name][:AFTER[name].index("evaluate")]
              if (name, other) != ("denoise", "sfm")]
    assert states[name] == word
    assert {other: state for other, state in states.items() if state != "fresh"} == (
        dict.fromkeys(behind, word))
    with caplog.at_level("WARNING", "recon"):
        assert bring(job, "evaluate", "export") == []
        assert bring(job, "evaluate", "export", again=True) == ["evaluate", "export"]
    assert_facts(caplog.text, "version", "recon", "made")
    assert plan.require(job.inspect(), ("ingest", "place", "train"), "view").keys() == {
        "ingest", "place", "train"}
    for stage in ("prune", *(("train",) if name == "ingest" else ())):
        with pytest.raises(StageError) as caught:
            bring(job, stage, again=True)
        assert (str(scene) if word == "older" else "Update recon") in caught.value.hint
        assert "`recon" not in caught.value.hint
    with pytest.raises(StageError):
        plan.require(job.inspect(), ("train",), "a study", fresh=True)
    assert scene.read_text() == "a scene"
    assert {one.name: one.state for one in plan.status(job)} == states


def test_a_scene_of_an_older_version_that_was_changed_is_stale(trained: Job) -> None:
    scene = trained.workspace.folder("train") / "splats.ply"
    scene.write_text("another")
    with raises(StageError, "changed", "hand"):
        bring(updated(trained, "ingest"), "evaluate", again=True)


def test_the_hint_of_a_stale_stage_names_the_scene_that_is_there(trained: Job) -> None:
    (trained.workspace.folder("place") / "result.txt").write_text("other cameras")
    with pytest.raises(StageError) as caught:
        plan.require(trained.inspect(), ("place", "train"), "view")
    assert_facts(caught.value.hint, "recon sfm")
    assert str(trained.workspace.folder("train") / "splats.ply") in caught.value.hint


def test_a_result_whose_record_another_version_wrote_is_older(job: Job) -> None:
    typed = [replace(row, summary=IngestSummary) if row.name == "ingest" else row
             for row in job.table]
    reason, = stale(replace(job, table=typed))["ingest"]
    assert_facts(reason, "declared_frames")


def test_an_option_that_a_result_contradicts_makes_it_stale_though_it_is_not_hashed(
    job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fake_stages.FakeSummary, "contradictions", lambda _, options: (
        ("it is only a part",) if options.get("accept_weak") else ()))
    assert stale(job) == {}
    changed = stale(job_at(job.workspace.root, {"sfm": {"accept_weak": True}}))
    assert list(changed) == AFTER["sfm"]
    assert changed["sfm"] == ("it is only a part",)


def test_an_option_that_no_longer_exists_is_of_another_version(job: Job) -> None:
    record_options(job, swarm_size=0.1)
    changed = stale(job)
    assert list(changed) == ["train", "prune"]
    assert_facts(only(changed["train"]), "train.swarm_size")
    assert bring(job, "train") == ["train"]
    assert stale(job) == {}


def test_a_choice_that_no_longer_exists_is_of_another_version(job: Job) -> None:
    record_options(job, densify="swarm", iterations=100)
    assert_facts(only(stale(job)["train"]), "train.densify", "swarm")
    assert bring(job, "evaluate", "export") == []
    with pytest.raises(StageError) as caught:
        bring(job, "prune", again=True)
    assert "`recon train --iterations 100`" in caught.value.hint


def test_an_option_that_was_stored_under_its_earlier_name_makes_nothing_stale(job: Job) -> None:
    manifest = job.workspace.manifest("train")
    assert manifest
    stored = dict(manifest.key.config)
    stored["far"] = stored.pop("background")
    replace(manifest, key=replace(manifest.key, config=stored)).write(
        job.workspace.folder("train"))
    assert stale(job) == {}
    record_options(job, far="on")
    assert stale(job) == {}  # an unset option is that of the result


def record_options(job: Job, **options: object) -> None:
    """Writes options into the manifest of train, as another version of recon might have."""
    manifest = job.workspace.manifest("train")
    assert manifest
    key = replace(manifest.key, config={**manifest.key.config, **options})
    replace(manifest, key=key).write(job.workspace.folder("train"))


def test_a_changed_input_is_named(job: Job, folder: Path) -> None:
    (folder / "room.mp4").write_text("another video")
    changed = stale(job)
    assert list(changed) == NAMES
    assert_facts(only(changed["ingest"]), "room.mp4")
    with raises(StageError, "room.mp4") as e:
        bring(job, "train")
    assert_facts(e.value.hint, "recon ingest")


def test_an_input_that_is_gone_makes_nothing_stale_but_is_said(job: Job, folder: Path) -> None:
    (folder / "room.mp4").unlink()
    assert stale(job) == {}
    assert_facts(only(plan.status(job)[0].notices), folder / "room.mp4")
    assert bring(job, "train", "ingest") == []
    with pytest.raises(InputError):
        bring(job, "ingest", again=True)


def test_a_touched_or_moved_input_is_the_same_input(job: Job, folder: Path) -> None:
    (folder / "room.mp4").rename(folder / "moved.mp4")
    assert bring(job, "ingest", video=folder / "moved.mp4") == []
    assert plan.status(job)[0].notices == ()


def test_another_input_is_taken_and_named(job: Job, folder: Path) -> None:
    (folder / "other.mp4").write_text("other")
    assert bring(job, "ingest", video=folder / "other.mp4") == ["ingest"]
    assert_facts(only(stale(job)["denoise"]), "ingest's")


def test_ingest_without_an_input_takes_that_of_the_last_time(job: Job, folder: Path) -> None:
    assert bring(job, "ingest", changes={"ingest": {"max_size": 100}}) == ["ingest"]
    assert fake_stages.seen["ingest"].sources == (folder / "room.mp4",)


def test_ingest_without_any_input_is_a_usage_error(tmp_path: Path) -> None:
    with raises(ConfigError, "input") as caught:
        bring(job_at(tmp_path / "ws"), "ingest")
    assert caught.value.exit_code == 2


def test_a_result_made_with_several_values_stays_fresh(job: Job) -> None:
    """A tuple comes back from the manifest as a list."""
    between = {"export": {"scale_between": ("a.png", "1,2,3", 2)}}
    assert bring(job, "export", changes=between) == ["export"]
    assert bring(job, "export", changes=between) == []
    assert stale(job) == {}
    assert list(stale(job_at(job.workspace.root, {"export": {"model": "base"}}))) == ["export"]


def test_a_run_reads_each_manifest_once(job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[tuple[Path, int]] = []

    def count(path: Path, kind: type = object) -> object:
        if path.name.startswith("manifest"):
            reads.append((path, path.stat().st_mtime_ns))  # one that is written anew is another
        return read_json(path, kind)

    monkeypatch.setattr(manifest, "read_json", count)
    assert bring(job_at(job.workspace.root), *NAMES) == []
    assert sorted(path.parent.name for path, _ in reads) == sorted(NAMES)
    reads.clear()
    settings = {"train": {"iterations": 100}}
    assert bring(job_at(job.workspace.root, settings), "train", "prune") == ["train", "prune"]
    assert len(reads) == len(set(reads))
