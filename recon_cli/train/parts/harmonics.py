"""Harmonics: the degree of the colours, the lowest that the highest does not beat by enough."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from recon_cli.config.stages import RunConfig
from recon_cli.deadline import OutOfTime
from recon_cli.train.parts.decisions import NO_TIME, Rule, skip_trial
from recon_cli.train.parts.part import Part, Sign

if TYPE_CHECKING:
    from recon_cli.train.parts.trials import Trials

# A gain need not be sure: after 3,000 steps all of twelve captures gained by harmonics, and two
# left out for want of certainty lost .6 and 1.2 dB in longer runs.
_RULE = Rule(errors=0)


def _choose_degree(trials: Trials, config: RunConfig) -> int:
    """Returns the highest degree if it beats the first, else the first if that beats none."""
    if trials.split is None:
        return config.sh_degree
    high = config.sh_degree
    for low in (1, 0):
        name = f"harmonics above degree {low}"
        try:
            decision = trials.compare(
                name, replace(config, sh_degree=low), replace(config, sh_degree=high), _RULE)
        except OutOfTime:
            decision = skip_trial(name, NO_TIME, on=True)
        trials.decisions.append(decision)
        if decision.on:
            break
        high = low
    return high


PART = Part("sh_degree", lambda _: Sign(), is_open=lambda scene: scene.harmonics,
            settle=_choose_degree)
