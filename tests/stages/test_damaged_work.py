"""Unfinished work that was damaged: the next run ends with the bytes of an undisturbed one.

Each stage that renders, or reads the capture, is killed while it works, each file of what it left
is damaged in turn, and the stage is run again by the pipeline's own means.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import killed
import numpy as np
import pytest
import tiny_stages
from facts import assert_facts

from recon_cli.config.export import ExportConfig
from recon_cli.config.stages import DenoiseConfig, EvaluateConfig, IngestConfig, PruneConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.stages import denoise, evaluate, export, ingest, prune, train
from recon_cli.workspace import steps
from recon_cli.workspace.atomic import delete, write_bytes
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.manifest import PartialRun, ResultKey


class Killed(BaseException):
    """Stands for the end of the process."""


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


DAMAGES: Mapping[str, Callable[[Path], object]] = {
    "flipped": flip,
    "cut": lambda path: os.truncate(path, path.stat().st_size // 2),
    "emptied": lambda path: os.truncate(path, 0),
    "deleted": Path.unlink,
    "replaced by a link": lambda path: (path.unlink(), path.symlink_to("/dev/null"))}


@dataclass(frozen=True)
class Work:
    """A stage that is run below a workspace as the pipeline runs it."""

    name: str
    stage: Any
    config: Any
    inputs: StageInputs

    def run(self, root: Path) -> Path:
        """Runs or resumes the stage, and returns the folder that it wrote."""
        workspace, key = Workspace(root), ResultKey(self.name, 1, {}, (), {})
        with workspace.writing(self.name):
            out, earlier = workspace.begin(key)

            def record(done: int, total: int) -> None:
                workspace.record(replace(earlier, done=done, total=total))

            self.stage.run(self.config, self.inputs, out, StageContext(threads=2, record=record))
        return out


def contents(out: Path) -> dict[str, bytes]:
    """The bytes of all files but logs and plans, which hold times, and scores with such."""
    return {
        path.relative_to(out).as_posix(): path.read_bytes() for path in sorted(out.rglob("*"))
        if path.is_file() and path.name not in TIMES and not path.name.startswith("metrics.")}


TIMES = ("log.jsonl", "plan.json", "table.txt", "export.json")


def lines(out: Path) -> int:
    """How many rows the log of a training has; 0 without one."""
    log = out / "log.jsonl"
    return len(log.read_text().splitlines()) if log.exists() else 0


def check_every_damage(
    work: Work, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    kill: Callable[[pytest.MonkeyPatch], None],
) -> None:
    """Damages each file of what a killed run left, in each way, and runs the stage again."""
    undisturbed = work.run(tmp_path / "undisturbed")
    expected, rows = contents(undisturbed), lines(undisturbed)
    with monkeypatch.context() as patch:
        kill(patch)
        with pytest.raises((Killed, killed.Killed)):
            work.run(tmp_path / "killed")
    left = tmp_path / "killed" / ".partial"
    files = [path.relative_to(left) for path in sorted(left.rglob("*")) if path.is_file()]
    assert len(files) > 2, files
    for file in files:
        for name, damage in DAMAGES.items():
            root = tmp_path / "damaged"
            shutil.rmtree(root, ignore_errors=True)
            shutil.copytree(tmp_path / "killed", root)
            damage(root / ".partial" / file)
            out = work.run(root)
            assert contents(out) == expected, f"{file} {name}"
            assert lines(out) == rows, f"{file} {name}"


def kill_at_file(count: int) -> Callable[[pytest.MonkeyPatch], None]:
    """Returns what makes a run die once it has put so many files in place."""
    def kill(patch: pytest.MonkeyPatch) -> None:
        confirm, done = steps.confirm, []

        def confirm_then_die(path: Path) -> None:
            confirm(path)
            done.append(path)
            # the record is written twice a second by the pipeline, and always here
            if sum(".partial" in each.parts and each.parent.name != ".partial"
                   for each in done) == count:
                raise Killed

        patch.setattr(steps, "confirm", confirm_then_die)
    return kill


SHORT = replace(tiny_stages.CONFIG, iterations=12, max_gaussians=60, checkpoint_every=4)


@pytest.fixture(scope="session")
def short(build_once: Callable[[str, Callable[[Path], object]], Path]) -> StageInputs:
    """ingest, sfm, and a finished train of a few steps."""
    folder = build_once("tiny-short", lambda to: tiny_stages.trained(to, SHORT))
    return StageInputs({name: folder / name for name in ("ingest", "place", "train")})


@pytest.mark.integration
def test_a_training_goes_on_from_no_damaged_file(
    short: StageInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Work("train", train, SHORT, tiny_stages.without(short, "train"))
    check_every_damage(work, tmp_path, monkeypatch, lambda patch: killed.kill_after(8, patch))


@pytest.mark.integration
def test_pruning_goes_on_from_no_damaged_file(
    short: StageInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = Work("prune", prune, PruneConfig(ratio=0.5, at="end", recovery=4, rounds=2), short)
    check_every_damage(work, tmp_path, monkeypatch, kill_at_file(5))


@pytest.mark.integration
def test_scores_and_exports_go_on_from_no_damaged_file(
    short: StageInputs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for work in (Work("evaluate", evaluate, EvaluateConfig(trust=False), short),
                 Work("export", export, ExportConfig(), short)):
        folder = tmp_path / work.name
        folder.mkdir()
        check_every_damage(work, folder, monkeypatch, kill_at_file(1))


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Six photos of a wall, each from a place of its own."""
    folder, noise = tmp_path / "photos", np.random.default_rng(0)
    folder.mkdir()
    wall = cv2.GaussianBlur(noise.integers(0, 255, (96, 260, 3), np.uint8), (0, 0), 1.5)
    for index in range(6):
        cv2.imwrite(str(folder / f"{index:03d}.png"), wall[:, 30 * index:30 * index + 96])
    return folder


