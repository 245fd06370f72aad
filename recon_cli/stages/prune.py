"""prune: removes the Gaussians that matter least to the training views, and lets the rest recover.

Branches off the finished run, or off its middle: then both models have seen as many steps. The
unpruned model stays in train/, so that evaluation can set them side by side.
"""

from __future__ import annotations

from pathlib import Path

from recon_cli.config.stages import PruneConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, Hint, TrainingError
from recon_cli.scene.splats import Splats
from recon_cli.splats.ply import max_gaussians, write_ply
from recon_cli.train.fit.loop import validation_psnr
from recon_cli.train.fit.runner import seconds_at
from recon_cli.train.parts.photometry import write_photometry
from recon_cli.train.prune.prune_loop import RATIO, prune_loop, remaining
from recon_cli.train.prune.prune_run import StoredPruneRun, load_prune_source, prune_while_good
from recon_cli.workspace.summaries import LogRow, PruneSummary, RoundSummary


def run(config: PruneConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> PruneSummary:
    """Prunes, recovers and returns the number removed and the cost."""
    source = load_prune_source(config, inputs, ctx)
    start = source.begin()
    n, steps, psnr_before = len(start.splats), start.steps, validation_psnr(start, source.task)
    target = _target(config, start.splats)
    del start
    run = StoredPruneRun(source, out, ctx)
    if config.max_psnr_drop is None:
        prune_loop(run, target)
        run.end_round()
    elif psnr_before is None:
        raise TrainingError(
            "--max-psnr-drop is measured on validation views, but the run has none.",
            hint=Hint("train", "--validation 0.05", then=" first, or prune by --ratio"))
    else:
        prune_while_good(run, psnr_before, config.max_psnr_drop)
        if len(run.state.splats) == n:
            ctx.notice(f"nothing was removed: {run.done[0].removed:.1%} already cost more than "
                       f"{config.max_psnr_drop:g} dB" if run.done else "nothing was removed")
    run.write_rounds()
    state = run.state
    write_ply(out / "splats.ply", state.splats)
    write_photometry(out, state.photometry)
    run.clear()
    left = len(state.splats)
    return PruneSummary(
        at=source.config.at, score=config.score, ratio=round(1 - left / n, 4), gaussians_before=n,
        gaussians=left,
        validation_psnr_db_pruned=run.done[0].validation_psnr_db_removed if run.done else None,
        rounds=tuple(RoundSummary(
            gaussians=row.gaussians, removed=row.gaussians_before - row.gaussians,
            validation_psnr_db=row.validation_psnr_db, kept=row.kept) for row in run.done),
        iterations=state.steps, recovery_steps=state.steps - steps,
        validation_psnr_db_before=psnr_before,
        validation_psnr_db=validation_psnr(state, source.task),
        train_seconds=seconds_at(out / LogRow.FILE, state.iteration))


def _target(config: PruneConfig, splats: Splats) -> int:
    """Returns how many of the Gaussians stay; ConfigError where not one fits into the .ply."""
    n = len(splats)
    if config.max_gaussians is not None:
        return min(n, config.max_gaussians)
    if config.max_mb is not None:
        count = max_gaussians(int(1e6 * config.max_mb), splats.sh_degree, splats.backdrop)
        if count == 0:
            raise ConfigError(
                f"max_mb is {config.max_mb:g}, but a .ply of one Gaussian is larger.",
                hint="Use --max-mb 1 or more: about 4,000 Gaussians.")
        return min(n, count)
    return remaining(n, RATIO if config.ratio is None else config.ratio)
