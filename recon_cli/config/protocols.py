"""The protocols of `recon train --protocol`: what a table of the literature takes for granted.

A protocol fixes every option that decides the result, except for those that a table names in its
caption (FREE). What it asks of the views (their split, their size) `train.protocol` sees to.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from recon_cli.config.fields import StageConfig, option_info
from recon_cli.errors import ConfigError

STEPS = 30_000  # where no number is asked for (Kerbl et al. 2023)
# Options that may differ within a protocol. The count of 3DGS has no limit but memory.
FREE = frozenset({"protocol", "iterations", "max_size", "max_gaussians", "seed", "mid"})


@dataclass(frozen=True)
class Protocol:
    """One protocol: options of training; all others but the FREE ones keep their defaults."""

    name: str  # on the command line and in tables
    words: str  # for notes
    options: Mapping[str, Any]
    # Schedules count by STEPS, whatever number is asked for: 7,000 steps are the first 7,000 of
    # 30,000, as in the tables of 3DGS and after it.
    whole_schedule: bool = False
    plain: bool = False  # without optional parts of the model
    limits_count: bool = True  # --max-gaussians has a default; else memory is the limit


# every 8th view by name is held out, all others are trained on; both protocols share it
_SPLIT = {"validation": 0.0, "early_stop": False, "blocks": "off"}
PROTOCOLS = {protocol.name: protocol for protocol in (
    Protocol(
        "3dgs", "3DGS as published: INRIA's densification, rates, loss and schedule, degree 3",
        {**_SPLIT, "densify": "reference", "sh_degree": 3, "images": "original",
         "max_radius": 0.0},
        whole_schedule=True, plain=True, limits_count=False),
    Protocol("recon", "the recipe of recon, on the same views", _SPLIT))}
SPLIT_WORDS = "every 8th view by name held out, no validation views"


def follow(name: str | None) -> Protocol | None:
    """Returns the protocol of a name, None where none of that name is followed."""
    return PROTOCOLS.get(name or "")


def fixed_options(config: StageConfig) -> dict[str, Any]:
    """Returns the options that the protocol of a training config sets; none without a protocol.

    Raises:
        ConfigError: an option asks for something else.
    """
    values = {item.name: getattr(config, item.name) for item in dataclasses.fields(config)}
    protocol = follow(values["protocol"])
    if protocol is None:
        return {}
    refuse_contradictions(type(config), {
        item.name: values[item.name] for item in dataclasses.fields(config)
        if values[item.name] != item.default})
    steps = STEPS if values["iterations"] is None else values["iterations"]
    return {**_options(protocol, type(config)), "iterations": steps}


def _options(protocol: Protocol, config: type[StageConfig]) -> dict[str, Any]:
    """Returns all options that a protocol sets; later ones are off by themselves without trials."""
    return {**protocol.options, **(config.plain_values(late=False) if protocol.plain else {})}


def refuse_contradictions(config: type[StageConfig], values: Mapping[str, Any]) -> None:
    """Raises ConfigError where a value that is given differs from what the protocol fixes."""
    protocol = follow(values.get("protocol"))
    if protocol is None:
        return
    options = _options(protocol, config)
    for item in dataclasses.fields(config):
        fixed = options.get(item.name, item.default)
        value = values.get(item.name, fixed)
        if value == fixed or item.name in FREE or not option_info(item).hashed:
            continue
        raise ConfigError(
            f"{item.name} is {value}, but the protocol {protocol.name} "
            f"{'leaves it automatic' if fixed is None else f'has {fixed}'}.",
            hint=f"Leave out --{item.name.replace('_', '-')}, here and in recon.toml, or "
                 "--protocol.")
