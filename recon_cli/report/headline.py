"""The top of the page: what was captured, the figures that are asked for first, the verdict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.progress import format_duration, format_megabytes
from recon_cli.report.records import BASE, PRUNED, Metrics
from recon_cli.report.stage_status import Standing
from recon_cli.workspace.summaries import IngestSummary, SfmSummary

_UNITS = {"_db": "dB", "_px": "px", "_deg": "degrees", "_255": "of 255"}
_NAMES = {"psnr": "PSNR", "ssim": "SSIM", "gaussians": "Gaussians", "cuda": "CUDA"}


def facts(summary: Mapping[str, Any]) -> tuple[tuple[str, str], ...]:
    """Returns (what, figure) for everything in a summary that is one number or word.

    Nothing is told of memory that was not used: a CPU has no peak of a GPU.
    """
    return tuple(
        _fact(name, value) for name, value in summary.items()
        if value is not None and value != "" and not isinstance(value, (list, dict))
        and not (name.endswith("bytes") and value == 0))


def _fact(name: str, value: Any) -> tuple[str, str]:
    if isinstance(value, bool):
        return _named(name), "yes" if value else "no"
    if name.endswith("seconds"):
        return f"{_named(name.removesuffix('_seconds'))} time", format_duration(float(value))
    if name.endswith("bytes"):
        heading = _named(name.removesuffix("_bytes")).replace("bytes", "size")
        return heading, format_megabytes(int(value))
    for ending, unit in _UNITS.items():
        if ending in name:
            return _named(name.replace(ending, "")), f"{value:.4g} {unit}"
    if isinstance(value, int):
        return _named(name), f"{value:,}"
    return _named(name), f"{value:.4g}" if isinstance(value, float) else str(value)


def _named(name: str) -> str:
    return " ".join(_NAMES.get(word, word) for word in name.split("_"))


_KINDS = {
    "video": "a video", "photos": "photos", "mixed": "videos and photos",
    "replica": "a Replica sequence with poses", "scannet": "a ScanNet scan with poses",
    "colmap": "a COLMAP model with its images", "transforms": "a transforms.json with poses"}
_LACKING = "-"


@dataclass(frozen=True)
class Tile:
    """One figure.

    Attributes:
        label: what it is.
        value: the figure.
        detail: a few words below.
        stale: it is of a result that is not fresh.
    """

    label: str
    value: str
    detail: str = ""
    stale: bool = False


@dataclass(frozen=True)
class Verdict:
    """Whether the cameras can be trusted.

    Attributes:
        level: good, warn or unknown.
        text: one sentence.
        lines: why, sentences.
    """

    level: str
    text: str
    lines: tuple[str, ...] = ()


@dataclass(frozen=True)
class Headline:
    """The top of the page.

    Attributes:
        kind: of the capture, in words.
        sources: names of the inputs.
        tiles: the figures.
        verdict: on the mapping.
        gone: inputs that are no longer there.
    """

    kind: str
    sources: tuple[str, ...]
    tiles: tuple[Tile, ...]
    verdict: Verdict
    gone: tuple[str, ...]


def headline(stages: Mapping[str, Standing], metrics: Metrics | None) -> Headline:
    """Returns the top of the page of a workspace whose ingest is there."""
    ingest = stages["ingest"]
    basis = ingest.manifest.basis if ingest.manifest else None
    summary = ingest.read_summary(IngestSummary)
    kind = summary.kind if summary else ""
    return Headline(
        _KINDS.get(kind, kind),
        tuple(Path(source.path).name for source in basis.sources) if basis else (),
        tuple(_tiles(stages, metrics)), verdict(stages["sfm"]), ingest.gone)


def verdict(sfm: Standing) -> Verdict:
    """Returns what sfm found out about its own result, in plain words."""
    if not sfm.there:
        return Verdict("unknown", "The cameras have not been found yet.")
    summary = sfm.read_summary(SfmSummary)
    if summary is None:
        return Verdict("unknown", "The cameras were found by another version of recon.")
    counted = f"{summary.registered:,} of {summary.frames:,} frames have a camera"
    more = (*summary.lines, *_apart(summary), *summary.world.sentences)
    if summary.trusted is None:
        source = "; the poses came with the data set" if summary.poses else ""
        return Verdict("unknown", f"{counted}{source}.", more)
    if summary.trusted:
        return Verdict("good", f"The mapping can be trusted: {counted}.", more[1:])
    return Verdict("warn", f"The mapping is not to be trusted, although {counted}.", more[1:])


def _apart(summary: SfmSummary) -> list[str]:
    sentences = [f"{name} was taken out of the model: {reason}."
                 for name, reason in summary.rejected.items()]
    if summary.apart:
        sentences.append("The capture fell apart; left aside are parts of "
                         f"{', '.join(str(len(part)) for part in summary.apart)} frames.")
    return sentences


def _tiles(stages: Mapping[str, Standing], metrics: Metrics | None) -> list[Tile]:
    ingest, sfm, train, prune = (stages[name] for name in ("ingest", "sfm", "train", "prune"))
    return [
        _frames(ingest), _registered(sfm),
        _of(train, "Gaussians", _count(train.summary, "gaussians"), _pruned(train, prune)),
        *_scores(stages["evaluate"], metrics),
        _training(train)]


def _frames(ingest: Standing) -> Tile:
    summary = ingest.read_summary(IngestSummary)
    if summary is None:
        return Tile("frames", _LACKING, "cannot be read", not ingest.fresh)
    size = f"{summary.width}x{summary.height}, {summary.held_out:,} held out"
    return Tile("frames", f"{summary.frames:,}", size, not ingest.fresh)


def _registered(sfm: Standing) -> Tile:
    summary = sfm.read_summary(SfmSummary)
    if summary is None:
        return _of(sfm, "registered", _LACKING, "")
    share = f"{summary.registered / summary.frames:.0%} of the frames" if summary.frames else ""
    return _of(sfm, "registered", f"{summary.registered:,}", share)


def _training(train: Standing) -> Tile:
    if train.manifest is None:
        return _of(train, "training", "", "")
    run = train.manifest.run
    return _of(train, "training", format_duration(run.seconds),
               f"peak {format_megabytes(run.peak_memory_bytes)}")


def _pruned(train: Standing, prune: Standing) -> str:
    """Returns the pruned count beside that of the base; empty where there is none."""
    if not prune.there:
        return ""
    stale = train.fresh and not prune.fresh  # else the figure of the base is called stale already
    return f"pruned {_count(prune.summary, 'gaussians')}{' (stale)' if stale else ''}"


def _of(stage: Standing, label: str, value: str, detail: str) -> Tile:
    if not stage.there:
        return Tile(label, _LACKING, f"{stage.name} is {stage.state}")
    return Tile(label, value, detail, not stage.fresh)


def _scores(evaluate: Standing, metrics: Metrics | None) -> list[Tile]:
    if metrics is None or not metrics.models:
        text = f"evaluate is {evaluate.state}" if not evaluate.there else "cannot be read"
        return [Tile("held-out PSNR", _LACKING, text), Tile("held-out SSIM", _LACKING, text)]
    first = next(iter(metrics.models.values()))
    also = metrics.models.get(PRUNED) if BASE in metrics.models else None
    return [
        Tile("held-out PSNR", f"{first.psnr_db:.2f} dB",
             f"pruned {also.psnr_db:.2f} dB" if also else "", not evaluate.fresh),
        Tile("held-out SSIM", f"{first.ssim:.4f}",
             f"pruned {also.ssim:.4f}" if also else "", not evaluate.fresh)]


def _count(summary: Mapping[str, Any], key: str) -> str:
    value = summary.get(key)
    return f"{value:,}" if isinstance(value, int) else _LACKING
