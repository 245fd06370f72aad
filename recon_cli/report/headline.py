"""The top of the page: the capture, the main figures, whether the camera poses can be trusted."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.errors import list_names
from recon_cli.evaluation.scores import Metrics, ViewScore
from recon_cli.progress import format_duration, format_megabytes
from recon_cli.report.records import BASE, PRUNED
from recon_cli.report.stage_status import StageReport, StageReports
from recon_cli.trust.quality import delivered_model, find_doubtful_cameras
from recon_cli.trust.records import TrustRecord
from recon_cli.workspace.summaries import IngestSummary, PlaceSummary, PruneSummary, TrainSummary

_KINDS = {
    "video": "a video", "photos": "photos", "mixed": "videos and photos",
    "replica": "a Replica sequence with poses", "scannet": "a ScanNet scan with poses",
    "7scenes": "a 7-Scenes sequence with poses", "tum": "a TUM RGB-D sequence with poses",
    "colmap": "a COLMAP model with its images", "transforms": "a transforms.json with poses"}
_LACKING = "-"
_UNITS = {"_db": "dB", "_px": "px", "_deg": "degrees", "_255": "of 255"}
_WORDS = {"psnr": "PSNR", "ssim": "SSIM", "gaussians": "Gaussians", "cuda": "CUDA"}


@dataclass(frozen=True)
class Tile:
    """One of the main figures."""

    label: str
    value: str
    detail: str = ""  # a few words below
    stale: bool = False  # it is of a result that is not fresh


@dataclass(frozen=True)
class PosesVerdict:
    """Whether the camera poses can be trusted."""

    level: str  # good, warn or unknown
    text: str  # one sentence
    lines: tuple[str, ...] = ()  # reasons, a sentence each


@dataclass(frozen=True)
class Headline:
    """The top of the page."""

    kind: str  # of the capture, in words
    sources: tuple[str, ...]  # names of the inputs
    tiles: tuple[Tile, ...]
    verdict: PosesVerdict
    gone: tuple[str, ...]  # inputs that no longer exist


def build_headline(
    stages: StageReports, metrics: Metrics | None, trust: TrustRecord | None = None
) -> Headline:
    """Returns the top of the page of a workspace that has an ingest."""
    ingest = stages["ingest"]
    sources = ingest.manifest.key.sources if ingest.manifest else ()
    summary = ingest.read_summary(IngestSummary)
    kind = summary.kind if summary else ""
    return Headline(
        _KINDS.get(kind, kind), tuple(Path(source.path).name for source in sources),
        tuple(_build_tiles(stages, metrics, trust)),
        judge_poses(stages["place"], find_doubtful_cameras(metrics)), ingest.gone)


def judge_poses(place: StageReport, failed: Sequence[ViewScore] = ()) -> PosesVerdict:
    """Returns the verdict of sfm on the cameras, unless views that failed contradict it."""
    if not place.there:
        return PosesVerdict("unknown", "There are no camera poses yet.")
    summary = place.read_summary(PlaceSummary)
    if summary is None:
        return PosesVerdict("unknown", "The camera poses are from another version of recon.")
    count = f"{summary.registered:,} of {summary.frames:,} frames have a camera"
    left_out = len(summary.left_out)
    # the first line repeats the verdict, except where it says why only a part is kept
    cut = bool(summary.broken) or left_out > 0
    repeated = 1 if summary.verdict is not None and not cut else 0
    lines = (*summary.lines[repeated:], *(f"{name} was removed from the model: {reason}."
                                          for name, reason in summary.rejected.items()))
    if summary.apart:
        counts = ", ".join(str(len(part)) for part in summary.apart)
        lines += (f"The capture has disconnected parts; left out are parts of {counts} frames.",)
    lines += summary.world.sentences
    if summary.trusted is None:
        whose = "; the poses came with the data set" if summary.poses else ""
        return PosesVerdict("unknown", f"{count}{whose}.", lines)
    if not summary.trusted:
        return PosesVerdict("warn", f"The camera poses cannot be trusted, although {count}.", lines)
    if summary.part is not None:
        return PosesVerdict("warn", (
            f"The capture is in {len(summary.parts)} parts, see Capture. This is part "
            f"{summary.part}, whose camera poses can be trusted: {count}."), lines)
    if left_out:
        return PosesVerdict("warn", (
            f"Only a part of the capture is kept, whose camera poses can be trusted: {count}; "
            f"{left_out:,} are left out whose cameras could not be trusted."), lines)
    if summary.rough:
        return PosesVerdict("warn", (
            f"{count}, and nothing speaks against them, but {len(summary.rough)} of them are known "
            f"badly: {list_names(summary.rough)}."), lines)
    if failed:
        others = f" and {len(failed) - 1} more" if len(failed) > 1 else ""
        return PosesVerdict("warn", (
            f"{count}, and the mapping found no fault in them. But {failed[0].name}{others} failed "
            f"({failed[0].psnr_db:.1f} dB): its camera may be wrong, see Views."), lines)
    return PosesVerdict("good", f"The camera poses can be trusted: {count}.", lines)


def _build_tiles(
    stages: StageReports, metrics: Metrics | None, trust: TrustRecord | None
) -> Iterator[Tile]:
    ingest, place, train, prune = (
        stages[name] for name in ("ingest", "place", "train", "prune"))
    yield from _score_tiles(stages["evaluate"], metrics, trust)
    frames, cameras = ingest.read_summary(IngestSummary), place.read_summary(PlaceSummary)
    detail = (f"{frames.width}x{frames.height}, {frames.held_out:,} held out" if frames
              else "cannot be read")
    if cameras and cameras.part is not None:
        detail += f", part {cameras.part} of {len(cameras.parts)}"
    elif cameras and cameras.left_out:
        detail += f", {len(cameras.left_out):,} left out"
    if cameras:
        yield Tile("cameras", f"{cameras.registered:,} of {cameras.frames:,}", detail,
                   not (place.fresh and ingest.fresh))
    else:
        yield Tile("frames", f"{frames.frames:,}" if frames else _LACKING, detail, not ingest.fresh)
    model = prune if prune.there else train
    original = f"original {_count(train, TrainSummary)}" if prune.there and train.there else ""
    if original and model.fresh:  # if the compact one is stale too, its tile says so already
        original += train.stale_suffix
    yield _stage_tile(
        model, "Gaussians", _count(model, PruneSummary if prune.there else TrainSummary), original)
    runs = [stage.manifest.run for stage in stages.values() if stage.manifest]
    own = f"training {format_duration(train.manifest.run.seconds)}" if train.manifest else ""
    yield Tile("time", format_duration(sum(run.seconds for run in runs)), own,
               train.there and not train.fresh)


def _stage_tile(stage: StageReport, label: str, value: str, detail: str) -> Tile:
    if not stage.there:
        return Tile(label, _LACKING, f"{stage.name} is {stage.state}")
    return Tile(label, value, detail, not stage.fresh)


def _count(stage: StageReport, kind: type[TrainSummary] | type[PruneSummary]) -> str:
    summary = stage.read_summary(kind)
    return f"{summary.gaussians:,}" if summary else _LACKING


def _score_tiles(
    evaluate: StageReport, metrics: Metrics | None, trust: TrustRecord | None
) -> Iterator[Tile]:
    model = delivered_model(metrics)
    if metrics is None or model is None:
        text = "cannot be read" if evaluate.there else f"evaluate is {evaluate.state}"
        yield Tile("held-out views", _LACKING, text)
        return
    scores = metrics.models[model]
    original = metrics.models.get(BASE) if model == PRUNED else None
    yield Tile("held-out views", f"{scores.psnr_db:.2f} dB", ", ".join([
        f"SSIM {scores.ssim:.3f}", *([f"original {original.psnr_db:.2f} dB"] if original else [])]),
        not evaluate.fresh)
    seen = trust.model_trust(model) if trust else None
    if seen is not None:
        yield Tile("well seen", f"{seen.surface.well:.0%}", "of the surface", not evaluate.fresh)


def format_facts(summary: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Returns (label, figure) for each number or word of a summary, without unused memory."""
    return tuple(
        _format_fact(name, value) for name, value in summary.items()
        if value is not None and value != "" and not isinstance(value, (list, dict))
        and not (name.endswith("bytes") and value == 0))


def _format_fact(name: str, value: Any) -> tuple[str, str]:
    if isinstance(value, bool):
        return _label(name), "yes" if value else "no"
    if name.endswith("seconds"):
        return f"{_label(name.removesuffix('_seconds'))} time", format_duration(float(value))
    if name.endswith("bytes"):
        label = _label(name.removesuffix("_bytes")).replace("bytes", "size")
        return label, format_megabytes(int(value))
    for ending, unit in _UNITS.items():
        if ending in name:
            return _label(name.replace(ending, "")), f"{value:.4g} {unit}"
    if isinstance(value, int):
        return _label(name), f"{value:,}"
    return _label(name), f"{value:.4g}" if isinstance(value, float) else str(value)


def _label(name: str) -> str:
    return " ".join(_WORDS.get(word, word) for word in name.split("_"))
