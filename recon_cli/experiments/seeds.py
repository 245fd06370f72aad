"""`recon eval --seeds N`: how far the scores move where chance falls otherwise.

Each further seed is a workspace of its own below `seeds/`, whose frames and cameras are hard links
to those of the workspace, so that an interrupted run goes on where it was and disk space goes to
models alone. seeds.json lies beside the stages, so that nothing turns stale.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import shutil
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from recon_cli.config import settings as layers
from recon_cli.config.fields import StageConfig
from recon_cli.config.stages import EvaluateConfig, TrainConfig
from recon_cli.errors import WorkspaceError
from recon_cli.evaluation.comparison import Entry, of_workspace
from recon_cli.evaluation.reference_views import LABELS
from recon_cli.evaluation.tables import Table
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.pipeline.plan import Target
from recon_cli.stages import stage
from recon_cli.workspace import atomic
from recon_cli.workspace.layout import SEEDS, Workspace, disk_errors, remove

RESULT = "seeds.json"
_FIGURES = ("psnr_db", "ssim", "gaussians", "train_seconds")
_SEEDED = ("train", "prune")

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Spread:
    """A figure over seeds.

    Attributes:
        values: one by seed.
        mean: of them.
        deviation: standard deviation of a sample (n - 1); None for one seed.
    """

    values: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean over the seeds."""
        return statistics.fmean(self.values)

    @property
    def deviation(self) -> float | None:
        """Standard deviation over the seeds."""
        return statistics.stdev(self.values) if len(self.values) > 1 else None

    def shown(self, form: str) -> str:
        """Returns mean and deviation."""
        if self.deviation is None:
            return f"{self.mean:{form}}"
        return f"{self.mean:{form}} ± {self.deviation:{form}}"


@dataclass(frozen=True)
class OverSeeds:
    """Scores of one workspace over seeds.

    Attributes:
        seeds: that were trained with.
        models: figures by name, by model.
        difference: pruned minus base, figures by name; empty where nothing is pruned.
    """

    seeds: tuple[int, ...]
    models: Mapping[str, Mapping[str, Spread]]
    difference: Mapping[str, Spread]

    def table(self) -> Table:
        """Returns mean and deviation of every figure."""
        rows = [(LABELS[name], *_cells(found, signed=False))
                for name, found in self.models.items()]
        if self.difference:
            rows.append(("pruned minus base", *_cells(self.difference, signed=True)))
        return Table(("model", "PSNR dB", "SSIM", "Gaussians", "train s"), tuple(rows))

    def record(self) -> dict[str, Any]:
        """Returns it as seeds.json keeps it."""
        def plain(found: Mapping[str, Spread]) -> dict[str, Any]:
            return {name: {"values": list(one.values), "mean": one.mean,
                           "deviation": one.deviation} for name, one in found.items()}

        return {"seeds": list(self.seeds),
                "models": {name: plain(found) for name, found in self.models.items()},
                "pruned_minus_base": plain(self.difference)}

    def csv(self) -> str:
        """Returns one row for each model and seed."""
        rows = [f"{name},{seed}," + ",".join(f"{one.values[place]:.6f}" for one in found.values())
                for name, found in self.models.items() for place, seed in enumerate(self.seeds)]
        return "\n".join([f"model,seed,{','.join(_FIGURES)}", *rows])

    def text(self, form: str) -> str:
        """Returns it in one of `command.FORMS`."""
        if form == "json":
            return json.dumps(self.record(), indent=1)
        table = self.table()
        if form == "latex":
            return table.latex().rstrip()
        if form == "csv":
            return self.csv()
        note = (f"Mean and standard deviation over the seeds {', '.join(map(str, self.seeds))}, "
                "on the same held-out views.")
        shown = table.markdown() if form == "markdown" else table.text(rule=True) + "\n"
        return f"{shown}\n{note}"


