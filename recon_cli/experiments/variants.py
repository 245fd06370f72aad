"""Variants of training, by name and from the command line, and a run of one of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from recon_cli.config.stages import PruneConfig, RunConfig

_MID = RunConfig().mid  # where `recon train --prune` branches off
# options that all recipes of a benchmark share, or that have no effect here
_SHARED = {"iterations", "seed", "max_size", "quality", "minutes", "early_stop", "mid", "blocks",
           "jobs", "on"}


@dataclass(frozen=True)
class MidPrune:
    """Pruning in mid-training."""

    at: float  # fraction of the run's steps
    config: PruneConfig  # which Gaussians are removed; its `at` and `recovery` are ignored
    restarts: bool = True  # the learning rates restart afterwards, as in `recon prune`


@dataclass(frozen=True)
class Variant:
    """One way to train."""

    name: str  # in files and on the command line
    label: str  # in tables
    options: Mapping[str, Any] = field(default_factory=dict)  # that differ from the base
    prune: MidPrune | None = None
    tries_degree: bool = False  # a trial decides on the SH degree, as in `recon train`

    def config(self, base: RunConfig, *, iterations: int, seed: int) -> RunConfig:
        """Returns the options of one run; ConfigError for a value out of range."""
        return dataclasses.replace(base, **{**self.options, "iterations": iterations, "seed": seed})

    def record(self) -> dict[str, Any]:
        """Returns everything that affects the result, as JSON."""
        prune = self.prune and {
            "at": self.prune.at, "restarts": self.prune.restarts,
            **self.prune.config.hashed_fields()}
        return {"name": self.name, "options": dict(self.options), "prune": prune,
                "tries_degree": self.tries_degree}


@dataclass(frozen=True)
class TrainingRun:
    """One variant with one seed for a number of steps."""

    variant: Variant
    base: RunConfig  # options that all variants share
    iterations: int
    seed: int

    @property
    def config(self) -> RunConfig:
        """The options of this run."""
        return self.variant.config(self.base, iterations=self.iterations, seed=self.seed)


# LightGaussian, whose score the paper takes over, removes 60% at step 20,000 of 30,000.
_PAPER_PRUNE = MidPrune(
    2 / 3, PruneConfig(ratio=0.6, score="paper", at="mid", rounds=1), restarts=False)

# 3DGS has no optional parts; the training images are chosen for all variants alike
_PLAIN = {**RunConfig.plain_values(), "densify": "reference", "max_radius": 0.0}
REFERENCE = Variant("reference", "3DGS", _PLAIN)
PAPER = Variant("paper", "paper", _PLAIN, _PAPER_PRUNE)
BUDGET = Variant("budget", "ours", {"densify": "budget"}, tries_degree=True)
BUDGET_PRUNED = Variant(
    "budget-pruned", "ours pruned", {"densify": "budget"},
    MidPrune(_MID, PruneConfig(at="mid")), tries_degree=True)
