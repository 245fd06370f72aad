"""One model of the blocks of a scene, which were trained apart.

Each block keeps the Gaussians in its cell; those trained around it, so that nothing floats at its
border, belong to others. Then all Gaussians are fine-tuned on all views: those at a wall reach
through to the other side, which no view of their own block sees, and each block fitted
distant places for itself.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from recon_cli.config.stages import MIN_GAUSSIANS, RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import FormatError, ReconstructionError, name_command
from recon_cli.evaluation.metrics import psnr
from recon_cli.evaluation.reference_views import load_reference_views, render_view
from recon_cli.io.images import fit_camera
from recon_cli.io.views import size_summary
from recon_cli.scene.cells import Cell
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats, joined
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.train.blocks.blocks import MERGE_SHARE, BlockJob, record
from recon_cli.train.fit.initialize import begin_state, restore_state
from recon_cli.train.fit.runner import CHECKPOINT, RunSegment, run_fit
from recon_cli.train.fit.schedule import make_schedule
from recon_cli.train.fit.state import TrainState
from recon_cli.train.fit.train_data import gaussians_that_fit, load_task, read_config, write_config
from recon_cli.train.parts.photometry import write_photometry
from recon_cli.train.parts.table import PARTS, model_parts
from recon_cli.workspace.atomic import delete
from recon_cli.workspace.summaries import (
    LogRow,
    MergeSummary,
    PhotometrySummary,
    TrainSummary,
)

_FINETUNE = 0.25  # steps after the merge, of those of all blocks
# Factor of all learning rates in these steps but the means', which restarts lower by itself. Those
# of a run that begins undo what blocks have learned: 600 steps with them end at 27.1 dB on an
# apartment, with lower ones at 28.4 (merged: 26.7).
_OTHER_RATES = 0.7
SEAM_DROP_DB = 1.0  # of a view against the block that trained it; a visible seam costs more


@dataclass(frozen=True, eq=False)
class TrainedBlock:
    """A block's model, and the part of space that it owns."""

    name: str
    splats: Splats
    cell: Cell
    views: frozenset[str]  # names of those that it was trained or checked on
    config: RunConfig  # options of its training
    summary: TrainSummary  # of its training

    @staticmethod
    def read(job: BlockJob) -> TrainedBlock:
        """Returns the block whose job is finished."""
        finished = job.finished()
        assert finished is not None, f"block {job.name} is trained"
        return TrainedBlock(
            job.name, read_ply(job.model / "splats.ply"), job.cell, job.views,
            read_config(job.model), TrainSummary.from_json(finished.run.summary))


def merge_blocks(
    jobs: Sequence[BlockJob], scene: Scene, out: Path, ctx: StageContext
) -> TrainSummary:
    """Writes the model of trained blocks into `out`, fine-tuned on all views of the scene.

    Raises:
        FormatError: a file is damaged.
        ReconstructionError: no Gaussian is left.
    """
    blocks = [TrainedBlock.read(job) for job in jobs]
    parts = [_own(block) for block in blocks]
    degree = max(part.sh_degree for part in parts)
    splats = joined([part.with_degree(degree) for part in parts])[0]
    if not len(splats):
        raise ReconstructionError(
            "No block has a Gaussian in its cell.",
            hint=f"Train one model by {name_command('train --blocks off')}.")
    before = sum(block.summary.iterations for block in blocks)
    steps = round(_FINETUNE * before)
    config = dataclasses.replace(
        _run_config(blocks, steps, len(splats), degree),
        checkpoint_every=jobs[0].config.checkpoint_every)
    state = _finetune(splats, steps, config, scene, out, ctx)
    if state is not None:
        splats = state.splats.map(lambda tensor: tensor.detach().cpu())
    changes = _seam_changes(splats, blocks, config.max_size, scene, ctx)
    for name, change in changes.items():
        if change < -SEAM_DROP_DB:
            ctx.notice(f"{name}, which shows the seam of two blocks, lost {-change:.2f} dB by the "
                       "merge")
    config = dataclasses.replace(config, iterations=before + (0 if state is None else state.steps))
    write_ply(out / "splats.ply", splats)
    write_photometry(out, None if state is None else state.photometry)
    write_config(out, config)
    delete(out / CHECKPOINT)
    values = list(changes.values())
    merge = MergeSummary(
        left_out=sum(len(block.splats) for block in blocks) - sum(map(len, parts)),
        iterations=0 if state is None else state.steps, seam_views=len(values),
        seam_change_db=round(float(np.mean(values)), 3) if values else None,
        worst_seam_db=round(min(values), 3) if values else None)
    last = None if state is None else LogRow.read_all(out / LogRow.FILE)[-1]
    return _summarize(
        config, [block.summary for block in blocks], merge, len(splats), scene, last,
        state.photometry.summarize() if state and state.photometry else None)