def over_seeds(job: Job, config: EvaluateConfig, count: int) -> OverSeeds:
    """Trains a workspace's models with further seeds, writes seeds.json and returns the scores.

    The first seed is that of the workspace, the others follow it.

    Args:
        job: whose workspace holds a trained model.
        config: how to score.
        count: of seeds, at least one.

    Raises:
        StageError: there is no fresh model.
        WorkspaceError: the workspace is in use, full, or was changed meanwhile.
    """
    plan.run(job, "eval", [Target("evaluate", config)])
    root = job.workspace.root
    look = job.inspect()
    configs: dict[str, StageConfig] = {}
    for name in _SEEDED:
        check = look.check(name)
        if check.fresh and check.manifest:
            configs[name] = look.config(check.row, check.manifest.basis)
    train = configs.pop("train")
    assert isinstance(train, TrainConfig)
    seeds = tuple(range(train.seed, train.seed + count))
    with disk_errors(root, "training with other seeds"), job.workspace.writing("eval --seeds"):
        found = [of_workspace(root.name, job.workspace.folder("evaluate"))]
        for seed in seeds[1:]:
            logger.info("seed %d", seed)
            seeded = {"train": dataclasses.replace(train, seed=seed), **configs}
            found.append(_with_seed(job, {**seeded, "evaluate": config}, seed))
        result = _together(seeds, found)
        atomic.write_json(root / RESULT, result.record())
    return result


def _with_seed(job: Job, configs: Mapping[str, StageConfig], seed: int) -> list[Entry]:
    """Returns the scores of a workspace's models, trained with another seed.

    Args:
        job: of the workspace.
        configs: of the stages to run, in their order.
        seed: of the training.
    """
    workspace = Workspace(job.workspace.root / SEEDS / str(seed))
    _link_upstream(job.workspace, workspace)
    seeded = dataclasses.replace(
        job, workspace=workspace,
        settings=layers.merge([job.settings, {"train": {"seed": seed}}]))
    plan.run(seeded, "eval --seeds", [Target(name, one) for name, one in configs.items()])
    return of_workspace(f"seed {seed}", workspace.folder("evaluate"))


def _link_upstream(source: Workspace, target: Workspace) -> None:
    """Lays what training reads, as it is now, into another workspace."""
    for name in dict.fromkeys(("ingest", "denoise", *stage("train").needs)):
        remove(target.folder(name))
        if source.folder(name).exists():
            target.root.mkdir(parents=True, exist_ok=True)
            shutil.copytree(source.folder(name), target.folder(name), copy_function=_link)


def _link(source: str, target: str) -> None:
    try:
        os.link(source, target)
    except OSError:  # not every file system has hard links
        shutil.copy2(source, target)


def _together(seeds: Sequence[int], found: Sequence[Sequence[Entry]]) -> OverSeeds:
    """Returns the scores of all seeds.

    Raises:
        WorkspaceError: they were held against different views.
    """
    if len({entry.truth for entries in found for entry in entries}) != 1:
        raise WorkspaceError(
            "The seeds were held against different views.",
            hint="Something changed the workspace meanwhile: run the same command again.")
    models = {entry.model: {
        key: Spread(tuple(float(getattr(one.score, key)) for entries in found
                          for one in entries if one.model == entry.model))
        for key in _FIGURES} for entry in found[0]}
    difference = {}
    if {"base", "pruned"} <= models.keys():
        difference = {key: Spread(tuple(
            ours - theirs for ours, theirs in zip(
                models["pruned"][key].values, models["base"][key].values, strict=True)))
            for key in _FIGURES}
    return OverSeeds(tuple(seeds), models, difference)


def _cells(found: Mapping[str, Spread], *, signed: bool) -> list[str]:
    sign = "+" if signed else ""
    forms = {"psnr_db": f"{sign}.2f", "ssim": f"{sign}.4f", "gaussians": f"{sign},.0f",
             "train_seconds": f"{sign}.0f"}
    return [one.shown(forms[key]) for key, one in found.items()]
