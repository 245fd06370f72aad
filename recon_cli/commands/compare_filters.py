"""`recon denoise --compare`: would a filter help this capture, and which? Nothing is filtered.

The figures go to compare.json in the workspace, beside the stages, so that no result turns stale.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING

from recon_cli.config.stages import DenoiseConfig
from recon_cli.evaluation.tables import Table
from recon_cli.pipeline import plan
from recon_cli.pipeline.execute import Job
from recon_cli.workspace import atomic
from recon_cli.workspace.layout import disk_errors

if TYPE_CHECKING:
    from recon_cli.capture.denoise_comparison import Score

RESULT = "compare.json"
SAMPLES = 3  # frames, spread over the capture: 20 s in all at 1080x1920 on one core
MEASURED = 16  # frames whose noise is measured: 3 s
LEAST = 0.5  # 1/255; rounding to 8 bits alone makes .3


def compare_filters(job: Job, config: DenoiseConfig) -> str:
    """Writes compare.json into the workspace and returns its table and what follows from it.

    Args:
        job: whose workspace holds the frames.
        config: the options that `recon denoise` would run with.

    Raises:
        StageError: there are no fresh frames.
        WorkspaceError: the workspace is in use or cannot be written.
        FormatError: a frame cannot be read.
    """
    # OpenCV and scikit-image are slow to import; --help does not wait for them.
    import cv2
    import numpy as np

    from recon_cli.capture import denoise_comparison
    from recon_cli.capture.noise import estimate_noise
    from recon_cli.io.frames import FOLDER, read_frame_list, read_png

    root, folder = job.workspace.root, job.workspace.folder("ingest")
    plan.plan(job.inspect(), "denoise")
    with disk_errors(root, "comparing filters"), job.workspace.writing("denoise --compare"):
        names = [frame.name for frame in read_frame_list(folder).frames]
        measured = [estimate_noise(read_png(folder / FOLDER / n)) for n in _spread(names, MEASURED)]
        noise = float(np.median(measured))
        samples = _spread(names, SAMPLES)
        truths = [denoise_comparison.halved(read_png(folder / FOLDER / name)) for name in samples]
        levels = denoise_comparison.levels_with(noise)
        with job.progress.bar("compare", denoise_comparison.steps(levels), unit="run") as bar:
            scores = denoise_comparison.compare(truths, levels, step=bar.advance)
        atomic.write_json(root / RESULT, {
            "measured_noise_255": noise,
            "frames": samples,
            "reduced": "by area to half the size, before noise was added",
            "opencv_threads": cv2.getNumThreads(),
            "scores": [dataclasses.asdict(score) for score in scores],
        })
    heading = (
        f"PSNR in dB and share of the edges kept, {len(samples)} frames at half their size with "
        "white noise added (in 1/255)")
    chosen = denoise_comparison.best(scores, noise) if noise >= LEAST else None
    gained = denoise_comparison.gain(scores, chosen) if chosen else 0.0
    return "\n\n".join([heading, _table(scores), _advice(config, noise, chosen, gained)])


def _spread(names: Sequence[str], count: int) -> list[str]:
    """Returns up to `count` names, evenly spread."""
    count = min(count, len(names))
    return [names[(2 * place + 1) * len(names) // (2 * count)] for place in range(count)]


def _table(scores: Sequence[Score]) -> str:
    levels = sorted({score.noise_255 for score in scores})
    rows = [["filter", "strength", *(f"noise {level:g}" for level in levels), "s/MP"]]
    for name, strength in dict.fromkeys((score.filter, score.strength) for score in scores):
        own = [one for one in scores if (one.filter, one.strength) == (name, strength)]
        seconds = sum(one.seconds_per_megapixel for one in own) / len(own)
        rows.append([
            name if own[0].offered else f"({name})", f"{strength:g}" if strength else "-",
            *(f"{one.psnr_db:.1f} {one.edges_kept:4.0%}" for one in own),
            f"{seconds:.2f}"])
    return Table(tuple(rows[0]), tuple(map(tuple, rows[1:]))).text()


def _advice(config: DenoiseConfig, noise: float, chosen: Score | None, gained: float) -> str:
    """Returns what the frames' own noise calls for, in words."""
    lines = [f"The noise of the frames is {noise:.1f}/255 (median)."]
    if chosen is None:
        lines.append("That is no more than what 8 bits leave: there is nothing to remove.")
    elif chosen.filter == "none":
        lines.append("Doing nothing is best at that level; recon denoise --off does that.")
    else:
        lines.append(
            f"Best at {chosen.noise_255:g}/255: --filter {chosen.filter} --strength "
            f"{chosen.strength:g}, {gained:+.1f} dB if that noise is white, and "
            f"{chosen.edges_kept:.0%} of the edges kept.")
    left = noise < config.threshold and config.mode == "auto"
    lines.append(
        f"recon denoise leaves frames below --threshold {config.threshold:g} as they are." if left
        else f"recon denoise would use --filter {config.filter} --strength {config.strength:g}.")
    return "\n".join(lines)
