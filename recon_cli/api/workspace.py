"""A workspace from Python: each stage is a method, as each is a command.

The methods run what the commands run (`runs`), on the same files: a stage that is up to date is not
run again, an interrupted one is resumed, and both may take turns on one workspace.
"""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from recon_cli.api.results import (
    EvaluateResult,
    ExportResult,
    IngestResult,
    ModelResult,
    SfmResult,
    StageResult,
    View,
)
from recon_cli.api.runs import OpenWorkspace, RunRequest, check_settings, make_options
from recon_cli.config.export import ExportConfig
from recon_cli.config.fields import StageConfig
from recon_cli.config.settings import section_of
from recon_cli.config.stages import (
    ComputeConfig,
    DenoiseConfig,
    EvaluateConfig,
    ImportConfig,
    IngestConfig,
    PruneConfig,
    SfmConfig,
    TrainConfig,
)
from recon_cli.context import TrainCallback
from recon_cli.errors import InputError
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.plan import StageStatus
from recon_cli.progress import NullProgress, Progress
from recon_cli.stages import IMPORT, STAGES, Stage
from recon_cli.workspace import layout
from recon_cli.workspace.paths import refuse_special
from recon_cli.workspace.summaries import (
    DenoiseSummary,
    ImportSummary,
    PruneSummary,
    TrainSummary,
)

if TYPE_CHECKING:  # they import torch
    from recon_cli.api.splats import Splats

R = TypeVar("R", bound=StageResult[Any])

logger = logging.getLogger("recon")


