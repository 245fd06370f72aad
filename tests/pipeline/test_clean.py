"""Large files that can be made again are offered, and listed before they go; exports stay."""

import dataclasses
from pathlib import Path

import pytest
from facts import raises
from fake_stages import NAMES, TABLE, bring, job_at, stale

from recon_cli.errors import StageError
from recon_cli.pipeline import clean
from recon_cli.pipeline.clean import find_states, free_space
from recon_cli.pipeline.plan import Job

STATES = ("step5.txt", "step6.txt")  # of the fake training
WITH_STATES = tuple(
    dataclasses.replace(row, states=STATES) if row.name == "train" else row for row in TABLE)


@pytest.fixture
def full(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Job:
    """Returns a job on a finished workspace whose training keeps states."""
    monkeypatch.setattr(clean, "_WORTH_BYTES", 1)
    return dataclasses.replace(job_at(folder / "ws"), table=WITH_STATES)


def names(job: Job, **options: bool) -> set[str]:
    """Returns the paths that would be removed, relative to the workspace."""
    return {item.path.relative_to(job.workspace.root).as_posix()
            for item in free_space(job, dry=True, **options)}


def test_states_are_offered_and_go_only_when_asked_for(full: Job) -> None:
    assert [path.name for path in find_states(full)] == list(STATES)
    assert not names(full) & {"train/step5.txt", "train/step6.txt"}
    assert names(full, states=True) == names(full) | {"train/step5.txt", "train/step6.txt"}
    free_space(full, states=True)
    assert find_states(full) == []
    assert not stale(full)


def test_a_state_that_was_changed_makes_stale_but_not_one_that_was_removed(full: Job) -> None:
    state = full.workspace.folder("train") / "step5.txt"
    state.write_text("another")
    assert "train" in stale(full)
    state.unlink()
    assert not stale(full)


def test_prune_without_the_states_names_the_command_that_makes_them(full: Job) -> None:
    free_space(full, states=True)
    before = bring(full, "evaluate")
    assert before == []  # nothing else needs them
    with raises(StageError, "train/step5.txt"):
        plan_prune(full)
    bring(full, "train", again=True)  # the hint, typed
    plan_prune(full)


def plan_prune(job: Job) -> None:
    """Runs prune with other options on the table of the job."""
    from recon_cli.config.stages import PruneConfig
    from recon_cli.pipeline import plan

    plan.run(job, "prune", [plan.Target("prune", PruneConfig(ratio=0.25))])


def test_a_longer_training_without_its_states_begins_anew(full: Job) -> None:
    from recon_cli.config.stages import TrainConfig
    from recon_cli.pipeline import plan

    for states in (False, True):
        free_space(full, states=states)
        outcome, = plan.run(full, "train", [
            plan.Target("train", TrainConfig(iterations=9000 + states))])
        assert (outcome.manifest.key.continues is None) is states


def test_all_but_the_exports_can_go(full: Job) -> None:
    shown: list[str] = []
    freed = free_space(
        full, keep_exports=True, show=lambda items: shown.extend(item.stage for item in items))
    assert {item.path.name for item in freed} >= set(NAMES) - {"export"}
    assert set(shown) >= set(NAMES) - {"export"}
    left = {name for name in NAMES if full.workspace.folder(name).exists()}
    assert left == {"export"}
    free_space(full, ["export"])
    assert not full.workspace.folder("export").exists()


def test_without_an_export_nothing_is_removed_for_it(full: Job) -> None:
    free_space(full, ["export"])
    with raises(StageError, "exported", "scene"):
        free_space(full, keep_exports=True)
    assert full.workspace.folder("train").exists()


def test_files_are_shown_with_their_sizes_before_they_are_removed(full: Job) -> None:
    seen: list[bool] = []
    free_space(full, ["sfm"], show=lambda items: seen.append(
        items[0].path.exists() and items[0].size > 0 and items[0].stage == "sfm"))
    assert seen == [True]
    assert not full.workspace.folder("sfm").exists()
