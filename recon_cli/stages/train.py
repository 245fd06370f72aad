"""train: Gaussians from cameras and points, by a plan that is made first.

Leaves splats.ply, the states at the middle (where pruning branches off) and the end of the run,
plan.json, config.json, and log.jsonl with loss, validation PSNR, count and seconds. It begins with
the points of sfm, or continues a finished model: of a shorter run, or imported. A large scene is
trained in blocks, by jobs of their own, and has no state at the end: its blocks were trained apart.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path

from recon_cli.config.protocols import SPLIT_WORDS
from recon_cli.config.stages import TrainConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, format_count, list_names, name_command
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.scene.scene import Scene
from recon_cli.train.blocks import blocks
from recon_cli.train.blocks.merge_blocks import merge_blocks
from recon_cli.train.finished_model import FinishedModel
from recon_cli.train.masks import (
    EditedMasks,
    join_masks,
    masked_views,
    read_summary,
    with_masks,
    write_masks,
)
from recon_cli.train.one_model import fit_scene
from recon_cli.workspace.records import Frame
from recon_cli.workspace.summaries import TrainSummary

EVERY = 8  # views from one that is held out to the next, sorted by name, the first one included
MAX_WIDTH = 1600  # pixels; INRIA's code reduces wider images to it


def run(config: TrainConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> TrainSummary:
    """Fits Gaussians to the training views and returns how far it came."""
    capture = PlacedCapture.read(inputs.folders)
    scene = capture.load_scene(validation=config.validation)
    config = fit_protocol(config, scene, capture.frames.frames)
    model = None if inputs.continues is None else FinishedModel.read(inputs.continues)
    if model is not None and config.protocol is not None:
        raise ConfigError(
            f"The protocol {config.protocol} starts from the points of sfm, not from a scene.",
            hint="Leave out --from-import or --protocol.")
    count = _count_blocks(config, scene, model, ctx)
    edited = EditedMasks() if model is not None else EditedMasks.find(inputs.earlier)
    if unused := edited.unused(masked_views(scene)):
        ctx.notice(f"{format_count(len(unused), 'mask')} in train/masks of no view that training "
                   f"reads: {list_names(unused)}")
    if count > 1:
        return _train_in_blocks(config, count, scene, inputs, out, ctx, edited)
    return fit_scene(config, scene, out, ctx, model, edited)


def _count_blocks(
    config: TrainConfig, scene: Scene, model: FinishedModel | None, ctx: StageContext
) -> int:
    """Returns the number of blocks of a scene, 1 for one model; tells the user about blocks."""
    views = len(scene.train) + len(scene.validation) + len(scene.test)
    if model is None:
        count = blocks.count_blocks(views, config.blocks)
    elif config.blocks in ("auto", "off", "1"):
        count = 1
    else:
        raise ConfigError(
            f"blocks is {config.blocks}, but a finished scene is trained further as one model.",
            hint="Give --blocks off.")
    if count == 1 and config.on == "ray":
        ctx.notice(f"The {views} views are trained as one model, on this machine: only blocks run "
                   "on Ray (--blocks).")
    if count > 1 and ctx.callbacks:
        ctx.notice(f"The {count} blocks are trained by processes of their own, which the page does "
                   "not show: it shows the fine-tuning of all after them.")
    return count


def _train_in_blocks(
    config: TrainConfig, count: int, scene: Scene, inputs: StageInputs, out: Path,
    ctx: StageContext, edited: EditedMasks,
) -> TrainSummary:
    write_masks(out, scene, None, edited)  # which the blocks read
    jobs = blocks.cut_blocks(config, count, scene, inputs, out)
    blocks.train_blocks(jobs, config, ctx)
    join_masks(out, [job.model for job in jobs], scene)
    summary = merge_blocks(jobs, with_masks(scene, out), out, ctx)
    blocks.remove_blocks(out)
    return dataclasses.replace(summary, moving=read_summary(out))


def fit_protocol(config: TrainConfig, scene: Scene, frames: Iterable[Frame]) -> TrainConfig:
    """Returns the options with the image size that the protocol of `config` asks for, if any.

    Raises:
        ConfigError: the views are not split as the protocol says.
    """
    if config.protocol is None:
        return config
    _check_split(config.protocol, frames)
    size = image_size(scene) if config.max_size is None else config.max_size
    return dataclasses.replace(config.settle(), max_size=size)


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
            hint=f"Run {name_command('ingest --holdout every:8')}. A data set with held-out views "
                 "of its own keeps them: ingest a copy without them.")
