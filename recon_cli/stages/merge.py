"""merge: blocks of a scene that were trained apart take the place of a trained one.

Each block keeps the Gaussians in its cell; what it trained around that, so that nothing floats at
its border, belongs to others. Then all Gaussians are fine-tuned on all views: those at a wall reach
through to the other side, which no view of their own block sees, and what lies far away was fitted
by each block for itself. Writes what `import_scene` writes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from recon_cli.config.stages import MIN_GAUSSIANS, MergeConfig, RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import FormatError, ReconstructionError, WorkspaceError
from recon_cli.evaluation.metrics import psnr
from recon_cli.evaluation.reference_views import load_reference_views, load_scene, render_view
from recon_cli.io.colmap import read_pinholes
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.io.records import BLOCKS, BlockRecord, ImportRecord
from recon_cli.scene.cells import Cell
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats, joined
from recon_cli.train.initialize import begin_state, restore_state
from recon_cli.train.runner import CHECKPOINT, LOG, Segment, run_fit
from recon_cli.train.schedule import make_schedule
from recon_cli.train.state import TrainState
from recon_cli.train.train_data import gaussians_that_fit, load_task, read_config, write_config
from recon_cli.workspace.atomic import delete
from recon_cli.workspace.digests import digest_file, sha256_json
from recon_cli.workspace.manifest import Manifest
from recon_cli.workspace.summaries import LogRow, MergeSummary

_FINETUNE = 0.25  # steps after the merge, of those of all blocks
# Factor of all learning rates in these steps but the means', which restarts lower by itself. Those
# of a run that begins undo what blocks have learned: 600 steps with them end at 27.1 dB on an
# apartment, with lower ones at 28.4 (merged: 26.7).
_OTHER_RATES = 0.7
SEAM_DROP_DB = 1.0  # of a view against the block that trained it; a visible seam costs more


@dataclass(frozen=True, eq=False)
class TrainedBlock:
    """A block's model, and what it owns."""

    name: str
    splats: Splats
    cell: Cell
    views: frozenset[str]  # names of those in its workspace
    sha256: str  # of the model
    config: RunConfig  # options of its training
    steps: int  # taken in it


def run(config: MergeConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> MergeSummary:
    """Writes the scene of the blocks into `out`; the sources are their splats.ply.

    Raises:
        WorkspaceError: a model was changed by hand, or the blocks are not all of one scene.
        FormatError: a file is damaged.
        ReconstructionError: no Gaussian is left.
    """
    blocks = [_read_block(path) for path in inputs.sources]
    _check_cells(blocks)
    parts = [_own(block) for block in blocks]
    degree = max(part.sh_degree for part in parts)
    splats = joined([part.with_degree(degree) for part in parts])[0]
    if not len(splats):
        raise ReconstructionError(
            "No block has a Gaussian in its cell.", hint="Train with fewer --blocks.")
    before = sum(block.steps for block in blocks)
    steps = round(_FINETUNE * before) if config.iterations is None else config.iterations
    run_config = _run_config(config, blocks, steps, len(splats), degree)
    scene = load_scene(inputs, validation=config.validation)
    state = _finetune(splats, steps, run_config, scene, out, ctx)
    if state is not None:
        splats = state.splats.map(lambda tensor: tensor.detach().cpu())
    changes = _seam_changes(splats, blocks, run_config.max_size, scene, ctx)
    for name, change in changes.items():
        if change < -SEAM_DROP_DB:
            ctx.notice(f"{name}, which shows the seam of two blocks, lost {-change:.2f} dB by the "
                       "merge")
    record = ImportRecord(
        f"{len(blocks)} blocks", BLOCKS, sha256_json([block.sha256 for block in blocks]),
        len(splats), degree, z_up=False, views=True)
    write_ply(out / "splats.ply", splats)
    steps = 0 if state is None else state.steps
    write_config(out, dataclasses.replace(run_config, iterations=before + steps))
    record.write(out)
    delete(out / CHECKPOINT)
    values = list(changes.values())
    last = LogRow.read_all(out / LOG)[-1] if steps else None
    return MergeSummary(
        imported_from=record.file, blocks=len(blocks), gaussians=len(splats), sh_degree=degree,
        left_out=sum(len(block.splats) for block in blocks) - sum(map(len, parts)),
        iterations=steps, validation_psnr_db=last.validation_psnr_db if last else None,
        train_seconds=last.seconds if last else 0.0, seam_views=len(values),
        seam_change_db=round(float(np.mean(values)), 3) if values else None,
        worst_seam_db=round(min(values), 3) if values else None)


def _run_config(
    config: MergeConfig, blocks: Sequence[TrainedBlock], steps: int, count: int, degree: int
) -> RunConfig:
    """Returns the options of the fine-tuning: what the blocks were trained with."""
    configs = [block.config for block in blocks]
    denoised = all(each.images == "denoised" for each in configs)
    drifting = steps > 0 and any(each.exposure == "on" for each in configs)
    return dataclasses.replace(
        configs[0], iterations=max(1, steps), validation=config.validation,
        max_size=config.max_size or max(each.max_size for each in configs),
        sh_degree=degree, max_gaussians=max(MIN_GAUSSIANS, count), far="off", stereo="off",
        images="denoised" if denoised else "original",
        exposure="on" if drifting else "off", early_stop=False)


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
                   f"{room:,}: it is not fine-tuned as a whole, and borders may show")
        return None
    slower = dataclasses.replace(config, **{
        name: _OTHER_RATES * getattr(config, name)
        for name in ("quats_rate", "scales_rate", "opacities_rate", "sh_rate")})
    task = load_task(scene, slower, ctx)
    task = dataclasses.replace(task, schedule=make_schedule(slower, 0))
    saved = out / CHECKPOINT
    state = restore_state(saved, task) if saved.exists() else begin_state(splats, task)
    run_fit(state, task, steps, Segment(out, "merge", steps), ctx)
    return state


def _read_block(path: Path) -> TrainedBlock:
    """Returns the block whose train/splats.ply is given; WorkspaceError if that was changed."""
    root = path.parents[1]
    finished = Manifest.read(path.parent)
    known = finished.outputs.get(path.name)
    digest = digest_file(path).sha256
    if known is None or known.sha256 != digest:
        raise WorkspaceError(
            f"{path} is not what the training of block {root.name} wrote: it was changed by hand.",
            hint=f"Train the block again: `recon train --again -w {root}`.")
    record = BlockRecord.read(root / "sfm")
    if record is None:
        raise WorkspaceError(
            f"{root} is no block of a scene: it has no cell.",
            hint="Make blocks with `recon train --blocks N`.")
    views = frozenset(read_pinholes(root / "sfm" / "undistorted" / "sparse"))
    return TrainedBlock(
        root.name, read_ply(path), record.cell, views, digest, read_config(path.parent),
        int(finished.run.summary["iterations"]))


def _check_cells(blocks: Sequence[TrainedBlock]) -> None:
    """Raises WorkspaceError unless each point of one scene is owned by exactly one block."""
    first = blocks[0].cell.points
    same = all(np.array_equal(block.cell.points, first) for block in blocks)
    if not same or not (np.sum([block.cell.owned for block in blocks], axis=0) == 1).all():
        raise WorkspaceError(
            f"The blocks {', '.join(block.name for block in blocks)} do not make up one scene.",
            hint="Merge all blocks of one `recon train --blocks N`, each once.")


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
    """Returns what validation views of several blocks gain over the best of these, in dB by name.

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
