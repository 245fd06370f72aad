"""A large scene in blocks, each trained by a job of its own; `merge_blocks` joins their models.

A block has the views that see enough of its cell, all points in that, and some of the others. Its
job is a file in the partial folder of the stage. The command that trains it may run on another
machine; what it has finished stays for the next run of the stage.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from recon_cli import machine
from recon_cli.config.stages import ComputeConfig, TrainConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, FormatError, Hint, ManifestError, ReconstructionError
from recon_cli.io.colmap import read_observations, write_part
from recon_cli.io.training_scene import load_scene
from recon_cli.jobs.executor import CORES, NEEDS_GPU, Command, Executor, start_executor
from recon_cli.jobs.shared_jobs import SharedJob, describe_failures, run_jobs
from recon_cli.scene.cells import Cell
from recon_cli.scene.covisibility import (
    context_points,
    label_points,
    observe_points,
    split_views,
    views_of_block,
)
from recon_cli.scene.scene import Scene
from recon_cli.train.masks import with_masks
from recon_cli.train.one_model import fit_scene
from recon_cli.workspace import atomic
from recon_cli.workspace.digests import digest_outputs
from recon_cli.workspace.json_record import sha256_json
from recon_cli.workspace.layout import Workspace, disk_errors
from recon_cli.workspace.manifest import Manifest, ResultKey, RunRecord, find_changed_outputs
from recon_cli.workspace.steps import JOBS

MOST_VIEWS = 1200  # of one model; the most that was ever trained as one
LEAST_VIEWS = 20  # of a block, so that each view of it has neighbours
MERGE_SHARE = 0.2  # of the work, about, that is left when all blocks are trained
STAGE = "train"  # name of a block's result in its folder
COMMAND = "train-block"  # of recon, which takes JOB
JOB, OUTPUT = "block.safetensors", "output.txt"  # the command's input and output
_VERSION = 1


def count_blocks(views: int, asked: str) -> int:
    """Returns how many blocks so many views are trained in; 1: they stay one model.

    `asked` is auto, off or a number; ConfigError if it is more than the views allow.
    """
    if asked == "off":
        return 1
    if asked == "auto":
        return -(-views // MOST_VIEWS)
    most = max(1, views // LEAST_VIEWS)
    if int(asked) > most:
        raise ConfigError(
            f"{views} views are too few for {asked} blocks: each takes {LEAST_VIEWS} or more.",
            hint=f"Give --blocks {most} or fewer, or --set train.blocks={most} to a verb without "
            "--blocks.")
    return int(asked)


@dataclass(frozen=True, eq=False)
class BlockJob:
    """The training of one block, and its folder."""

    folder: Path  # of this block
    inputs: StageInputs  # of the stage: the whole scene
    views: frozenset[str]  # names
    validation: frozenset[str]  # names of the views that no block is trained on
    cell: Cell
    config: TrainConfig

    @property
    def name(self) -> str:
        """The number of the block."""
        return self.folder.name

    @property
    def model(self) -> Path:
        """The folder of its finished training."""
        return Workspace(self.folder).folder(STAGE)

    @property
    def key(self) -> ResultKey:
        """Everything that decides its result."""
        part = {"views": sorted(self.views), "validation": sorted(self.validation),
                "owned": hashlib.sha256(self.cell.owned.tobytes()).hexdigest()}
        return ResultKey(
            STAGE, _VERSION, self.config.hashed_fields(), (),
            {**self.inputs.digests, "block": sha256_json(part)}, verb=COMMAND)

    def finished(self) -> Manifest | None:
        """Returns the manifest of its finished training; None where there is none like that."""
        try:
            manifest = Workspace(self.folder).manifest(STAGE)
        except ManifestError:
            return None
        if manifest is None or manifest.key.fingerprint != self.key.fingerprint:
            return None
        return None if find_changed_outputs(self.model, manifest, ()) else manifest

    def share(self) -> float:
        """Returns how much of it is done."""
        workspace = Workspace(self.folder)
        partial = workspace.partial_run(STAGE)
        if partial is not None:
            return partial.done / partial.total if partial.total else 0.0
        return float(workspace.folder(STAGE).exists())

    def write(self) -> None:
        """Writes the file of the job into its folder."""
        self.folder.mkdir(parents=True, exist_ok=True)
        value = {
            "folders": {name: str(path) for name, path in self.inputs.folders.items()},
            "digests": dict(self.inputs.digests), "views": sorted(self.views),
            "validation": sorted(self.validation), "config": dataclasses.asdict(self.config)}
        with atomic.replacing(self.folder / JOB) as temporary:
            save_file(
                {"points": np.ascontiguousarray(self.cell.points),
                 "owned": self.cell.owned.astype(np.uint8)},
                temporary, metadata={"job": json.dumps(value)})

    @staticmethod
    def read(file: Path) -> BlockJob:
        """Returns the job of a file; FormatError if that is damaged."""
        try:
            with safe_open(file, "numpy") as content:
                value: dict[str, Any] = atomic.parse_json(content.metadata()["job"], dict)
                cell = Cell(
                    content.get_tensor("points"), content.get_tensor("owned").astype(np.bool_))
            folders = {name: Path(path) for name, path in value["folders"].items()}
            return BlockJob(
                file.parent, StageInputs(folders, digests=value["digests"]),
                frozenset(value["views"]), frozenset(value["validation"]), cell,
                TrainConfig(**value["config"]))
        except (AttributeError, KeyError, TypeError, ValueError, OSError, RecursionError,
                SafetensorError) as error:
            raise FormatError(
                f"{file} does not describe a block.", hint=Hint("train", then=" again")) from error

    def load_scene(self) -> Scene:
        """Writes the block's part of the sparse model beside the job, and returns its scene."""
        part = self.folder / "sparse"
        shutil.rmtree(part, ignore_errors=True)
        write_part(
            self.inputs.folders["place"] / "undistorted" / "sparse", part, self.views,
            context_points(self.cell.owned, self.config.seed))
        scene = load_scene(self.inputs.folders, validation=self.validation, sparse=part)
        scene = with_masks(scene, self.folder.parent.parent)  # those that a user has edited
        return dataclasses.replace(scene, cell=self.cell)


