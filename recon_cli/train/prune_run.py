"""What a run of pruning has on disk: the rounds done so far, and the state of the one under way.

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

from recon_cli.config.stages import PruneConfig, RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError
from recon_cli.evaluation.reference_views import load_scene
from recon_cli.io.import_record import ImportRecord
from recon_cli.io.ply import read_ply
from recon_cli.train.fit import Task, validation_psnr
from recon_cli.train.importance import Importance
from recon_cli.train.initialize import finished_state, saved_state
from recon_cli.train.pruning import Recovery, remove, rounds_within, scored, survivors
from recon_cli.train.runner import LOG, Log, load_task, read_config, run_fit, seconds_at
from recon_cli.train.state import TrainState, save_state
from recon_cli.workspace.atomic import read_json, write_bytes

logger = logging.getLogger("recon")

ROUNDS = "rounds.json"
GOOD = "good.safetensors"  # the last state whose validation PSNR was good enough
_END_RECOVERY = 6  # the reference recovers for 5,000 steps after 30,000
_END_EPOCHS = 6  # three rounds in its first half, each scored by an epoch of its own


@dataclass(frozen=True)
class Round:
    """One removal and what became of it. PSNR is None where there are no validation views.

    Attributes:
        iteration: steps done before it.
        gaussians_before: count.
        gaussians: count after it.
        removed: share of `gaussians_before`.
        validation_psnr_db_before: PSNR in dB right before it.
        validation_psnr_db_removed: right after it.
        validation_psnr_db: after the steps that followed; None while they are under way.
        kept: False where it cost more than --max-psnr-drop and was taken back.
    """

    iteration: int
    gaussians_before: int
    gaussians: int
    removed: float
    validation_psnr_db_before: float | None
    validation_psnr_db_removed: float | None
    validation_psnr_db: float | None = None
    kept: bool = True


@dataclass(frozen=True, eq=False)
class Course:
    """All that the rounds of one run need.

    Attributes:
        config: options of the stage.
        task: views and the plan of the training run.
        start: loads the state to be pruned.
        load: loads a state that was saved in `out`.
        out: partial folder of the stage.
        ctx: progress and record.
        first: steps done before the first removal.
        until: steps done at the end, if the count is known beforehand.
        earlier_seconds: of training before that.
    """

    config: PruneConfig
    task: Task
    start: Callable[[], TrainState]
    load: Callable[[Path], TrainState]
    out: Path
    ctx: StageContext
    first: int
    until: int
    earlier_seconds: float

    @property
    def rounds(self) -> int:
        """How many rounds there are."""
        epoch = self.task.schedule.epoch(len(self.task.train))
        return self.config.rounds or rounds_within(self.until - self.first, epoch)

    def recovering(self, first: int, until: int) -> Task:
        """Returns the task with learning rates for a recovery between two steps."""
        config = dataclasses.replace(self.task.schedule.config, early_stop=False)
        plan = Recovery(config, first=first, until=until)
        return dataclasses.replace(self.task, schedule=plan)

    def advance(
        self, task: Task, number: int, state: TrainState, until: int,
        importance: Importance | None = None,
    ) -> None:
        """Trains a state of round `number` up to a step."""
        if state.iteration < until:
            run_fit(
                state, task, until, self.out, self.ctx, label=f"round {number}", first=self.first,
                earlier_seconds=self.earlier_seconds, end=max(self.until, until),
                checkpoint=_name(number), importance=importance)

    def scored(self, task: Task, number: int, state: TrainState, until: int) -> Tensor:
        """Trains a state of round `number` up to a step and returns its scores [N].

        The seconds of passes that only score go into the log, like those of training.
        """
        trained, trained_cpu = 0.0, 0.0

        def advance(state: TrainState, until: int, importance: Importance | None) -> None:
            nonlocal trained, trained_cpu
            begin, cpu_begin = time.perf_counter(), time.process_time()
            self.advance(task, number, state, until, importance)
            trained += time.perf_counter() - begin
            trained_cpu += time.process_time() - cpu_begin

        begin, cpu_begin = time.perf_counter(), time.process_time()
        score = scored(state, task, until, name=self.config.score, beta=self.config.beta,
                       advance=advance)
        Log(self.out / LOG, state.iteration, self.earlier_seconds).spend(
            state.iteration, time.perf_counter() - begin - trained,
            time.process_time() - cpu_begin - trained_cpu)
        return score

    def remove(
        self, number: int, state: TrainState, score: Tensor, count: int, done: list[Round]
    ) -> None:
        """Removes all but `count` Gaussians, saves the state and appends the round to `done`."""
        n, before = len(state.splats), validation_psnr(state, self.task)
        remove(state, survivors(score, count))
        save_state(self.out / _name(number + 1), state)
        done.append(Round(
            state.iteration, n, len(state.splats), 1 - len(state.splats) / n, before,
            validation_psnr(state, self.task)))
        logger.info("round %d removes %d of %d Gaussians", number + 1, n - len(state.splats), n)
        self.write(done)
        (self.out / _name(number)).unlink(missing_ok=True)

    def write(self, done: list[Round]) -> None:
        """Writes the list of rounds, whole or not at all."""
        rows = [dataclasses.asdict(one) for one in done]
        write_bytes(self.out / ROUNDS, json.dumps(rows, indent=1).encode())

    def read(self) -> list[Round]:
        """Returns the list of rounds; empty where the state that it leads to is missing."""
        path = self.out / ROUNDS
        rows = read_json(path) if path.exists() else []
        there = (self.out / _name(len(rows))).exists()
        return [Round(**row) for row in rows] if there else []

    def clear(self) -> None:
        """Deletes what only a later run would have needed."""
        for path in (*self.out.glob(_name("*")), self.out / GOOD):
            path.unlink(missing_ok=True)

    def state(self, number: int) -> TrainState:
        """Returns the state in which round `number` is."""
        path = self.out / _name(number)
        return self.load(path) if path.exists() else self.start()


def course_of(config: PruneConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Course:
    """Returns what the rounds need: the state to be pruned, the views, and the steps there are.

    Raises:
        ConfigError: the middle of a run is asked for that took place elsewhere.
    """
    train = inputs.folders["train"]
    origin = ImportRecord.read(train)
    if origin and config.at == "mid":
        raise ConfigError(
            f"at is mid, but the scene was imported from {origin.file}: the middle of its training "
            "is not known.", hint="Prune it with --at end.")
    if origin and origin.doubt:
        ctx.notice(origin.doubt)
    train_config = read_config(train)
    scene = load_scene(inputs, validation=train_config.validation)
    task = load_task(scene, train_config, ctx)
    ctx.notice_idle(train_config.batch_views)
    final = train / "final.safetensors"
    source = train / "mid.safetensors" if config.at == "mid" else final

    def load(path: Path) -> TrainState:
        return saved_state(path, task)

    def begin() -> TrainState:
        return finished_state(read_ply(train / "splats.ply"), task) if origin else load(source)

    start = begin()
    steps = config.recovery
    if steps is None:
        rest = load(final).steps - start.steps if config.at == "mid" else 0
        steps = _recovery(
            config, train_config, task.schedule.epoch(len(task.train)), rest)
    return Course(
        config, task, begin, load, out, ctx, start.iteration,
        start.iteration + steps, seconds_at(train / LOG, start.iteration))


def _recovery(config: PruneConfig, train: RunConfig, epoch: int, rest: int) -> int:
    """Returns how many steps the recovery takes; `rest` are those of training from its middle."""
    if config.at == "mid":  # as many as the unpruned run took, which may have stopped early
        return rest
    return max(train.iterations // _END_RECOVERY, _END_EPOCHS * epoch)


def _name(number: int | str) -> str:
    return f"round-{number}.safetensors"
