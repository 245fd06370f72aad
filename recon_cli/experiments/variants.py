"""What is trained: a recipe, by name, as changes of the training options and a prune on the way."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from recon_cli.config.settings import parse_assignment
from recon_cli.config.stages import PruneConfig, RunConfig
from recon_cli.errors import ConfigError

_MID = RunConfig().mid  # where `recon train --prune` branches off
# options that all recipes of a benchmark have in common, or that have no effect here
_SHARED = {"iterations", "seed", "max_size", "quality", "minutes", "early_stop", "mid"}


@dataclass(frozen=True)
class Prune:
    """A removal in mid-training, after which the rest of the run goes on.

    Attributes:
        at: share of the run's steps.
        config: which Gaussians go. Its `at` and `recovery` are those of the run.
        restarts: learning rates start anew for the rest of the run, as in `recon prune`; otherwise
            the run goes on as if nothing had happened.
    """

    at: float
    config: PruneConfig
    restarts: bool = True


@dataclass(frozen=True)
class Arm:
    """One way to train.

    Attributes:
        name: for the files and the command line.
        label: for the tables.
        options: fields of the training options that differ from the base.
        prune: None where nothing is removed.
        tries_degree: a trial decides on the degree of the colours, as in `recon train`.
    """

    name: str
    label: str
    options: Mapping[str, Any] = field(default_factory=dict)
    prune: Prune | None = None
    tries_degree: bool = False

    def config(self, base: RunConfig, *, iterations: int, seed: int) -> RunConfig:
        """Returns the options of one run.

        Raises:
            ConfigError: an option has a value that cannot be used.
        """
        return dataclasses.replace(
            base, **{**self.options, "iterations": iterations, "seed": seed})

    def record(self) -> dict[str, Any]:
        """Returns what decides about the outcome, as JSON keeps it."""
        prune = self.prune and {
            "at": self.prune.at, "restarts": self.prune.restarts,
            **self.prune.config.hashed_fields()}
        return {"name": self.name, "options": dict(self.options), "prune": prune,
                "tries_degree": self.tries_degree}


# LightGaussian, whose score the paper takes over, removes 60% at step 20,000 of 30,000.
PAPER_PRUNE = Prune(
    2 / 3, PruneConfig(ratio=0.6, score="paper", at="mid", rounds=1), restarts=False)
DEFAULT_PRUNE = Prune(_MID, PruneConfig(at="mid"))

# 3DGS has Gaussians alone; which pixels are trained on is decided for all arms alike
_PLAIN = {"densify": "reference", "far": "off", "exposure": "off", "poses": "off"}
REFERENCE = Arm("reference", "3DGS", _PLAIN)
PAPER = Arm("paper", "paper", _PLAIN, PAPER_PRUNE)
BUDGET = Arm("budget", "ours", {"densify": "budget"}, tries_degree=True)
BUDGET_PRUNED = Arm(
    "budget-pruned", "ours pruned", {"densify": "budget"}, DEFAULT_PRUNE, tries_degree=True)
KNOWN: dict[str, Arm] = {arm.name: arm for arm in (
    REFERENCE, PAPER, BUDGET, BUDGET_PRUNED,
    Arm("mcmc", "mcmc", {"densify": "mcmc"}, tries_degree=True),
    Arm("budget-l1", "budget-l1", {"densify": "budget", "ssim_weight": 0.0}, tries_degree=True),
    Arm("budget-degree-1", "budget-degree-1", {"densify": "budget", "sh_degree": 1}),
)}


def parse(text: str) -> Arm:
    """Returns the arm that `NAME` or `NAME+FIELD=VALUE+...` stands for.

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
    label = known.name if not changes else text
    tries = known.tries_degree and "sh_degree" not in options
    arm = Arm(text, label, {**known.options, **options}, known.prune, tries)
    arm.config(RunConfig(), iterations=1, seed=0)  # refuses values out of range
    return arm


def parse_all(texts: Sequence[str]) -> tuple[Arm, ...]:
    """Returns the arms of some words, each of which may list several with commas.

    Raises:
        ConfigError: as `parse`, or one is there twice.
    """
    words = [word.strip() for text in texts for word in text.split(",") if word.strip()]
    twice = [word for word in words if words.count(word) > 1]
    if twice:
        raise ConfigError(f"The recipe {twice[0]} is there twice.", hint="Leave one out.")
    return tuple(parse(word) for word in words)