def cut_blocks(
    config: TrainConfig, count: int, scene: Scene, inputs: StageInputs, out: Path
) -> tuple[BlockJob, ...]:
    """Writes and returns the jobs of the blocks of a scene; the same scene gives the same ones."""
    views = {view.name: view for view in (*scene.train, *scene.validation, *scene.test)}
    names, points, observations = read_observations(
        inputs.folders["place"] / "undistorted" / "sparse")
    if not len(observations.view):  # points that came with the poses
        observations = observe_points(points, [views[name].camera for name in names])
    labels = split_views(observations, count)
    point_labels = label_points(observations, labels, points)
    inputs = dataclasses.replace(
        inputs, folders={name: path.resolve() for name, path in inputs.folders.items()})
    jobs = []
    for index in range(count):
        chosen = views_of_block(observations, point_labels, labels, index)
        jobs.append(BlockJob(
            out.absolute() / JOBS / str(index), inputs,
            frozenset(name for name, here in zip(names, chosen, strict=True) if here),
            frozenset(view.name for view in scene.validation),
            Cell(points, point_labels == index),
            dataclasses.replace(
                config, blocks="off", jobs=None, on="local", compact_only=False)))
        jobs[-1].write()
    return tuple(jobs)


def train_blocks(jobs: Sequence[BlockJob], config: TrainConfig, ctx: StageContext) -> None:
    """Trains the blocks that are not finished by commands; one that fails stops no other.

    Raises:
        ReconstructionError: a block failed.
        BackendError: the machines cannot be reached any more.
    """
    unfinished = [job for job in jobs if job.finished() is None]
    done = 1 - len(unfinished) / len(jobs)
    if not unfinished:
        return
    executor, threads = _start_executor(jobs, config, ctx)
    shared = [_shared_job(job, threads, ctx) for job in unfinished]
    try:
        ends = run_jobs(
            shared, executor, ctx.progress,
            record=lambda share: record(ctx, (1 - MERGE_SHARE) * (done + (1 - done) * share)))
    finally:
        executor.close()
    failed = {job.name: end.reason for job, end in zip(unfinished, ends, strict=True) if end.reason}
    if failed:
        logs = ", ".join(str(job.folder / OUTPUT) for job in unfinished if job.name in failed)
        raise ReconstructionError(
            describe_failures(failed, len(jobs), "blocks"),
            hint="The same command, without --again, keeps the others and tries these again. They "
            f"printed {logs}.")


