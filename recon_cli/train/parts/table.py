"""The table of the optional parts of the model, in the order in which they are tried.

What was switched on is part of the trials that follow. To add a part: its option in
`config/stages.py`, a module beside this one, and its row here.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from recon_cli.config.stages import RunConfig, TrainConfig
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.parts import background, depth, exposure, harmonics, stereo, vignette
from recon_cli.train.parts.part import Part, Sign, TrialScene


def _find_twins(scene: TrialScene) -> Sign:
    return Sign(on=False) if scene.twins is None else Sign()


IMAGES = Part("images", _find_twins, values=("original", "denoised"))
PARTS = (stereo.PART, IMAGES, background.PART, exposure.PART, vignette.PART, depth.PART,
         harmonics.PART)


def model_parts(config: TrainConfig) -> dict[str, Any]:
    """Returns the parts of the model that trials decide on, by the names of their options."""
    return {part.name: getattr(config, part.name) for part in PARTS}


def with_part(config: RunConfig, part: Part, value: Any) -> RunConfig:
    """Returns the options with another value of a part."""
    return replace(config, **{part.name: value})


def without_open_parts(config: RunConfig) -> RunConfig:
    """Returns the options with every part off that is not decided yet."""
    for part in PARTS:
        if getattr(config, part.name) == "auto":
            config = with_part(config, part, part.values[0])
    return config


def step_options(schedule: Schedule, iteration: int) -> dict[str, float]:
    """Returns what parts change of the `StepOptions` of a step."""
    return {name: value for part in PARTS if part.step_options
            for name, value in part.step_options(schedule, iteration).items()}
