"""Variants of training, by name and from the command line, and a run of one of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from recon_cli.config.settings import parse_assignment
from recon_cli.config.stages import PruneConfig, RunConfig
from recon_cli.errors import ConfigError

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
_PLAIN = {"densify": "reference", "far": "off", "stereo": "off", "exposure": "off",
          "depth": "off", "max_radius": 0.0}
REFERENCE = Variant("reference", "3DGS", _PLAIN)
PAPER = Variant("paper", "paper", _PLAIN, _PAPER_PRUNE)
BUDGET = Variant("budget", "ours", {"densify": "budget"}, tries_degree=True)
BUDGET_PRUNED = Variant(
    "budget-pruned", "ours pruned", {"densify": "budget"},
    MidPrune(_MID, PruneConfig(at="mid")), tries_degree=True)
KNOWN: dict[str, Variant] = {variant.name: variant for variant in (
    REFERENCE, PAPER, BUDGET, BUDGET_PRUNED,
    Variant("budget-l1", "budget-l1", {"densify": "budget", "ssim_weight": 0.0}, tries_degree=True),
    Variant("budget-degree-1", "budget-degree-1", {"densify": "budget", "sh_degree": 1}))}


def parse_recipe(text: str) -> Variant:
    """Returns the variant of `NAME` or `NAME+FIELD=VALUE+...`; ConfigError for unknown names."""
    name, *changes = text.split("+")
    if name not in KNOWN:
        raise ConfigError(
            f"There is no recipe {name!r}.", hint="Known are " + ", ".join(KNOWN) + ".")
    known, options = KNOWN[name], {}
    for change in changes:
        options.update(parse_assignment(f"train.{change}")["train"])
    if fixed := _SHARED & options.keys():
        raise ConfigError(
            f"The recipe {text!r} sets {', '.join(sorted(fixed))}, which all recipes share.",
            hint="Use --iterations, --seeds and --max-size.")
    variant = Variant(
        text, text if changes else known.name, {**known.options, **options}, known.prune,
        known.tries_degree and "sh_degree" not in options)
    variant.config(RunConfig(), iterations=1, seed=0)  # refuses values out of range
    return variant


def parse_recipes(texts: Sequence[str]) -> tuple[Variant, ...]:
    """Returns the variants of comma-separated lists; ConfigError if empty or with duplicates."""
    words = [word.strip() for text in texts for word in text.split(",") if word.strip()]
    if not words:
        raise ConfigError("No recipe was given.", hint="Try --recipes reference,budget.")
    twice = [word for word in words if words.count(word) > 1]
    if twice:
        raise ConfigError(f"The recipe {twice[0]} appears twice.", hint="Remove one of them.")
    return tuple(parse_recipe(word) for word in words)
