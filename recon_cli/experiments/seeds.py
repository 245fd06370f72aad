"""`recon eval --seeds N`: mean and deviation of the scores of a workspace's models over seeds.

Each further seed is a workspace below `seeds/` with hard links to the frames and cameras, so that
it resumes like any other. seeds.json lies beside the stages: no stage becomes stale.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.config import settings as layers
from recon_cli.config.fields import StageConfig
from recon_cli.config.stages import EvaluateConfig, TrainConfig
from recon_cli.errors import StageError, WorkspaceError
from recon_cli.evaluation.comparison import ScoredModel, read_workspace_scores
from recon_cli.evaluation.intervals import Spread
from recon_cli.evaluation.scores import Table
from recon_cli.experiments.outputs import Result
from recon_cli.pipeline import plan
from recon_cli.pipeline.continuation import Start
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.freshness import WorkspaceCheck
from recon_cli.pipeline.plan import Target
from recon_cli.stages import stage
from recon_cli.workspace.layout import SEEDS, Workspace, disk_errors, remove

_FORMATS = {"psnr_db": ".2f", "ssim": ".4f", "gaussians": ",.0f", "train_seconds": ".0f"}
_SEEDED = ("train", "prune")

logger = logging.getLogger("recon")

Figures = Mapping[str, tuple[float, ...]]  # values over the seeds, by name of the figure


@dataclass(frozen=True)
class SeedScores:
    """Scores of one workspace over seeds."""

    seeds: tuple[int, ...]
    models: Mapping[str, Figures]
    difference: Figures  # pruned minus base; empty where nothing is pruned
    kinds: Mapping[str, str]  # the name of each model in tables

    def result(self) -> Result:
        """Returns mean and deviation of every figure, and the content of seeds.json."""
        def spreads(figures: Figures) -> dict[str, Any]:
            return {name: {"values": list(values), **dataclasses.asdict(
                Spread.from_values(values))}
                    for name, values in figures.items()}

        def cells(figures: Figures, sign: str = "") -> list[str]:
            return [Spread.from_values(values).text(sign + _FORMATS[name])
                    for name, values in figures.items()]

        rows = [(self.kinds[name], *cells(figures)) for name, figures in self.models.items()]
        if self.difference:
            rows.append(("compact minus original", *cells(self.difference, "+")))
        return Result(
            {"seeds": list(self.seeds),
             "models": {name: spreads(figures) for name, figures in self.models.items()},
             "pruned_minus_base": spreads(self.difference)},
            f"Mean and standard deviation over the seeds {', '.join(map(str, self.seeds))}, on the "
            "same held-out views",
            [Table(("model", "PSNR dB", "SSIM", "Gaussians", "train s"), rows)])

    def text(self, form: str) -> str:
        """Returns it as text, markdown, csv, latex or json."""
        if form != "csv":
            return self.result().format(form)
        rows = [f"{name},{seed}," + ",".join(f"{values[i]:.6f}" for values in figures.values())
                for name, figures in self.models.items() for i, seed in enumerate(self.seeds)]
        return "\n".join([f"model,seed,{','.join(_FORMATS)}", *rows])


def score_seeds(job: Job, config: EvaluateConfig, count: int) -> SeedScores:
    """Trains a workspace's models with the next seeds, writes seeds.json and returns the scores.

    Raises:
        StageError: there is no fresh model, or it was imported.
        WorkspaceError: the workspace is in use, full, or was changed meanwhile.
    """
    plan.run(job, "eval", [Target("evaluate", config)])
    root = job.workspace.root
    inspection = job.inspect()
    plan.require(inspection, stage("train").needs, "eval --seeds", fresh=True)  # it trains on them
    configs: dict[str, StageConfig] = {}
    for name in _SEEDED:
        check = inspection.check(name)
        if check.fresh and check.manifest:
            configs[name] = inspection.config(check.row, check.manifest.key)
    _refuse_import(inspection, root)
    train = configs.pop("train")
    assert isinstance(train, TrainConfig)
    seeds = tuple(range(train.seed, train.seed + count))
    with disk_errors(root, "training with other seeds"), job.workspace.writing("eval --seeds"):
        by_seed = [read_workspace_scores(root.name, job.workspace.folder("evaluate"))]
        for seed in seeds[1:]:
            logger.info("seed %d", seed)
            by_seed.append(_score_seed(job, {
                "train": dataclasses.replace(train, seed=seed), **configs, "evaluate": config},
                seed))
        scores = _collect(seeds, by_seed)
        scores.result().save(root, "seeds")
    return scores


def _refuse_import(inspection: WorkspaceCheck, root: Path) -> None:
    """Raises StageError where the scene was imported: no seed of this program made it."""
    manifest = inspection.check("train").manifest
    source = manifest.run.summary.get("imported_from") if manifest else None
    if source:
        raise StageError(
            f"{root} holds a scene that was imported from {source}: with another seed, all of it "
            "would be trained here.", hint="Give a workspace without an imported scene with -w.")


def _score_seed(job: Job, configs: Mapping[str, StageConfig], seed: int) -> list[ScoredModel]:
    """Runs stages, in their order, with another seed and returns the scores of its models."""
    workspace = Workspace(job.workspace.root / SEEDS / str(seed))
    for name in dict.fromkeys(("ingest", "denoise", *stage("train").needs)):
        source, target = job.workspace.folder(name), workspace.folder(name)
        remove(target)
        if source.exists():
            workspace.root.mkdir(parents=True, exist_ok=True)
            shutil.copytree(source, target, copy_function=_link)
    seeded = dataclasses.replace(
        job, workspace=workspace,
        settings=layers.merge([job.settings, {"train": {"seed": seed}}]))
    plan.run(seeded, "eval --seeds", [
        Target(name, value, start=Start.ANEW) for name, value in configs.items()])
    return read_workspace_scores(f"seed {seed}", workspace.folder("evaluate"))


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # not every file system has hard links
        shutil.copy2(source, target)


def _collect(seeds: tuple[int, ...], by_seed: Sequence[Sequence[ScoredModel]]) -> SeedScores:
    """Returns the scores of all seeds; WorkspaceError if they are of different views."""
    if len({scored.digest for models in by_seed for scored in models}) != 1:
        raise WorkspaceError(
            "The seeds were scored on different views.",
            hint="The workspace was changed meanwhile: run the same command again.")
    models = {first.model: {
        name: tuple(float(getattr(scored.score, name)) for models in by_seed
                    for scored in models if scored.model == first.model)
        for name in _FORMATS} for first in by_seed[0]}
    difference = {name: tuple(
        ours - theirs for ours, theirs in zip(
            models["pruned"][name], models["base"][name], strict=True))
        for name in _FORMATS if {"base", "pruned"} <= models.keys()}
    return SeedScores(seeds, models, difference, {one.model: one.kind for one in by_seed[0]})