@pytest.mark.integration
def test_frames_that_were_written_are_not_kept_where_they_were_damaged(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").mkdir()
    read = Work("ingest", ingest, IngestConfig(), StageInputs({}, (photos,)))
    check_every_damage(read, tmp_path / "a", monkeypatch, kill_at_file(3))
    (tmp_path / "b").mkdir()
    frames = StageInputs({"ingest": tmp_path / "a" / "undisturbed" / ".partial" / "ingest"})
    check_every_damage(
        Work("denoise", denoise, DenoiseConfig(), frames), tmp_path / "b", monkeypatch,
        kill_at_file(3))


def test_work_of_an_undamaged_run_is_kept(tmp_path: Path) -> None:
    workspace, key = Workspace(tmp_path), ResultKey("train", 1, {}, (), {})
    out, first = workspace.begin(key)
    assert isinstance(first, PartialRun)
    write_bytes(out / "kept.bin", b"1")
    write_bytes(out / "kept.bin", b"2")
    write_bytes(out / "gone.bin", b"3")
    delete(out / "gone.bin")
    workspace.record(replace(first, done=1, total=2))
    again, earlier = workspace.begin(key)
    assert (earlier.done, earlier.total) == (1, 2)
    assert [path.name for path in again.iterdir()] == ["kept.bin"]


@pytest.mark.parametrize("own_digests", [True, False])
def test_unfinished_work_of_an_earlier_version_is_begun_anew_with_a_notice(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, own_digests: bool
) -> None:
    workspace, key = Workspace(tmp_path), ResultKey("train", 1, {}, (), {})
    out, _ = workspace.begin(key, own_digests=own_digests)
    (out / "steps.json").write_text("{}")  # what that version wrote
    steps.log_path(out).unlink(missing_ok=True)
    again, _ = workspace.begin(key, own_digests=own_digests)
    assert list(again.iterdir()) == []
    assert_facts(caplog.text, "unfinished", "work", "discarded")
