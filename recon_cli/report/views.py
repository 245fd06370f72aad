"""The held-out views for the slider: truth, render and difference of each model, in a budget."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from recon_cli.errors import FormatError
from recon_cli.io.frames import read_png
from recon_cli.progress import NullProgress, Progress
from recon_cli.report.images import RUNGS, Rung, data_uri, error_of, reduced
from recon_cli.report.records import Metrics, ViewRow

_SAMPLE = 3  # views whose size is taken for that of all
_SAFE = 0.92  # of the budget that an estimate may fill


@dataclass(frozen=True)
class Shown:
    """One view on the page.

    Attributes:
        name: of the frame.
        width: in pixels on the page.
        height: in pixels on the page.
        truth: data URI of the held-out pixels.
        renders: data URI by model.
        differences: data URI by model.
        scores: by model.
        masked: a part of it is not scored.
    """

    name: str
    width: int
    height: int
    truth: Markup
    renders: Mapping[str, Markup]
    differences: Mapping[str, Markup]
    scores: Mapping[str, ViewRow]
    masked: bool

    @property
    def size(self) -> int:
        """Bytes that it takes in the file."""
        return sum(map(len, (self.truth, *self.renders.values(), *self.differences.values())))


@dataclass(frozen=True)
class Gallery:
    """The views of the page, worst first.

    Attributes:
        views: by rising PSNR of the first model.
        full: (width, height) of the largest one as evaluate left it.
        rung: how they are stored; None where there are none.
        left_out: how many more there are, for which there was no room.
        damaged: why views are missing, a sentence each.
    """

    views: tuple[Shown, ...]
    full: tuple[int, int]
    rung: Rung | None
    left_out: int
    damaged: tuple[str, ...]

    @property
    def scaled(self) -> bool:
        """Whether any is smaller here than evaluate left it."""
        return self.rung is not None and max(self.full) > self.rung.longest


@dataclass(frozen=True, eq=False)
class _Pixels:
    """What evaluate left of one view, RGB [H, W, 3], and where a mask ignores it [H, W]."""

    truth: NDArray[np.uint8]
    renders: Mapping[str, NDArray[np.uint8]]
    hidden: NDArray[np.bool_] | None


_Scores = Mapping[str, ViewRow]


def gallery(
    folder: Path, metrics: Metrics, budget: int, progress: Progress | None = None
) -> Gallery:
    """Returns the held-out views as large as the budget allows, at the last resort fewer of them.

    Args:
        folder: of evaluate.
        metrics: its scores.
        budget: bytes of the file that pictures of views may take.
        progress: shows a bar; None for none.
    """
    order = _worst_first(metrics)
    sample = [pixels for _, pixels in _readable(folder, order[:: max(1, len(order) // _SAMPLE)])]
    for rung in RUNGS:
        last = rung == RUNGS[-1]
        expected = sum(_stored("", {}, pixels, rung).size for pixels in sample)
        if not last and expected * len(order) > _SAFE * budget * max(1, len(sample)):
            continue
        found = _at(folder, order, rung, budget, progress or NullProgress())
        if last or not found.left_out:
            break
    return found


def _at(
    folder: Path, order: Sequence[_Scores], rung: Rung, budget: int, progress: Progress
) -> Gallery:
    """Returns as many views as fit, stored in one way."""
    views: list[Shown] = []
    damaged: list[str] = []
    full, used = (0, 0), 0
    with progress.bar("pictures", len(order), unit="view") as bar:
        for scores, pixels in _readable(folder, order, damaged):
            height, width = pixels.truth.shape[:2]
            full = max(full, (width, height), key=max)
            one = _stored(next(iter(scores.values())).name, scores, pixels, rung)
            used += one.size
            if used > budget:
                break
            views.append(one)
            bar.advance()
    left_out = len(order) - len(views) - len(damaged) if used > budget else 0
    return Gallery(tuple(views), full, rung if views else None, left_out, tuple(damaged))


def _worst_first(metrics: Metrics) -> list[_Scores]:
    """Returns the scores of each view by model, by rising PSNR of the first model."""
    by_name: dict[str, dict[str, ViewRow]] = {}
    for key, model in metrics.models.items():
        for view in model.views:
            by_name.setdefault(view.name, {})[key] = view
    return sorted(by_name.values(), key=lambda scores: next(iter(scores.values())).psnr_db)


def _readable(
    folder: Path, order: Sequence[_Scores], damaged: list[str] | None = None
) -> Iterator[tuple[_Scores, _Pixels]]:
    """Yields the views whose pictures are whole and notes why the others are not."""
    for scores in order:
        try:
            yield scores, _read(folder, scores)
        except (FormatError, OSError) as error:
            if damaged is not None:
                name = next(iter(scores.values())).name
                damaged.append(f"{name} is not shown: {error}")


def _read(folder: Path, scores: _Scores) -> _Pixels:
    # only the last part of a name counts: metrics.json may have been changed by hand
    file = f"{Path(next(iter(scores.values())).name).stem}.png"
    truth = read_png(folder / "truth" / file)
    renders = {key: read_png(folder / "renders" / key / file) for key in scores}
    if any(render.shape != truth.shape for render in renders.values()):
        raise FormatError("truth and render are not of one size")
    first = next(iter(scores))
    return _Pixels(truth, renders, _hidden(
        truth, renders[first], folder / "difference" / first / file))


def _hidden(
    truth: NDArray[np.uint8], render: NDArray[np.uint8], difference: Path
) -> NDArray[np.bool_] | None:
    """Returns where evaluate scored nothing: its difference is black where the pixels differ."""
    try:
        told = read_png(difference)
    except (FormatError, OSError):
        return None
    if told.shape != truth.shape:
        return None
    hidden = (told == 0).all(axis=2) & (truth != render).any(axis=2)
    return np.asarray(hidden) if hidden.any() else None


def _stored(name: str, scores: _Scores, pixels: _Pixels, rung: Rung) -> Shown:
    truth = reduced(pixels.truth, rung.longest)
    return Shown(
        name, truth.shape[1], truth.shape[0], data_uri(truth, rung.quality),
        {key: data_uri(reduced(image, rung.longest), rung.quality)
         for key, image in pixels.renders.items()},
        {key: data_uri(error_of(pixels.truth, image, pixels.hidden, rung.longest), rung.quality)
         for key, image in pixels.renders.items()},
        scores, pixels.hidden is not None)
