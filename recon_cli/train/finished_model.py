"""A finished model in its folder: scored, pruned, exported, or continued by a longer training.

A continued run takes steps of their own after the end of that model (`ContinuedSchedule`), and
keeps the parts of it: no trial is repeated. What is known of an imported scene stays with the
result, since whoever trained it may have seen the held-out views.
"""

from __future__ import annotations

import dataclasses
import json
import logging
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from recon_cli.config.stages import RunConfig, TrainConfig
from recon_cli.context import StageContext
from recon_cli.errors import ConfigError, name_command
from recon_cli.scene.splats import Splats, with_rows
from recon_cli.splats.ply import read_ply
from recon_cli.train.fit.initialize import begin_state, restore_state
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.state import DensificationStats, TrainState, read_progress
from recon_cli.train.fit.task import Task
from recon_cli.train.fit.train_data import read_config
from recon_cli.train.masks import read_summary
from recon_cli.train.parts.table import PARTS, model_parts
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.manifest import SCENE
from recon_cli.workspace.records import ImportRecord
from recon_cli.workspace.summaries import LogRow, MovingSummary, TrainPlan

FINAL = "final.safetensors"
_FEW = 0.1  # of the steps before; fewer do not make good what the rates lose that start anew


logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class FinishedModel:
    """A model as train, or import, left it. What is not read at once is read once, when asked for.

    FormatError is raised by all that reads a file that is damaged or of another version.
    """

    folder: Path
    config: RunConfig  # options of its run
    import_record: ImportRecord | None  # of the scene that the first run began with, if any

    @staticmethod
    def read(folder: Path) -> FinishedModel:
        """Returns the model in a finished folder of train or import."""
        return FinishedModel(folder, read_config(folder), ImportRecord.read(folder))

    @property
    def warnings(self) -> list[str]:
        """The caveats of every score, where its first run began with an imported scene."""
        return self.import_record.warnings() if self.import_record else []

    @property
    def trained(self) -> bool:
        """Whether it was trained here as one model, at least at last."""
        return (self.folder / FINAL).exists()

    @cached_property
    def _progress(self) -> tuple[int, int]:
        return read_progress(self.folder / FINAL) if self.trained else (0, len(self.read_splats()))

    @property
    def steps(self) -> int:
        """Steps taken so far, not counting those of another program."""
        return self._progress[0]

    @property
    def gaussians(self) -> int:
        """Count."""
        return self._progress[1]

    @cached_property
    def plan(self) -> TrainPlan | None:
        """The decisions before its first step; None where it was not planned here."""
        return TrainPlan.read(self.folder) if (self.folder / TrainPlan.FILE).exists() else None

    @cached_property
    def moving(self) -> MovingSummary | None:
        """What its training masked; None where it masked nothing."""
        return read_summary(self.folder)

    def read_splats(self) -> Splats:
        """Returns its Gaussians."""
        return read_ply(self.folder / SCENE)

    def choose_parts(self, asked: TrainConfig) -> dict[str, Any]:
        """Returns the parts of the continued model, by the names of their options.

        A trained one keeps its own. To an imported scene those are added that were asked for.

        Raises:
            ConfigError: the options contradict the imported scene.
        """
        if self.trained:
            return model_parts(self.config)
        for part in PARTS:
            if part.attach and part.is_on(asked):
                raise ConfigError(
                    f"{part.name} is on, but an imported scene keeps its Gaussians: others are "
                    "only added to the points of sfm.", hint=f"Leave out --{part.name}.")
        if asked.max_gaussians is not None and asked.max_gaussians < self.gaussians:
            raise ConfigError(
                f"max_gaussians is {asked.max_gaussians:,}, but the imported scene has "
                f"{self.gaussians:,} Gaussians.",
                hint=f"Leave out --max-gaussians, and let {name_command('prune')} lower the count.")
        own = model_parts(self.config)
        return {name: own[name] if value in (None, "auto") else value
                for name, value in model_parts(asked).items()}

    def write_inherited_files(self, schedule: Schedule, out: Path, ctx: StageContext) -> None:
        """Writes the inherited files into the result's folder, and tells the user of the start."""
        if self.trained:
            logger.info("training continues from step %s of the finished run", f"{self.steps:,}")
            if schedule.steps < _FEW * self.steps:
                ctx.notice(f"{schedule.steps:,} more steps than {self.steps:,} are too few to gain "
                           "anything: learning rates start anew")
            write_bytes(out / LogRow.FILE, _renumbered(LogRow.read_all(self.folder / LogRow.FILE)))
        record = self.import_record
        if record is None:
            return
        if not self.trained:
            logger.info("training starts from the scene imported from %s", record.file)
            if record.doubt:
                ctx.notice(record.doubt)
        dataclasses.replace(record, doubt="").write(out)  # it has been fitted to the views

    def first_state(self, task: Task) -> TrainState:
        """Returns the state before the first further step.

        Raises:
            FormatError: the checkpoint is truncated or of another version.
        """
        config = task.schedule.config
        if not self.trained:
            splats = self.read_splats().with_degree(config.sh_degree)
            splats.sh_rest = with_rows(splats.sh_rest, len(splats))  # each may get harmonics
            return begin_state(splats, task)
        state = restore_state(self.folder / FINAL, task)
        state.iteration = state.steps
        state.skipped_phase, state.validation_history = None, []  # it may stop early again
        state.gathered = DensificationStats.zeros(len(state.splats), task.device)
        state.first_count = len(state.splats)
        return state


def _renumbered(rows: tuple[LogRow, ...]) -> bytes:
    """Returns the lines of a log that counts the steps taken, also after an early stop."""
    lines, skipped = [], 0
    for row in rows:
        own = dataclasses.replace(row, iteration=row.iteration - skipped, skip_to_iteration=None)
        lines.append(json.dumps(own.to_json()) + "\n")
        if row.skip_to_iteration is not None:
            skipped += row.skip_to_iteration - row.iteration
    return "".join(lines).encode()