class Workspace:
    """The results of one capture, in a folder.

    Every stage takes its options as keywords, called as the options of its command (`recon train
    --iterations 1000` is `train(iterations=1000)`), or as its config, in which every field counts;
    keywords win over the config. Without either, options come from recon.toml as usual. A stage
    that is up to date is not run, unless `again` is set.

    All raise ReconError, whose `hint` says what to do: ConfigError for an option, InputError for a
    capture, StageError where another stage is missing, ReconstructionError, BackendError,
    WorkspaceError where the folder is in use or full. What was finished before stays.
    """

    def __init__(
        self, path: str | Path, *, config_file: str | Path | None = None,
        settings: Mapping[str, Mapping[str, Any]] | None = None, progress: Progress | None = None,
    ) -> None:
        """Opens a workspace; the folder is made by the first stage.

        Args:
            path: the folder.
            config_file: a TOML file with options, as --config.
            settings: options by section and field, as --set; `compute` has device, backend, threads
                and max_memory.
            progress: opens progress bars; None for none, TqdmProgress() for those of the commands.

        Raises:
            ConfigError: a setting does not exist.
        """
        self.path = Path(path).absolute()
        self._open = OpenWorkspace(
            self.path, None if config_file is None else Path(config_file),
            check_settings(settings or {}), progress or NullProgress(), STAGES)

    def __repr__(self) -> str:
        return f"Workspace({str(self.path)!r})"

    def ingest(
        self, *inputs: str | Path, config: IngestConfig | None = None, again: bool = False,
        **options: Any,
    ) -> IngestResult:
        """Chooses frames from videos, photos or a data set; without `inputs` from the last ones."""
        return self._run(IngestResult, _row("ingest"), config, options, again=again,
                         sources=inputs)

    def denoise(
        self, *, config: DenoiseConfig | None = None, again: bool = False, **options: Any
    ) -> StageResult[DenoiseSummary]:
        """Filters noisy frames and passes the others through."""
        return self._run(StageResult[DenoiseSummary], _row("denoise"), config, options,
                         again=again)

    def sfm(
        self, *, config: SfmConfig | None = None, again: bool = False, **options: Any
    ) -> SfmResult:
        """Estimates cameras and a sparse point cloud; denoise runs first where needed."""
        return self._run(SfmResult, _row("place"), config, options, again=again)

    def train(
        self, *, config: TrainConfig | None = None, again: bool = False, from_import: bool = False,
        callbacks: Sequence[TrainCallback] = (), **options: Any,
    ) -> ModelResult[TrainSummary]:
        """Fits Gaussians; denoise and sfm run first where needed.

        `from_import` trains the imported scene further; `callbacks` are called between steps. For
        pruning midway, as `recon train --prune` does, call `prune(at="mid")` next.
        """
        return self._run(
            ModelResult[TrainSummary], _row("train"), config, options, again=again,
            from_import=from_import, callbacks=callbacks)

    def import_scene(
        self, file: str | Path | None = None, *, config: ImportConfig | None = None,
        again: bool = False, **options: Any,
    ) -> ModelResult[ImportSummary]:
        """Imports a splat file instead of training; without `file` the last one."""
        return self._run(
            ModelResult[ImportSummary], IMPORT, config, options, again=again,
            sources=() if file is None else (file,))

    def prune(
        self, *, config: PruneConfig | None = None, again: bool = False,
        callbacks: Sequence[TrainCallback] = (), **options: Any,
    ) -> ModelResult[PruneSummary]:
        """Removes the least important Gaussians and fine-tunes the rest."""
        return self._run(
            ModelResult[PruneSummary], _row("prune"), config, options, again=again,
            callbacks=callbacks)

    def evaluate(
        self, *, config: EvaluateConfig | None = None, again: bool = False, **options: Any
    ) -> EvaluateResult:
        """Scores every model on the held-out views."""
        return self._run(EvaluateResult, _row("evaluate"), config, options, again=again)

    def export(
        self, *, config: ExportConfig | None = None, again: bool = False, **options: Any
    ) -> ExportResult:
        """Writes a .ply and the formats of `format`, with commas between, and verifies each."""
        result = self._run(ExportResult, _row("export"), config, options, again=again)
        return dataclasses.replace(result, files={
            check.row.part: result.folder / check.manifest.run.summary["file"]
            for check in plan.check_parts(self._job(), "export")
            if check.manifest and check.fresh})

    def report(self, out: str | Path | None = None) -> Path:
        """Writes an HTML report and returns its path; by default report.html in the workspace."""
        from recon_cli.report.build import write_report

        return write_report(self._job(), None if out is None else Path(out))

    def status(self) -> tuple[StageStatus, ...]:
        """Returns how every stage stands; nothing is changed."""
        return plan.status(self._job())

    def splats(self, model: str = "auto") -> Splats:
        """Returns the Gaussians: pruned, base, or auto for pruned ones where they are fresh."""
        from recon_cli.api.splats import Splats
        from recon_cli.flythrough.trained_scene import open_trained_scene

        if model not in ("auto", "base", "pruned"):
            raise InputError(f"There is no model {model!r}.", hint="Ask for auto, base or pruned.")
        trained = open_trained_scene(self._job(), model)
        return Splats.from_scene(trained.splats, up="z" if trained.z_up else None)

    def views(self, split: str = "train", *, max_size: int | None = None) -> list[View]:
        """Returns the undistorted views with their original pixels.

        Args:
            split: train, validation or test; gradients may come from train alone, decisions from
                validation, and scores from test.
            max_size: longest side in pixels; None for that of the training.

        Raises:
            InputError: there is no such split.
            StageError: ingest, sfm or place is missing or stale.
        """
        from recon_cli.io.training_scene import load_scene
        from recon_cli.io.views import load_views
        from recon_cli.train.fit.train_data import read_config
        from recon_cli.train.plan import QUALITIES

        if split not in ("train", "validation", "test"):
            raise InputError(f"There is no split {split!r}.",
                             hint="Ask for train, validation or test.")
        job, config = self._open.open_job(TrainConfig)
        plan.require(job.inspect(), ("ingest", "place"), "views")
        folder = job.workspace.folder
        trained = job.workspace.manifest("train") is not None
        run_config = read_config(folder("train")) if trained else None
        scene = load_scene(
            {name: folder(name) for name in ("ingest", "place")},
            validation=config.validation if run_config is None else run_config.validation)
        size = max_size or (run_config.max_size if run_config else
                            config.max_size or QUALITIES[config.quality].max_size)
        return [View(view.name, view.camera, view.image, view.mask) for view in load_views(
            getattr(scene, split), size, "left out", logger.warning)]

    def _job(self) -> Job:
        return self._open.open_job(ComputeConfig)[0]

    def _run(
        self, kind: type[R], row: Stage, config: StageConfig | None, options: dict[str, Any], *,
        again: bool, sources: Sequence[str | Path] = (), from_import: bool = False,
        callbacks: Sequence[TrainCallback] = (),
    ) -> R:
        """Brings one stage up to date and returns its result."""
        section = section_of(row.config)
        paths = tuple(Path(source) for source in sources)
        for path in paths:
            refuse_special(path)
        table = tuple(row if other.name == row.name else other for other in STAGES)
        stages = tuple(other.name for other in table if other.verb == row.verb)
        request = RunRequest(
            row.verb, stages, paths, options=make_options(config, options, section),
            again=again, from_import=from_import, callbacks=tuple(callbacks), table=table)
        with _collecting_notices() as notices, _keeping_threads(row):
            outcomes = self._open.run(request)
        outcome = next(one for one in reversed(outcomes) if one.stage == row.name)
        run = outcome.manifest.run
        earlier = () if outcome.ran else run.summary.get("notices") or ()
        return kind(
            stage=row.name, folder=layout.Workspace(self.path).folder(row.name),
            ran=any(one.ran for one in outcomes if one.stage.partition(".")[0] in stages),
            seconds=sum(one.manifest.run.seconds for one in outcomes if one.stage in stages),
            summary=row.summary.from_json(run.summary),
            notices=(*notices, *earlier))


def _row(name: str) -> Stage:
    return next(row for row in STAGES if row.name == name)


class _Notices(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


@contextmanager
def _collecting_notices() -> Iterator[list[str]]:
    """Yields a list that gets each notice of the block."""
    handler = _Notices()
    logger.addHandler(handler)
    try:
        yield handler.lines
    finally:
        logger.removeHandler(handler)


@contextmanager
def _keeping_threads(row: Stage) -> Iterator[None]:
    """Gives torch the number of threads again that it had before a stage that renders."""
    if not row.renders:
        yield
        return
    from recon_cli.api.rendering import keeping_threads

    with keeping_threads():
        yield
