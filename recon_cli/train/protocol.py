"""What a protocol asks of the views of a scene: their split and their size."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from recon_cli.config.protocols import SPLIT_WORDS
from recon_cli.config.stages import SettledConfig, TrainConfig
from recon_cli.errors import ConfigError, format_count
from recon_cli.scene.scene import Scene
from recon_cli.workspace.records import Frame

EVERY = 8  # views from one that is held out to the next, sorted by name, the first one included
MAX_WIDTH = 1600  # pixels; INRIA's code reduces wider images to it


def fit_protocol(config: TrainConfig, scene: Scene, frames: Iterable[Frame]) -> TrainConfig:
    """Returns the options with the image size that the protocol of `config` asks for, if any.

    Raises:
        ConfigError: the views are not split as the protocol says.
    """
    if config.protocol is None:
        return config
    _check_split(config.protocol, frames)
    size = image_size(scene) if config.max_size is None else config.max_size
    values = {item.name: getattr(config, item.name) for item in dataclasses.fields(config)}
    return SettledConfig(**{**values, "max_size": size})


def image_size(scene: Scene) -> int:
    """Returns the longest side in pixels of images as wide as they are, at most MAX_WIDTH.

    One size is for all views: where they differ, that of the largest.
    """
    cameras = [view.camera for view in (*scene.train, *scene.test)]
    return max(round(max(camera.width, camera.height) * min(1.0, MAX_WIDTH / camera.width))
               for camera in cameras)


def _check_split(protocol: str, frames: Iterable[Frame]) -> None:
    """Raises ConfigError unless every 8th frame by name is held out, the first one included."""
    ordered = sorted(frames, key=lambda frame: frame.name)
    held_out = [frame.name for frame in ordered if frame.held_out]
    expected = [frame.name for frame in ordered[::EVERY]]
    if held_out != expected:
        raise ConfigError(
            f"The protocol {protocol} needs {SPLIT_WORDS}: {len(expected)} of "
            f"{format_count(len(ordered), 'frame')}. Here "
            f"{len(set(held_out) & set(expected))} of these are held out, and "
            f"{len(set(held_out) - set(expected))} others.",
            hint="Run `recon ingest --holdout every:8`. A data set with held-out views of its own "
                 "keeps them: ingest a copy without them.")