def _summarize(
    config: RunConfig, blocks: Sequence[TrainSummary], merge: MergeSummary, gaussians: int,
    scene: Scene, last: LogRow | None, photometry: PhotometrySummary | None,
) -> TrainSummary:
    """Returns the summary of the whole; `last` is the end of the log of the fine-tuning, if any."""
    cameras = [fit_camera(view.camera, config.max_size) for view in scene.train]
    return TrainSummary(
        iterations=config.iterations, gaussians=gaussians,
        initial_gaussians=sum(block.initial_gaussians for block in blocks),
        max_gaussians=config.max_gaussians, max_size=config.max_size,
        planned_iterations=config.iterations, stopped_early_at=None,
        training_views=len(scene.train), validation_views=len(scene.validation),
        **size_summary(cameras), validation_psnr_db=last.validation_psnr_db if last else None,
        train_seconds=round(
            sum(block.train_seconds for block in blocks) + (last.seconds if last else 0.0), 3),
        parts=model_parts(config), skipped_steps=sum(block.skipped_steps for block in blocks),
        estimated_seconds=sum(block.estimated_seconds for block in blocks),
        calibration_seconds=sum(block.calibration_seconds for block in blocks),
        cuda_peak_bytes=max(block.cuda_peak_bytes for block in blocks), blocks=len(blocks),
        merge=merge, photometry=photometry)


def _run_config(
    blocks: Sequence[TrainedBlock], steps: int, count: int, degree: int
) -> RunConfig:
    """Returns the options of the fine-tuning: those of the blocks."""
    configs = [block.config for block in blocks]
    parts: dict[str, Any] = {part.name: part.merge(configs, fits=steps > 0) for part in PARTS}
    parts["sh_degree"] = degree
    return dataclasses.replace(
        configs[0], iterations=max(1, steps), max_size=max(each.max_size for each in configs),
        max_gaussians=max(MIN_GAUSSIANS, count), early_stop=False, **parts)


def _finetune(
    splats: Splats, steps: int, config: RunConfig, scene: Scene, out: Path, ctx: StageContext
) -> TrainState | None:
    """Returns the merged scene after steps on all views; None where there are none.

    Neighbours correct each other in these steps: a Gaussian that reaches through a wall is seen
    from behind for the first time.
    """
    if not steps:
        return None
    room = gaussians_that_fit(scene, config, ctx)
    if room < len(splats):
        ctx.notice(f"the merged scene has {len(splats):,} Gaussians, but memory has room to train "
                   f"{room:,}: the merged scene is not fine-tuned, and borders may show")
        return None
    slower = dataclasses.replace(config, **{
        name: _OTHER_RATES * getattr(config, name)
        for name in ("quats_rate", "scales_rate", "opacities_rate", "sh_rate")})
    task = load_task(scene, slower, ctx)
    task = dataclasses.replace(task, schedule=make_schedule(slower, 0))
    saved = out / CHECKPOINT
    state = restore_state(saved, task) if saved.exists() else begin_state(splats, task)


    def record_all(done: int, total: int) -> None:
        record(ctx, 1 - MERGE_SHARE * (1 - done / total))

    run_fit(state, task, steps, RunSegment(out, "merge", steps),
            dataclasses.replace(ctx, record=record_all))
    return state


def _own(block: TrainedBlock) -> Splats:
    """Returns the Gaussians of a block in its own cell; FormatError where a centre is not finite.
    """
    means = block.splats.means.numpy()
    if not np.isfinite(means).all():
        raise FormatError(f"Block {block.name} has centres that are not finite.")
    return block.splats.select(torch.from_numpy(block.cell.owns(means)))


def _seam_changes(
    splats: Splats, blocks: Sequence[TrainedBlock], max_size: int, scene: Scene, ctx: StageContext
) -> dict[str, float]:
    """Returns the gain of validation views of several blocks over the best of these, dB by name.

    A block's own model has no seam where its view looks into another cell.
    """
    shared = [view for view in scene.validation
              if sum(view.name in block.views for block in blocks) > 1]
    merged, changes = splats.map(lambda tensor: tensor.to(ctx.device)), {}
    alone = [block.splats.map(lambda tensor: tensor.to(ctx.device)) for block in blocks]
    with ctx.progress.bar("checking seams", len(shared), unit="view") as bar:
        for view in load_reference_views(shared, max_size, ctx, threads=ctx.threads):
            def score(model: Splats, view=view) -> float:  # type: ignore[no-untyped-def]
                image = render_view(model, view.camera, model.sh_degree, ctx.backend).rgb
                return psnr(image.cpu().numpy(), view.image, view.mask)

            best = max(score(model) for model, block in zip(alone, blocks, strict=True)
                       if view.name in block.views)
            changes[view.name] = score(merged) - best
            bar.advance()
    return changes
