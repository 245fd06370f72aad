"""denoise: measures the noise of each frame and filters the noisy ones.

Frames are measured one by one: a phone raises its gain when it turns to a dark corner, so that one
capture holds clean and noisy frames. Clean frames stay byte-identical.
"""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from recon_cli.capture.noise import bilateral, estimate_noise
from recon_cli.config.stages import DenoiseConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.io.images import read_png, write_png
from recon_cli.workspace import atomic
from recon_cli.workspace import records as store
from recon_cli.workspace.summaries import DenoiseSummary

NOISE = "noise.json"


@dataclass(frozen=True)
class _Outcome:
    name: str
    sigma: float  # 1/255
    filtered: bool


def run(config: DenoiseConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> DenoiseSummary:
    """Writes noise.json and frames/*.png, twins of ingest's, into `out`; keeps those there.

    Raises:
        FormatError: ingest's folder does not fit its list.
    """
    ingest = inputs.folders["ingest"]
    names = [frame.name for frame in store.read_frame_list(ingest).frames]
    outcomes = _process(config, names, ingest / store.FOLDER, store.prepare_frames_folder(out), ctx)
    atomic.write_json(out / NOISE, {
        outcome.name: {"sigma_255": outcome.sigma, "denoised": outcome.filtered}
        for outcome in outcomes})
    return DenoiseSummary(
        mode=config.mode, frames=len(outcomes),
        denoised=sum(outcome.filtered for outcome in outcomes),
        median_sigma_255=round(float(np.median([item.sigma for item in outcomes])), 4))


def _process(
    config: DenoiseConfig, names: list[str], source: Path, target: Path, ctx: StageContext
) -> list[_Outcome]:
    """Returns the outcome of each frame, in the order of `names`."""
    outcomes = []
    pool = ThreadPoolExecutor(ctx.threads)
    try:
        with ctx.progress.bar("denoise", len(names), unit="frame") as bar:
            for outcome in pool.map(lambda n: _frame(config, source / n, target / n), names):
                outcomes.append(outcome)
                bar.advance()
                ctx.record(len(outcomes), len(names))
    finally:
        pool.shutdown(cancel_futures=True)  # an error or Ctrl-C does not wait for the rest
    return outcomes


def _frame(config: DenoiseConfig, source: Path, target: Path) -> _Outcome:
    """Measures one frame and writes it, filtered or as it is, unless it is there already."""
    rgb = read_png(source)
    sigma = round(estimate_noise(rgb), 4)
    filtered = config.mode == "force" or (config.mode == "auto" and sigma >= config.threshold)
    if not target.exists():
        if filtered:
            # With --force the estimate is taken to be too low.
            noise = max(sigma, config.threshold)
            write_png(target, bilateral(rgb, noise, config.strength))
        else:
            with atomic.replacing(target) as temporary:  # with a link, editing one changes both
                shutil.copyfile(source, temporary)
    return _Outcome(source.name, sigma, filtered)