def train_block(file: Path, ctx: StageContext) -> None:
    """Trains the block whose job is given; its result, or how far it came, stays beside the job.

    Raises:
        FormatError: the file, or one of the scene, is damaged.
        WorkspaceError: another process trains the block, or the disk is full.
        TrainingError: the block cannot be trained.
    """
    job = BlockJob.read(file)
    workspace = Workspace(job.folder)
    with disk_errors(job.folder, "training a block"), workspace.writing(COMMAND):
        if job.finished() is not None:
            return
        out, earlier = workspace.begin(job.key)

        def record_own(done: int, total: int) -> None:
            workspace.record(dataclasses.replace(earlier, done=done, total=total))

        with machine.Meter() as meter:
            summary = fit_scene(
                job.config, job.load_scene(), out,
                dataclasses.replace(ctx, record=record_own, scratch=job.folder))
        outputs = workspace.seal(STAGE)
        workspace.commit(Manifest(job.key, outputs, digest_outputs(outputs, ()), RunRecord(
            round(meter.seconds, 3), meter.peak_memory_bytes, summary.to_json(),
            machine.versions(), ctx.device, ctx.backend, ctx.threads,
            datetime.now().astimezone().isoformat(timespec="seconds"))))


def record(ctx: StageContext, share: float) -> None:
    """Records how much of the whole training is done."""
    ctx.record(int(100 * share), 100)


def remove_blocks(out: Path) -> None:
    """Deletes the folders of the blocks."""
    shutil.rmtree(out / JOBS, ignore_errors=True)


def _shared_job(job: BlockJob, threads: int, ctx: StageContext) -> SharedJob:
    compute = _asked(ctx)
    words = [COMMAND, str(job.folder / JOB), "--threads", str(threads),
             "--device", compute.device, "--backend", compute.backend]
    if compute.max_memory is not None:
        words += ["--max-memory", str(compute.max_memory)]

    def look() -> tuple[float, str]:
        share = job.share()
        return share, f"{share:.0%}"

    command = Command(tuple(words), job.folder, job.folder / OUTPUT)
    return SharedJob(f"block {job.name}", command, look)


def _asked(ctx: StageContext) -> ComputeConfig:
    return ctx.compute or ComputeConfig(device=ctx.device, backend=ctx.backend)


def _start_executor(
    jobs: Sequence[BlockJob], config: TrainConfig, ctx: StageContext
) -> tuple[Executor, int]:
    """Returns the executor of blocks, and the threads of each: on this machine they share all."""
    folder, compute = jobs[0].folder.parent, _asked(ctx)
    if config.on == "ray":
        return start_executor(
            config.on, folder, inputs=list(jobs[0].inputs.folders.values()), slots=config.jobs,
            cores=compute.threads, gpu=NEEDS_GPU[compute.device])
    slots = min(config.jobs or max(1, ctx.threads // CORES), len(jobs))
    return start_executor(config.on, folder, slots=slots, cores=max(1, ctx.threads // slots))
