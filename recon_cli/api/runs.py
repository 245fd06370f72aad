"""Runs of stages in a workspace, as the command line and Python ask for them.

Options are those of a verb (`base`) < recon.toml < a config file < settings < `options` < `forced`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recon_cli.config import settings as layers
from recon_cli.config.fields import StageConfig
from recon_cli.config.settings import C, Settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.context import TrainCallback
from recon_cli.deadline import Deadline
from recon_cli.errors import ConfigError
from recon_cli.pipeline import plan
from recon_cli.pipeline.continuation import Start
from recon_cli.pipeline.execute import Job, Outcome
from recon_cli.pipeline.plan import Target
from recon_cli.progress import NullProgress, Progress
from recon_cli.stages import IMPORT, STAGES, Stage
from recon_cli.workspace.layout import Workspace


@dataclass(frozen=True)
class RunRequest:
    """Stages to bring up to date, one after the other."""

    verb: str  # is named to other processes that want the workspace
    stages: tuple[str, ...]
    sources: tuple[Path, ...] = ()  # the user's files, for a stage that reads any
    base: Settings = field(default_factory=dict)  # defaults, over which every file wins
    options: Settings = field(default_factory=dict)  # win over every file
    forced: Settings = field(default_factory=dict)  # win over everything
    again: bool = False  # also what is up to date, and without unfinished work
    from_import: bool = False  # training continues the imported scene
    callbacks: tuple[TrainCallback, ...] = ()  # called while Gaussians are trained
    table: tuple[Stage, ...] = ()  # of all stages; empty for that of the workspace
    deadline: Deadline = field(default_factory=Deadline)  # for what stages may do without


@dataclass(frozen=True)
class OpenWorkspace:
    """A workspace, and the settings that hold for all that is done with it."""

    path: Path
    config_file: Path | None = None  # besides the recon.toml in it
    settings: Settings = field(default_factory=dict)  # win over both files
    progress: Progress = field(default_factory=NullProgress)
    table: tuple[Stage, ...] = STAGES

    def read_explicit(self) -> Settings:
        """Returns what files and settings set now; ConfigError if a value cannot be used."""
        return layers.read_explicit(self.path, self.config_file, self.settings)

    def open_job(self, kind: type[C], options: Settings | None = None) -> tuple[Job, C]:
        """Returns a job for what runs no stage, and the options of one config class."""
        explicit = self.read_explicit()
        values = layers.merge([explicit, options or {}])
        job = Job(Workspace(self.path), explicit, layers.build(ComputeConfig, values),
                  self.progress, table=self.table)
        return job, layers.build(kind, values)

    def resolve(self, request: RunRequest) -> dict[str, StageConfig]:
        """Returns the options of each stage of a request by section, and those of compute last.

        ConfigError if a value cannot be used.
        """
        return self._resolve(request, self.read_explicit())

    def run(
        self, request: RunRequest, report: Callable[[Outcome], None] = lambda _outcome: None
    ) -> tuple[Outcome, ...]:
        """Brings the stages of a request up to date, and those that they need and may start.

        `report` gets each stage once it is done. Errors are those of `pipeline.plan.run`.
        """
        explicit = self.read_explicit()
        configs = self._resolve(request, explicit)
        compute = configs["compute"]
        assert isinstance(compute, ComputeConfig)
        job = Job(Workspace(self.path), explicit, compute, self.progress, report,
                  request.table or self.table, request.callbacks, deadline=request.deadline)
        start = Start.IMPORTED if request.from_import else Start.AUTO
        targets = [
            Target(row.name, configs[layers.section_of(row.config)],
                   request.sources if row.input_metavar else (),
                   start if row.name == IMPORT.name else Start.AUTO)
            for row in self._rows(request)]
        return plan.run(job, request.verb, targets, again=request.again)

    def _resolve(self, request: RunRequest, explicit: Settings) -> dict[str, StageConfig]:
        values = layers.merge([request.base, explicit, request.options, request.forced])
        kinds: Sequence[type[StageConfig]] = [
            *(row.config for row in self._rows(request)), ComputeConfig]
        return {layers.section_of(kind): layers.build(kind, values) for kind in kinds}

    def _rows(self, request: RunRequest) -> list[Stage]:
        """Returns the stages of a request, in the order of the table."""
        return [row for row in request.table or self.table if row.name in request.stages]


def check_settings(settings: Mapping[str, Mapping[str, Any]]) -> Settings:
    """Returns a copy of settings; ConfigError if a section or field does not exist."""
    for section, values in settings.items():
        if not isinstance(values, Mapping):
            raise ConfigError(f"settings has {section}: {values!r}, needed are fields and values.",
                              hint='For example {"train": {"iterations": 1000}}.')
        layers.check_names(section, values, where="settings")
    return {section: dict(values) for section, values in settings.items()}


def make_options(config: StageConfig | None, options: dict[str, Any], section: str) -> Settings:
    """Returns the settings of a config, every field of it, with `options` on top of it.

    Without a config those of `options` alone. ConfigError if the section has no such option.
    """
    layers.check_names(section, options, where="The call")
    settled = config and config.settle()
    fields = {} if settled is None else {
        item.name: getattr(settled, item.name) for item in dataclasses.fields(settled)}
    return {section: {**fields, **options}}
