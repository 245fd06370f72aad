"""Outputs that a user may edit make their stage stale, and its next run is given them."""

import fake_stages
import pytest
from facts import assert_facts
from fake_stages import bring, seen, stale


@pytest.fixture
def masks(job, monkeypatch):
    """Trains once, with masks of two views; returns their folder."""
    folder = job.workspace.partial("train") / "masks"

    def write_masks():
        folder.mkdir(exist_ok=True)
        for name in ("0.png", "1.png"):
            (folder / name).write_text("found")

    monkeypatch.setitem(fake_stages.actions, "train", write_masks)
    bring(job, "train", again=True)
    bring(job, "prune", "evaluate", "export")
    assert not stale(job)
    return job.workspace.folder("train") / "masks"


@pytest.mark.integration
def test_a_changed_a_removed_and_an_added_one_are_named_and_handed_on(job, masks):
    (masks / "0.png").write_text("by hand")
    (masks / "1.png").unlink()
    (masks / "2.png").write_text("by hand")
    reasons = "\n".join(stale(job)["train"])
    for name, change in (("0", "changed"), ("1", "missing"), ("2", "added")):
        assert_facts(reasons, f"masks/{name}.png", change)
    assert bring(job, "train") == ["train"]
    earlier = seen["train"].earlier
    assert earlier is not None
    assert (earlier.changed, earlier.missing, earlier.foreign) == (
        {"masks/0.png"}, {"masks/1.png"}, {"masks/2.png"})


def test_a_longer_run_begins_anew_where_one_was_added(job, masks):
    (masks / "2.png").write_text("by hand")
    bring(job, "train", changes={"train": {"iterations": 6000}})
    assert seen["train"].continues is None
    assert seen["train"].earlier is not None
