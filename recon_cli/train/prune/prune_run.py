"""A pruning run on disk: it resumes after a kill, and may search the largest ratio.

`round-<k>.safetensors` is a state after the k-th removal, `rounds.json` lists the removals. The
state is written first and the list after it: a kill in between repeats the round before, to the
same bytes. While scores are gathered (an epoch at most) nothing is saved.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from recon_cli.config.stages import PruneConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError
from recon_cli.io.training_scene import load_scene
from recon_cli.train.finished_model import FINAL, FinishedModel
from recon_cli.train.fit.importance import Importance
from recon_cli.train.fit.initialize import make_finished_state, restore_state
from recon_cli.train.fit.loop import validation_psnr
from recon_cli.train.fit.runner import RunSegment, TrainLog, run_fit, seconds_at
from recon_cli.train.fit.schedule import RecoverySchedule
from recon_cli.train.fit.state import TrainState, save_state
from recon_cli.train.fit.task import Task
from recon_cli.train.fit.train_data import load_task
from recon_cli.train.masks import with_masks
from recon_cli.train.prune.prune_loop import (
    LAST_ROUND,
    ROUND_COUNTS,
    PruneRun,
    remaining,
    rounds_within,
)
from recon_cli.workspace.atomic import delete, read_json, write_bytes
from recon_cli.workspace.summaries import JsonRecord, LogRow

logger = logging.getLogger("recon")

ROUNDS = "rounds.json"
GOOD = "good.safetensors"  # the last state whose validation PSNR was good enough
_END_RECOVERY = 6  # the reference recovers for 5,000 steps after 30,000
# Share that a round of the search removes at first; halved when too much, down to the least
_SEARCH_SHARE = 0.25
_LEAST_SHARE = 0.05


@dataclass(frozen=True)
class Round(JsonRecord):
    """One removal and its outcome. PSNR is None where there are no validation views."""

    iteration: int  # steps done before it
    gaussians_before: int  # count
    gaussians: int  # count after it
    removed: float  # share of `gaussians_before`
    validation_psnr_db_before: float | None  # PSNR in dB right before it
    validation_psnr_db_removed: float | None  # right after it
    validation_psnr_db: float | None  # after the steps that followed; None while they are under way
    kept: bool  # False where it cost more than --max-psnr-drop and was taken back


@dataclass(frozen=True, eq=False)
class PruneSource:
    """The trained model that is pruned."""

    config: PruneConfig  # options of the stage
    task: Task  # views and the plan of the training run
    begin: Callable[[], TrainState]  # loads the state to be pruned
    first: int  # steps done before the first removal
    until: int  # steps done at the end, if the count is known beforehand
    rounds: int  # of removal, at most
    earlier_seconds: float  # of training before that

    def recovery(self, first: int, until: int) -> Task:
        """Returns the task with the learning rates of a recovery between two steps."""
        config = dataclasses.replace(self.task.schedule.config, early_stop=False)
        schedule = RecoverySchedule(config, first=first, until=until)
        return dataclasses.replace(self.task, schedule=schedule)


def load_prune_source(config: PruneConfig, inputs: StageInputs, ctx: StageContext) -> PruneSource:
    """Returns the model to be pruned, its views, and the steps there are.

    Raises:
        ConfigError: the middle of a run is asked for that took place elsewhere.
    """
    model = FinishedModel.read(inputs.folders["train"])
    single = model.trained  # else the scene was imported, or merged from blocks
    import_record = None if single else model.import_record
    if import_record and config.at == "mid":
        raise ConfigError(
            f"at is mid, but the scene was imported from {import_record.file}: the middle of its "
            "training is not known.", hint="Prune it with --at end.")
    if import_record and import_record.doubt:
        ctx.notice(import_record.doubt)
    if model.config.compact_only and config.at == "end":
        ctx.notice("The training ended in its middle: pruning takes the steps that are left.")
        config = dataclasses.replace(config, at="mid")
    if config.at == "mid" and not single:
        ctx.notice("The blocks that the scene was trained in have no common middle: the finished "
                   "model is pruned.")
        config = dataclasses.replace(config, at="end")
    scene = load_scene(inputs.folders, validation=model.config.validation)
    task = load_task(with_masks(scene, model.folder), model.config, ctx)
    final = model.folder / FINAL
    path = model.folder / "mid.safetensors" if config.at == "mid" else final

    def begin() -> TrainState:
        if not single:
            return make_finished_state(model.read_splats(), task)
        return restore_state(path, task)

    start, epoch = begin(), task.schedule.epoch(len(task.train))
    steps = config.recovery
    if steps is None:
        steps = count_recovery_steps(model.config.iterations, epoch)
        if config.at == "mid":
            # as many as the unpruned run took, which may have stopped early; where it continued for
            # a few steps only, too few to recover
            rest = (model.config.iterations - start.iteration if model.config.compact_only
                    else restore_state(final, task).steps - start.steps)
            continued = model.plan is not None and model.plan.continues_at is not None
            steps = max(rest, steps) if continued else rest
    return PruneSource(
        config, task, begin, start.iteration, start.iteration + steps,
        config.rounds or rounds_within(steps, epoch),
        seconds_at(model.folder / LogRow.FILE, start.iteration))


def count_recovery_steps(iterations: int, epoch: int) -> int:
    """Returns the steps after which a finished model has recovered; `epoch` in steps.

    The fewest rounds have room before the last one, each scored by an epoch of its own.
    """
    return max(iterations // _END_RECOVERY, round(ROUND_COUNTS[0] / LAST_ROUND) * epoch)


class StoredPruneRun(PruneRun):
    """A pruning run whose rounds and state are kept in a folder; it begins where that left off."""

    def __init__(self, source: PruneSource, out: Path, ctx: StageContext) -> None:
        self.source, self._out, self._ctx = source, out, ctx
        self.done = self._read_rounds()
        path = out / _name(len(self.done))
        super().__init__(
            restore_state(path, source.task) if path.exists() else source.begin(),
            source.recovery(source.first, source.until), source.first, source.until,
            rounds=source.rounds, score=source.config.score, beta=source.config.beta)
        self.removals_done = len(self.done)
        if self.done:
            self.count_before = self.done[0].gaussians_before
        self._trained = 0.0, 0.0  # wall and CPU seconds of training

    def advance(self, until: int, importance: Importance | None = None) -> None:
        """Trains up to a step with checkpoints and a log."""
        begin, cpu_begin = time.perf_counter(), time.process_time()
        if self.state.iteration < until:
            number = len(self.done)
            run_fit(self.state, self.task, until, RunSegment(
                self._out, f"round {number}", first=self.first, until=max(self.until, until),
                earlier_seconds=self.source.earlier_seconds, checkpoint=_name(number)),
                self._ctx, importance)
        wall, cpu = self._trained
        self._trained = (wall + time.perf_counter() - begin, cpu + time.process_time() - cpu_begin)

    def score(self, until: int) -> Tensor:
        """Trains up to a step and returns the score [N]; logs the seconds of scoring as well."""
        self._trained = 0.0, 0.0
        begin, cpu_begin = time.perf_counter(), time.process_time()
        score = super().score(until)
        log = TrainLog(
            self._out / LogRow.FILE, self.state.iteration, self.source.earlier_seconds)
        log.add_idle(
            self.state.iteration, time.perf_counter() - begin - self._trained[0],
            time.process_time() - cpu_begin - self._trained[1])
        return score

    def remove(self, score: Tensor, count: int) -> None:
        """Ends the round before, removes Gaussians, and saves the state and the list of rounds."""
        number, n, before = len(self.done), len(self.state.splats), self.end_round()
        super().remove(score, count)
        left = len(self.state.splats)
        save_state(self._out / _name(number + 1), self.state)
        self.done.append(Round(
            self.state.iteration, n, left, 1 - left / n, before, self._psnr(), None, kept=True))
        logger.info("round %d removes %d of %d Gaussians", number + 1, n - left, n)
        self.write_rounds()
        delete(self._out / _name(number))

    def end_round(self) -> float | None:
        """Returns the validation PSNR in dB, and records it as that of the round under way."""
        psnr = self._psnr()
        if self.done and self.done[-1].validation_psnr_db is None:
            self.done[-1] = dataclasses.replace(self.done[-1], validation_psnr_db=psnr)
        return psnr

    def accept(self) -> None:
        """Saves the state as the last good one."""
        save_state(self._out / GOOD, self.state)

    def take_back(self) -> None:
        """Returns to the last good state and marks the round as taken back."""
        self.done[-1] = dataclasses.replace(self.done[-1], kept=False)
        good = self._out / GOOD
        self.state = (
            restore_state(good, self.source.task) if good.exists() else self.source.begin())

    def write_rounds(self) -> None:
        """Writes the list of rounds atomically."""
        rows = [row.to_json() for row in self.done]
        write_bytes(self._out / ROUNDS, json.dumps(rows, indent=1).encode())

    def clear(self) -> None:
        """Deletes the files that only a resumed run would have needed."""
        for path in (*self._out.glob(_name("*")), self._out / GOOD):
            delete(path)

    def _psnr(self) -> float | None:
        return validation_psnr(self.state, self.source.task)

    def _read_rounds(self) -> list[Round]:
        """Returns the list of rounds; empty where the state that it leads to is missing."""
        path = self._out / ROUNDS
        rows = read_json(path, list) if path.exists() else []
        resumable = (self._out / _name(len(rows))).exists()
        return [Round.from_json(row) for row in rows] if resumable else []


def prune_while_good(run: StoredPruneRun, psnr_before: float, max_drop: float) -> None:
    """Prunes for at most `max_drop` dB: undoes rounds that cost more and tries smaller ones."""
    steps = (run.until - run.first) // run.rounds
    while True:
        score = None
        if run.done:
            begin = run.done[-1].iteration
            run.task = run.source.recovery(begin, begin + steps)
            score = run.score(begin + steps)
            run.end_round()
            if psnr_before - (run.done[-1].validation_psnr_db or 0.0) <= max_drop:
                run.accept()
            else:
                run.take_back()
                score = None
        share = _SEARCH_SHARE * 0.5 ** sum(not row.kept for row in run.done)
        count = remaining(len(run.state.splats), share)
        if share < _LEAST_SHARE or count == len(run.state.splats):
            break
        if score is None:
            run.task = run.source.task
            score = run.score(run.state.iteration)
        run.remove(score, count)


def _name(number: int | str) -> str:
    return f"round-{number}.safetensors"
