"""What stages left in files, read into types.

A stale stage's files may have been changed by hand, and logs are vouched for by nobody: whatever
does not hold what it should becomes a FormatError, which the page tells in its place.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from recon_cli.errors import FormatError
from recon_cli.workspace.atomic import read_json

T = TypeVar("T")
BASE, PRUNED = MODELS = ("base", "pruned")


@dataclass(frozen=True)
class ViewRow:
    """The scores of one held-out view; see `recon_cli.evaluation.ViewScore`."""

    name: str
    psnr_db: float
    ssim: float
    lpips: float | None


@dataclass(frozen=True)
class ModelRow:
    """The scores of one model; see docs/workspace.md for what each key means."""

    psnr_db: float
    psnr_8bit_db: float
    ssim: float
    ssim_padded: float
    lpips: float | None
    gaussians: int
    bytes: int
    render_ms: float
    train_seconds: float | None
    gain_psnr_db: float | None
    seen_psnr_db: Mapping[str, float]
    views: tuple[ViewRow, ...]


@dataclass(frozen=True)
class Interval:
    """A mean difference over the views and its 95% interval; no bounds where there is one view."""

    mean: float
    low: float | None
    high: float | None


@dataclass(frozen=True)
class Metrics:
    """What evaluate says: models by key, pruned minus base by score, conventions by score."""

    models: Mapping[str, ModelRow]
    paired: Mapping[str, Interval]
    conventions: Mapping[str, str]
    unregistered: tuple[str, ...]
    masked_out: tuple[str, ...]


@dataclass(frozen=True)
class LogRow:
    """One report of a training; None where a row says nothing about it."""

    iteration: int
    seconds: float
    loss: float | None
    psnr_db: float | None
    gaussians: int | None
    goes_on_at: int | None


@dataclass(frozen=True)
class Trial:
    """One way to prune, scored on validation views after recovery."""

    score: str
    ratio: float | None
    gaussians: int
    psnr_db: float


@dataclass(frozen=True)
class Sweep:
    """What `recon prune --sweep` found; `of_train` is the digest of the training it started from,
    None where an older recon wrote it.
    """

    trials: tuple[Trial, ...]
    before_db: float
    score: str
    steps: int
    views: int
    of_train: str | None


def read_metrics(folder: Path) -> Metrics:
    """Returns the scores in evaluate's folder.

    Raises:
        FormatError: metrics.json is missing or does not hold them.
    """
    return _read(folder / "metrics.json", _metrics)


def read_log(path: Path) -> tuple[LogRow, ...]:
    """Returns the reports of a log.jsonl in order; a last line without its end is left out.

    Raises:
        FormatError: it is missing or does not hold them.
    """
    with _as_format_error(path):
        lines = path.read_text(encoding="utf-8").splitlines(True)
        return tuple(_log_row(json.loads(line)) for line in lines if line.endswith("\n"))


def read_sweep(path: Path) -> Sweep:
    """Returns the trials of a sweep.json.

    Raises:
        FormatError: it is missing or does not hold them.
    """
    return _read(path, lambda value: Sweep(
        tuple(Trial(str(one["score"]), _maybe(one["ratio"]), int(one["gaussians"]),
                    _number(one["recovered"]["psnr_db"])) for one in value["trials"]),
        _number(value["before"]["psnr_db"]), str(value["equal_seconds_of"]),
        int(value["recovery_steps"]), int(value["validation_views"]), value.get("of_train")))


def _metrics(value: Any) -> Metrics:
    return Metrics(
        {key: _model(value["models"][key]) for key in MODELS if key in value["models"]},
        {key: Interval(_number(one["mean"]), _maybe(one["low"]), _maybe(one["high"]))
         for key, one in value.get("pruned_minus_base", {}).items()},
        {key.removesuffix("_convention"): str(text) for key, text in value.items()
         if key.endswith("_convention")},
        tuple(map(str, value.get("unregistered_test", ()))),
        tuple(map(str, value.get("masked_out_test", ()))))


def _model(value: Any) -> ModelRow:
    views = tuple(ViewRow(
        str(view["name"]), _number(view["psnr_db"]), _number(view["ssim"]),
        _maybe(view.get("lpips"))) for view in value["views"])
    return ModelRow(
        _number(value["psnr_db"]), _number(value["psnr_8bit_db"]), _number(value["ssim"]),
        _number(value["ssim_padded"]), _maybe(value.get("lpips")), int(value["gaussians"]),
        int(value["bytes"]), _number(value["render_ms"]), _maybe(value["train_seconds"]),
        _maybe(value.get("gain_psnr_db")),
        {str(key): _number(one) for key, one in value["seen_psnr_db"].items()}, views)


def _log_row(value: Any) -> LogRow:
    return LogRow(
        int(value["iteration"]), _number(value["seconds"]), _maybe(value.get("loss")),
        _maybe(value.get("validation_psnr_db")), _maybe_int(value.get("gaussians")),
        _maybe_int(value.get("goes_on_at")))


def _number(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{value} is not finite")
    return number


def _maybe(value: Any) -> float | None:
    """Returns a number that may be missing; one that is not finite counts as missing."""
    return None if value is None or not math.isfinite(float(value)) else float(value)


def _maybe_int(value: Any) -> int | None:
    return None if value is None else int(value)


def _read(path: Path, parse: Callable[[Any], T]) -> T:
    value = read_json(path)
    with _as_format_error(path):
        return parse(value)


@contextmanager
def _as_format_error(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise FormatError(f"{path.name} cannot be read: {error.strerror}.") from error
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise FormatError(f"{path.name} does not hold what recon writes.") from error
