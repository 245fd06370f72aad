"""Damage of one result or of unfinished work: what else is there is listed, cleaned and kept."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import fake_stages
import pytest
from facts import assert_facts, raises
from fake_stages import NAMES, bring, job_at

from recon_cli.errors import ManifestError
from recon_cli.pipeline import clean, plan
from recon_cli.pipeline.clean import free_space
from recon_cli.pipeline.plan import Job
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.json_record import sha256_json

DAMAGES: dict[str, Callable[[Path], object]] = {
    "flipped": lambda path: path.write_bytes(bytes([path.read_bytes()[0] ^ 1])
                                             + path.read_bytes()[1:]),
    "cut": lambda path: os.truncate(path, path.stat().st_size // 2),
    "emptied": lambda path: os.truncate(path, 0),
    "deleted": Path.unlink,
    "a folder": lambda path: (path.unlink(), (path / "folder").mkdir(parents=True)),
    "a pipe": lambda path: (path.unlink(), os.mkfifo(path)),
    "a link to itself": lambda path: (path.unlink(), path.symlink_to(path.name))}


def stop_in_mid_step(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets a fake stage be interrupted before its fourth step."""
    write, written = fake_stages.write_bytes, []

    def write_three(path: Path, data: bytes) -> None:
        if path.parent.name == name and len(written) == 3:
            raise KeyboardInterrupt
        written.append(path)
        write(path, data)

    monkeypatch.setattr(fake_stages, "write_bytes", write_three)


@pytest.mark.integration
@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", NAMES)
def test_every_file_of_every_stage_that_was_damaged_is_made_anew(
    folder: Path, name: str, damage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = job_at(folder / "ws")
    expected = {path.name: path.read_bytes()
                for path in job.workspace.folder(name).glob("step*.txt")}
    job.workspace.remove(name)
    with monkeypatch.context() as patch:
        stop_in_mid_step(name, patch)
        with pytest.raises(KeyboardInterrupt):
            bring(job, name, video=folder / "room.mp4")
    left = job.workspace.root / ".partial"
    files = [path for path in sorted(left.rglob("*")) if path.is_file()]
    assert len(files) == 5  # three steps, the record, the digests
    for file in files:
        before = {path: path.read_bytes() for path in files}
        DAMAGES[damage](file)
        bring(job, name, video=folder / "room.mp4")
        assert expected == {path.name: path.read_bytes()
                            for path in job.workspace.folder(name).glob("step*.txt")}
        job.workspace.remove(name)
        (left / name).mkdir(parents=True)
        for path, data in before.items():
            path.write_bytes(data)


def test_again_discards_unfinished_work(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    job = job_at(folder / "ws")
    with monkeypatch.context() as patch:
        stop_in_mid_step("train", patch)
        with pytest.raises(KeyboardInterrupt):
            bring(job, "train", again=True)
    assert job.workspace.partial_run("train")
    caplog.clear()
    bring(job, "train", again=True)
    assert "resuming" not in caplog.text


def test_one_damaged_manifest_stops_neither_status_nor_clean_for_the_others(
    job: Job, caplog: pytest.LogCaptureFixture
) -> None:
    (job.workspace.folder("train") / "manifest.json").write_text('{"seconds": NaN}')
    states = {stage.name: stage.state for stage in plan.status(job)}
    assert states == {"ingest": "fresh", "denoise": "fresh", "sfm": "fresh", "place": "fresh",
                      "train": "damaged",
                      "prune": "stale", "evaluate": "stale", "export": "stale"}
    (job.workspace.root / ".old").mkdir(exist_ok=True)
    (job.workspace.root / ".partial").mkdir(exist_ok=True)
    (job.workspace.root / ".partial" / "junk").write_text("x")
    assert [item.path.name for item in free_space(job)] == ["junk"]
    assert_facts(caplog.text, "train", "left")
    with raises(ManifestError, "NaN") as caught:
        bring(job, "prune")
    assert f"recon clean train -w {job.workspace.root}" in caught.value.hint
    free_space(job, ["train"])  # the hint, typed
    bring(job, "train", "prune")
    assert {stage.state for stage in plan.status(job) if stage.name in ("train", "prune")} == {
        "fresh"}


def test_clean_removes_a_large_file_but_not_one_behind_a_link(
    job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clean, "_WORTH_BYTES", 1)
    sfm = job.workspace.folder("sfm")
    assert sfm / "database.db" in [item.path for item in free_space(job, dry=True)]
    sfm.rename(tmp_path / "large")
    sfm.symlink_to(tmp_path / "large")
    free_space(job)
    assert (tmp_path / "large" / "database.db").exists()
    item, = free_space(job, ["sfm"])
    assert item.is_link
    assert item.size < 1000
    assert (tmp_path / "large" / "manifest.json").exists()
    assert not sfm.is_symlink()


def test_clean_deletes_nothing_that_a_signed_manifest_names_elsewhere(
    job: Job, tmp_path: Path
) -> None:
    victim = tmp_path / "thesis.db"
    victim.write_text("years of work")
    path = job.workspace.folder("sfm") / "manifest.json"
    value = json.loads(path.read_text())
    value.pop("self")
    name = os.path.relpath(victim, path.parent)
    value["outputs"][f"model/../{name}"] = {"sha256": "0", "size": 5 << 20, "mtime_ns": 1}
    path.write_text(json.dumps({**value, "self": sha256_json(value)}))
    free_space(job)
    assert victim.read_text() == "years of work"


def test_jobs_of_a_stage_keep_digests_of_their_own_and_stay(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = job_at(folder / "ws")
    job.workspace.remove("train")
    with monkeypatch.context() as patch:
        stop_in_mid_step("train", patch)
        with pytest.raises(KeyboardInterrupt):
            bring(job, "train")
    shared = job.workspace.partial("train") / "jobs" / "0"
    shared.mkdir(parents=True)
    log = job.workspace.root / ".partial" / "train.steps"
    before = log.read_bytes()
    write_bytes(shared / "result.txt", b"of a job")
    (shared / "log.txt").write_text("written as any program does")
    assert log.read_bytes() == before
    (job.workspace.partial("train") / "strange.txt").write_text("of nobody")
    bring(job, "train")
    kept = job.workspace.folder("train")
    assert {path.name for path in (kept / "jobs" / "0").iterdir()} == {"result.txt", "log.txt"}
    assert not (kept / "strange.txt").exists()
