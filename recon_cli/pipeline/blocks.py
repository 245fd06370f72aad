"""Trains a large scene in blocks: a workspace each, which `recon train` then works on by itself.

A block has the views that see enough of its cell, all points in that, and some of the others. The
folder `blocks` in the workspace of the scene says what was cut, and how.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from recon_cli import machine
from recon_cli.config import settings as layers
from recon_cli.config.stages import DenoiseConfig, IngestConfig, SfmConfig, TrainConfig
from recon_cli.errors import ConfigError, FormatError, ReconstructionError, StageError
from recon_cli.executors.executor import Command, Executor, find_reason, run_all, watching
from recon_cli.io import records
from recon_cli.io.colmap import read_observations, read_scene, write_part
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.plan import require_fresh, status
from recon_cli.progress import Progress
from recon_cli.scene.cells import Cell
from recon_cli.scene.covisibility import (
    context_points,
    label_points,
    observe_points,
    split_views,
    views_of_block,
)
from recon_cli.stages import MERGE, STAGES
from recon_cli.workspace import manifest
from recon_cli.workspace.atomic import read_json, write_bytes, write_json
from recon_cli.workspace.digests import digest_outputs
from recon_cli.workspace.layout import BLOCKS, Workspace, disk_errors, remove
from recon_cli.workspace.manifest import Manifest, ResultKey, RunRecord

LIST, OPTIONS = "blocks.json", "train.toml"
MOST_VIEWS = 1200  # of one model; the most that was ever trained as one
LEAST_VIEWS = 20  # of a block, so that each view of it has neighbours
_VERSION = 2


@dataclass(frozen=True)
class Block:
    """One of the workspaces that a scene was cut into."""

    name: str
    workspace: Path

    @property
    def log(self) -> Path:
        """What its training prints."""
        return self.workspace.with_suffix(".log")

    @property
    def model(self) -> Path:
        """Its finished Gaussians."""
        return self.workspace / "train" / "splats.ply"


def count_blocks(job: Job, asked: str) -> int:
    """Returns how many blocks a scene whose sfm is fresh is cut into; 1: it stays whole.

    Raises:
        ConfigError: `asked` is no number, "auto" or "off", or more than the views allow.
    """
    views = int((_manifest(job, "sfm").run.summary)["registered"])
    if asked == "off":
        return 1
    if asked == "auto":
        return -(-views // MOST_VIEWS)
    if not asked.isdigit() or not int(asked) >= 1:
        raise ConfigError(f"blocks is {asked!r}, but needs auto, off or a number of blocks.",
                          hint="Type `recon train --blocks 3`, for example.")
    if int(asked) > max(1, views // LEAST_VIEWS):
        raise ConfigError(
            f"{views} views are too few for {asked} blocks: each takes {LEAST_VIEWS} or more.",
            hint=f"Give at most --blocks {max(1, views // LEAST_VIEWS)}.")
    return int(asked)


def cut_blocks(job: Job, count: int, config: TrainConfig) -> tuple[Block, ...]:
    """Returns the blocks of a scene; those of the same cut are kept with what they hold.

    Raises:
        StageError: ingest, denoise or sfm is not fresh.
        WorkspaceError: another process holds the workspace, or the disk is full.
    """
    root = job.workspace.root / BLOCKS
    with disk_errors(root, "cutting the scene"), job.workspace.writing("train --blocks"):
        require_fresh(job, ["ingest", "denoise", "sfm"])
        plan = {"version": _VERSION, "blocks": count, "validation": config.validation,
                **{name: _manifest(job, name).digest for name in ("ingest", "denoise", "sfm")}}
        blocks = tuple(Block(str(index), root / str(index)) for index in range(count))
        if _read_list(root) != plan:
            remove(root)
            _write_blocks(job, blocks, config)
            write_json(root / LIST, plan)  # the last: without it, all is cut again
        write_bytes(root / OPTIONS, layers.to_toml({"train": config}).encode())
    return blocks


def list_blocks(workspace: Workspace) -> tuple[Block, ...]:
    """Returns the blocks of a workspace; StageError where it has none, or one is not trained."""
    root = workspace.root / BLOCKS
    found = _read_list(root)
    if not found:
        raise StageError(f"{workspace.root} has no blocks to merge.",
                         hint="Run `recon train --blocks N` first.")
    blocks = tuple(Block(str(index), root / str(index))
                   for index in range(int(found["blocks"])))
    for block in blocks:
        train = next(stage for stage in status(Job(Workspace(block.workspace)))
                     if stage.name == MERGE.name)
        if train.state != "fresh":
            why = f" ({'; '.join(train.reasons)})" if train.reasons else ""
            raise StageError(
                f"Block {block.name} of {len(blocks)} has no finished training: it is "
                f"{train.state}{why}.",
                hint=f"Run `recon train --blocks {len(blocks)}` again, or `recon train -w "
                f"{block.workspace}`.")
    return blocks


def _read_list(root: Path) -> dict[str, Any]:
    """Returns what was cut; empty where nothing was, or the list of it is damaged."""
    try:
        value: dict[str, Any] = read_json(root / LIST, dict)
    except FormatError:
        return {}
    return value if type(value.get("blocks")) is int else {}


def train_blocks(
    blocks: Sequence[Block], words: Sequence[str], executor: Executor, progress: Progress,
    report: Callable[[str], None],
) -> None:
    """Runs `recon train` on every block; those that can be finished are, whatever others do.

    Raises:
        ReconstructionError: a block failed.
        BackendError: the machines cannot be reached any more.
    """
    def run(block: Block) -> str:
        options = block.workspace.parent / OPTIONS
        command = Command(
            ("train", "-w", str(block.workspace), "--config", str(options), *words),
            block.workspace, block.log)
        with progress.bar(f"block {block.name}", 100, unit="%") as bar, watching(
                bar, lambda: _progress(block)):
            return find_reason(block.log, executor.run(command))

    def tell(block: Block, reason: str) -> None:
        report(f"block {block.name}: {reason or 'trained'}")

    reasons = run_all(executor, blocks, run, tell)
    failed = {block.name: reason for block, reason in reasons.items() if reason}
    if failed:
        raise ReconstructionError(
            f"{len(failed)} of {len(blocks)} blocks failed: "
            + "; ".join(f"{name}: {reason}" for name, reason in failed.items()),
            hint="The others are kept; the same command tries these again.")


def _progress(block: Block) -> tuple[int, str]:
    partial = Workspace(block.workspace).partial_run(MERGE.name)
    if partial is None or not partial.total:
        return 0, ""
    return 100 * partial.done // partial.total, f"{partial.done}/{partial.total}"


def _manifest(job: Job, stage: str) -> Manifest:
    finished = job.workspace.manifest(stage)
    assert finished is not None, f"{stage} is fresh"
    return finished


def _write_blocks(job: Job, blocks: Sequence[Block], config: TrainConfig) -> None:
    sfm, ingest = job.workspace.folder("sfm"), job.workspace.folder("ingest")
    held_out = frozenset(
        frame.name for frame in records.read_frame_list(ingest).frames if frame.held_out)
    scene = read_scene(sfm / "undistorted", held_out=held_out, validation=config.validation)
    validation = frozenset(view.name for view in scene.validation)
    names, points, observations = read_observations(sfm / "undistorted" / "sparse")
    if not len(observations.view):  # points that came with the poses
        cameras = {view.name: view.camera
                   for view in (*scene.train, *scene.validation, *scene.test)}
        observations = observe_points(points, [cameras[name] for name in names])
    labels = split_views(observations, len(blocks))
    point_labels = label_points(observations, labels, points)
    for index, block in enumerate(blocks):
        chosen = views_of_block(observations, point_labels, labels, index)
        owned = point_labels == index
        part = {name for name, here in zip(names, chosen, strict=True) if here}
        _Writer(job, block, part, len(points)).write(
            records.BlockRecord(Cell(points, owned), validation),
            context_points(owned, config.seed))


class _Writer:
    """Writes the stages of a block's workspace before training, as if each had been run there."""

    def __init__(self, job: Job, block: Block, names: Collection[str], points: int) -> None:
        self._from, self._workspace = job.workspace, Workspace(block.workspace)
        self._names, self._points = names, points
        self._index = block.name

    def write(self, block: records.BlockRecord, points: np.ndarray) -> None:
        """Writes and commits ingest, denoise and sfm."""
        with self._workspace.writing("train --blocks"):
            ingest = self._commit("ingest", IngestConfig(), {}, self._write_ingest)
            denoise = self._commit(
                "denoise", DenoiseConfig(), {"ingest": ingest}, self._write_denoise)
            self._commit(
                "sfm", SfmConfig(), {"ingest": ingest, "denoise": denoise},
                lambda out: self._write_sfm(out, block, points))

    def _commit(
        self, stage: str, config: Any, upstream: Mapping[str, str],
        write: Callable[[Path], Mapping[str, Any]],
    ) -> str:
        row = next(row for row in STAGES if row.name == stage)
        key = ResultKey(stage, row.version, config.hashed_fields(), (), dict(upstream))
        self._workspace.discard(stage)
        out, _ = self._workspace.begin(key)
        summary = write(out)
        outputs = self._workspace.seal(stage)
        digest = digest_outputs(outputs, row.volatile)
        self._workspace.commit(Manifest(key, outputs, digest, RunRecord(
            0.0, 0, summary, machine.versions(), None, None, 1,
            datetime.now().astimezone().isoformat(timespec="seconds"))))
        return digest

    def _summary(self, stage: str, **changes: Any) -> dict[str, Any]:
        finished = self._from.manifest(stage)
        assert finished is not None
        return {**finished.run.summary, **changes}

    def _link(self, folder: Path, target: Path) -> None:
        """Puts the images of a folder that belong to the block into another one."""
        target.mkdir(parents=True, exist_ok=True)
        for name in sorted(self._names):
            path = folder / name
            if path.exists():
                try:
                    os.link(path, target / name)
                except OSError:  # another disk, or one without links
                    shutil.copyfile(path, target / name)

    def _write_ingest(self, out: Path) -> dict[str, Any]:
        folder = self._from.folder("ingest")
        frames = records.read_frame_list(folder)
        chosen = tuple(frame for frame in frames.frames if frame.name in self._names)
        self._link(folder / records.FOLDER, out / records.FOLDER)
        if any(frame.masked for frame in chosen):
            self._link(folder / records.MASKS, out / records.MASKS)
        dataclasses.replace(frames, frames=chosen).write(out)
        return self._summary(
            "ingest", frames=len(chosen), held_out=sum(frame.held_out for frame in chosen))

    def _write_denoise(self, out: Path) -> dict[str, Any]:
        self._link(self._from.folder("denoise") / records.FOLDER, out / records.FOLDER)
        return self._summary("denoise", frames=len(self._names))

    def _write_sfm(
        self, out: Path, block: records.BlockRecord, points: np.ndarray
    ) -> dict[str, Any]:
        folder = self._from.folder("sfm")
        for name in ("images", "denoised", "masks"):
            if (folder / "undistorted" / name).is_dir():
                self._link(folder / "undistorted" / name, out / "undistorted" / name)
        count = write_part(
            folder / "undistorted" / "sparse", out / "undistorted" / "sparse", self._names, points)
        for path in sorted(folder.glob("*.json")):
            if path.name not in {manifest.NAME, "steps.json"}:
                shutil.copyfile(path, out / path.name)
        block.write(out)
        return self._summary(
            "sfm", frames=len(self._names), registered=len(self._names), points=count,
            unregistered=[], unregistered_held_out=[], left_out=[], apart=[], rejected={},
            parts=[], part=1, models=[len(self._names)], lines=[])
