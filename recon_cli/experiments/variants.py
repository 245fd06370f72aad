"""Variants of an experiment, and the loop over variants and repeats that all experiments share.

A variant of training is a recipe by name: changes of the training options, and of pruning.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from recon_cli.config.settings import parse_assignment
from recon_cli.config.stages import PruneConfig, RunConfig
from recon_cli.errors import ConfigError

_MID = RunConfig().mid  # where `recon train --prune` branches off
# options that all recipes of a benchmark have in common, or that have no effect here
_SHARED = {"iterations", "seed", "max_size", "quality", "minutes", "early_stop", "mid"}

_Variant = TypeVar("_Variant")
_Repeat = TypeVar("_Repeat")
_Result = TypeVar("_Result")


def run_grid(
    variants: Mapping[str, _Variant], repeats: Sequence[_Repeat],
    measure: Callable[[_Variant, _Repeat], _Result],
) -> dict[str, tuple[_Result, ...]]:
    """Returns what was measured of each variant, by its name, one result for each repeat.

    Repeats are the outer loop: a slow minute of the machine then affects all variants alike.
    """
    results: dict[str, list[_Result]] = {name: [] for name in variants}
    for repeat in repeats:
        for name, variant in variants.items():
            results[name].append(measure(variant, repeat))
    return {name: tuple(by_repeat) for name, by_repeat in results.items()}


@dataclass(frozen=True)
class MidPrune:
    """A removal in mid-training, after which the rest of the run goes on."""

    at: float  # share of the run's steps
    config: PruneConfig  # which Gaussians go; its `at` and `recovery` are those of the run
    # learning rates start anew for the rest, as in `recon prune`; otherwise they just go on
    restarts: bool = True


@dataclass(frozen=True)
class Variant:
    """One way to train."""

    name: str  # for the files and the command line
    label: str  # for the tables
    options: Mapping[str, Any] = field(default_factory=dict)  # that differ from the base
    prune: MidPrune | None = None
    tries_degree: bool = False  # a trial decides on the SH degree, as in `recon train`

    def config(self, base: RunConfig, *, iterations: int, seed: int) -> RunConfig:
        """Returns the options of one run.

        Raises:
            ConfigError: an option has a value that cannot be used.
        """
        return dataclasses.replace(
            base, **{**self.options, "iterations": iterations, "seed": seed})

    def record(self) -> dict[str, Any]:
        """Returns what decides about the outcome, as JSON holds it."""
        prune = self.prune and {
            "at": self.prune.at, "restarts": self.prune.restarts,
            **self.prune.config.hashed_fields()}
        return {"name": self.name, "options": dict(self.options), "prune": prune,
                "tries_degree": self.tries_degree}


# LightGaussian, whose score the paper takes over, removes 60% at step 20,000 of 30,000.
_PAPER_PRUNE = MidPrune(
    2 / 3, PruneConfig(ratio=0.6, score="paper", at="mid", rounds=1), restarts=False)

# 3DGS has Gaussians alone; which pixels are trained on is decided for all variants alike
_PLAIN = {"densify": "reference", "far": "off", "exposure": "off", "poses": "off"}
REFERENCE = Variant("reference", "3DGS", _PLAIN)
PAPER = Variant("paper", "paper", _PLAIN, _PAPER_PRUNE)
BUDGET = Variant("budget", "ours", {"densify": "budget"}, tries_degree=True)
BUDGET_PRUNED = Variant(
    "budget-pruned", "ours pruned", {"densify": "budget"},
    MidPrune(_MID, PruneConfig(at="mid")), tries_degree=True)
KNOWN: dict[str, Variant] = {variant.name: variant for variant in (
    REFERENCE, PAPER, BUDGET, BUDGET_PRUNED,
    Variant("budget-l1", "budget-l1", {"densify": "budget", "ssim_weight": 0.0}, tries_degree=True),
    Variant("budget-degree-1", "budget-degree-1", {"densify": "budget", "sh_degree": 1}),
)}


def parse_recipe(text: str) -> Variant:
    """Returns the variant that `NAME` or `NAME+FIELD=VALUE+...` stands for.

    Raises:
        ConfigError: there is no such name, or no such field of the training options.
    """
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
    """Returns the variants of some words, each of which may list several with commas.

    Raises:
        ConfigError: as `parse_recipe`, one appears twice, or there is none.
    """
    words = [word.strip() for text in texts for word in text.split(",") if word.strip()]
    if not words:
        raise ConfigError("No recipe was given.", hint="Try --recipes reference,budget.")
    twice = [word for word in words if words.count(word) > 1]
    if twice:
        raise ConfigError(f"The recipe {twice[0]} appears twice.", hint="Remove one of them.")
    return tuple(parse_recipe(word) for word in words)


@dataclass(frozen=True)
class TrainingRun:
    """What is run: one variant from one seed for so many steps."""

    variant: Variant
    base: RunConfig  # options that all variants share
    iterations: int
    seed: int

    @property
    def config(self) -> RunConfig:
        """The options of this run."""
        return self.variant.config(self.base, iterations=self.iterations, seed=self.seed)
