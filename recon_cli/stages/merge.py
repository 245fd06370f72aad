"""merge: blocks of a scene that were trained apart take the place of a trained one.

Each block keeps the Gaussians in its cell; what it trained around that, so that nothing floats at
its border, belongs to others. Writes what `import_scene` writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from recon_cli.config.stages import MIN_GAUSSIANS, MergeConfig, RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import FormatError, ReconstructionError, WorkspaceError
from recon_cli.evaluation.metrics import psnr
from recon_cli.evaluation.reference_views import load_reference_views, load_scene, render_on_black
from recon_cli.io.colmap import read_pinholes
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.io.records import BLOCKS, BlockRecord, ImportRecord
from recon_cli.scene.cells import Cell
from recon_cli.scene.splats import Splats, joined
from recon_cli.train.train_data import write_config
from recon_cli.workspace.digests import digest_file, sha256_json
from recon_cli.workspace.manifest import Manifest
from recon_cli.workspace.summaries import MergeSummary

SEAM_DROP_DB = 1.0  # of a view against the block that trained it; a visible seam costs more


@dataclass(frozen=True, eq=False)
class TrainedBlock:
    """A block's model, and what it owns."""

    name: str
    splats: Splats
    cell: Cell
    views: frozenset[str]  # names of those in its workspace
    sha256: str  # of the model


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
    changes = _seam_changes(splats, blocks, config, inputs, ctx)
    for name, change in changes.items():
        if change < -SEAM_DROP_DB:
            ctx.notice(f"{name}, which shows the seam of two blocks, lost {-change:.2f} dB by the "
                       "merge")
    record = ImportRecord(
        f"{len(blocks)} blocks", BLOCKS, sha256_json([block.sha256 for block in blocks]),
        len(splats), degree, z_up=False, views=True)
    write_ply(out / "splats.ply", splats)
    write_config(out, RunConfig(
        max_size=config.max_size, validation=config.validation, sh_degree=degree,
        max_gaussians=max(MIN_GAUSSIANS, len(splats)), images="original", far="off",
        exposure="off", poses="off"))
    record.write(out)
    values = list(changes.values())
    return MergeSummary(
        imported_from=record.file, blocks=len(blocks), gaussians=len(splats), sh_degree=degree,
        left_out=sum(len(block.splats) for block in blocks) - len(splats), seam_views=len(values),
        seam_change_db=round(float(np.mean(values)), 3) if values else None,
        worst_seam_db=round(min(values), 3) if values else None)


def _read_block(path: Path) -> TrainedBlock:
    """Returns the block whose train/splats.ply is given; WorkspaceError if that was changed."""
    root = path.parents[1]
    known = Manifest.read(path.parent).outputs.get(path.name)
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
    return TrainedBlock(root.name, read_ply(path), record.cell, views, digest)


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
    splats: Splats, blocks: Sequence[TrainedBlock], config: MergeConfig, inputs: StageInputs,
    ctx: StageContext,
) -> dict[str, float]:
    """Returns what validation views of several blocks gain over the best of these, in dB by name.

    A block's own model has no seam where its view looks into another cell.
    """
    scene = load_scene(inputs, validation=config.validation)
    shared = [view for view in scene.validation
              if sum(view.name in block.views for block in blocks) > 1]
    merged, changes = splats.map(lambda tensor: tensor.to(ctx.device)), {}
    alone = [block.splats.map(lambda tensor: tensor.to(ctx.device)) for block in blocks]
    with ctx.progress.bar("checking seams", len(shared), unit="view") as bar:
        for view in load_reference_views(shared, config.max_size, ctx, threads=ctx.threads):
            def score(model: Splats, view=view) -> float:  # type: ignore[no-untyped-def]
                image = render_on_black(model, view.camera, model.sh_degree, ctx.backend).rgb
                return psnr(image.cpu().numpy(), view.image, view.mask)

            best = max(score(model) for model, block in zip(alone, blocks, strict=True)
                       if view.name in block.views)
            changes[view.name] = score(merged) - best
            bar.advance()
    return changes
