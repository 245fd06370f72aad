"""The quality of a scene in a word with its reason, for people who know no decibels.

The bounds come from tables of docs/benchmarks.md. "Quality in given minutes": the scenes there,
which look right, have 28.08 dB / .901 or more. "Cameras": of captures in one part 97% of the frames
or more have a camera. "Noise" in tests/bench/notes/figures.md: noise of 20 of 255, which nobody
overlooks, leaves 22.3 dB. docs/trust.md: of the surface of living's room 96% is well seen; a tenth
that is not is a judgement, as there is no table of such scenes.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.errors import FormatError, ManifestError
from recon_cli.evaluation.scores import Metrics, ViewScore
from recon_cli.trust.records import ModelTrust, TrustRecord
from recon_cli.workspace.records import Frame
from recon_cli.workspace.summaries import PlaceSummary

GOOD, FAIR, POOR, UNKNOWN = "good", "fair", "poor", "unknown"
GOOD_PSNR_DB, GOOD_SSIM = 28.0, 0.90
POOR_PSNR_DB = 22.3
GOOD_SURFACE = 0.9  # share that is well seen
GOOD_REGISTERED = 0.95  # share of the frames that have a camera
_LARGE_REGION = 0.01  # of the surface: a poorly seen region that is named


@dataclass(frozen=True)
class Quality:
    """How good a scene is."""

    word: str  # GOOD, FAIR, POOR or UNKNOWN
    reason: str  # the figures, what is short of good, and the weakest place

    def __str__(self) -> str:
        return f"{self.word}: {self.reason}"


def read_quality(
    evaluate: Path, sfm: PlaceSummary | None, frames: Sequence[Frame] = ()
) -> Quality:
    """Returns the quality by the files in evaluate's folder; unknown where they cannot be read."""
    try:
        return describe_quality(Metrics.read(evaluate), TrustRecord.read(evaluate), sfm, frames)
    except (FormatError, ManifestError) as error:
        return Quality(UNKNOWN, error.message.rstrip("."))


def describe_quality(
    metrics: Metrics | None, trust: TrustRecord | None, sfm: PlaceSummary | None,
    frames: Sequence[Frame] = (),
) -> Quality:
    """Returns the quality of the model that export takes.

    `sfm` is None for an imported scene; `frames` tell the time of a view in a video.
    """
    model = delivered_model(metrics)
    if metrics is None or model is None or not metrics.models[model].views:
        return Quality(UNKNOWN, "no held-out view was scored")
    scores, seen = metrics.models[model], trust.model_trust(model) if trust else None
    facts, faults, word = [f"held-out views {scores.psnr_db:.1f} dB"], [], GOOD
    if seen is None:
        facts.append("where it can be trusted was not measured")
    else:
        facts.append(f"{seen.surface.well:.0%} of the surface well seen")
        if seen.surface.well < GOOD_SURFACE:
            faults.append(f"{GOOD_SURFACE:.0%} or more are good")
    if scores.psnr_db < GOOD_PSNR_DB:
        faults.append(f"good scenes have {GOOD_PSNR_DB:g} dB or more")
    elif scores.ssim < GOOD_SSIM:
        faults.append(f"fine structure is lost (SSIM {scores.ssim:.2f})")
    faults += _doubt_cameras(sfm)
    failed = find_failed_views(metrics)
    if failed:
        others = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
        faults.append(
            f"{name_view(failed[0].name, frames)}{others} failed ({failed[0].psnr_db:.1f} dB)")
    if faults:
        word = FAIR
    if scores.psnr_db < POOR_PSNR_DB or (sfm is not None and sfm.trusted is False):
        word = POOR
    weakest = _find_weakest(metrics, model, trust, seen, frames)
    weak = [f"weak: {weakest}"] if weakest else []
    return Quality(word, "; ".join([", ".join(facts), *faults, *weak]))


def delivered_model(metrics: Metrics | None) -> str | None:
    """Returns the model that export takes: the compact one if there is one; None without any."""
    names = metrics.models if metrics else ()
    return "pruned" if "pruned" in names else next(iter(names), None)


def find_failed_views(metrics: Metrics | None) -> tuple[ViewScore, ...]:
    """Returns the held-out views that the model that export takes fails on, the worst first."""
    model = delivered_model(metrics)
    views = metrics.models[model].views if metrics and model else ()
    return tuple(sorted((view for view in views if view.psnr_db < POOR_PSNR_DB),
                        key=lambda view: view.psnr_db))


def find_doubtful_cameras(metrics: Metrics | None) -> tuple[ViewScore, ...]:
    """Returns the views that failed alone, as with a wrong camera, the worst first.

    They are as far below the median view as poor is below good: a model that was trained too short
    is blurred in all views.
    """
    model = delivered_model(metrics)
    views = metrics.models[model].views if metrics and model else ()
    usual = statistics.median([view.psnr_db for view in views] or [0.0])
    return tuple(view for view in find_failed_views(metrics)
                 if view.psnr_db < usual - (GOOD_PSNR_DB - POOR_PSNR_DB))


def name_view(name: str, frames: Sequence[Frame]) -> str:
    """Returns the name of a view with its time, where it is from a video."""
    seconds = next((frame.time_seconds for frame in frames if frame.name == name), None)
    if seconds is None:
        return name
    return f"{name} (at {int(seconds) // 60}:{int(seconds) % 60:02d} of the video)"


def _doubt_cameras(sfm: PlaceSummary | None) -> list[str]:
    """Returns what speaks against the cameras."""
    if sfm is None:
        return []
    if sfm.trusted is False:
        return ["the camera poses cannot be trusted"]
    if sfm.registered < GOOD_REGISTERED * sfm.frames:
        return [f"only {sfm.registered:,} of {sfm.frames:,} frames have a camera in it"]
    return []


def _find_weakest(
    metrics: Metrics, model: str, trust: TrustRecord | None, seen: ModelTrust | None,
    frames: Sequence[Frame],
) -> str:
    """Returns the largest poorly seen region, or else the view with the lowest PSNR, in words.

    Empty where that view failed, which is a fault.
    """
    regions = trust.poorly_seen if trust and seen else ()
    if regions and regions[0].share >= _LARGE_REGION:
        region = regions[0]
        return (f"what {name_view(region.frame, frames)} shows, {region.share:.0%} of the "
                f"surface: {region.cause}")
    worst = min(metrics.models[model].views, key=lambda view: view.psnr_db)
    return "" if worst.psnr_db < POOR_PSNR_DB else (
        f"{name_view(worst.name, frames)}, {worst.psnr_db:.1f} dB")
