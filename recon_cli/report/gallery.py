"""The held-out views for the slider: truth, render and difference, within a budget of bytes.

Pictures are WebP in data URIs of one HTML file; sizes and then qualities shrink until they fit.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from PIL import Image

from recon_cli.errors import FormatError
from recon_cli.evaluation.scores import ERROR_GAIN, Metrics, ViewScore
from recon_cli.io.images import fit_image, fit_size, read_png
from recon_cli.progress import NullProgress, Progress

MAX_FILE_BYTES = 15_000_000
_HIDDEN = (96, 96, 96)  # of masked pixels in a difference: no colour of the map


@dataclass(frozen=True)
class Encoding:
    """How pictures are stored: longest side in pixels and WebP's quality, 0 to 100."""

    longest: int
    quality: int


# Tried in this order: sizes before qualities, because a slider compares blur, not pixels.
ENCODINGS = (
    Encoding(1600, 86), Encoding(1200, 84), Encoding(900, 82), Encoding(680, 80),
    Encoding(560, 78), Encoding(480, 75), Encoding(420, 73), Encoding(360, 70), Encoding(300, 66),
    Encoding(240, 62))
THUMB, MOST_THUMBS = Encoding(480, 72), 8  # beside a text, and how many a section shows
_SHEET = Encoding(2000, 80)  # as ingest draws it, so that its captions can be read
_SHEET_BYTES = 900_000
# Of WebP, 0 to 6: the default, 4, takes twice as long for 3% less bytes and .5 dB of 41
_METHOD = 2
_SAMPLE = 3  # views whose size is taken for that of all
_SAFE = 0.92  # of the budget that an estimate may fill

_ViewScores = Mapping[str, ViewScore]  # of one view, by model


@dataclass(frozen=True)
class GalleryView:
    """One view on the page; pictures are data URIs."""

    name: str  # of the frame
    width: int  # in pixels on the page
    height: int
    truth: Markup
    renders: Mapping[str, Markup]  # by model
    differences: Mapping[str, Markup]  # by model
    scores: _ViewScores
    masked: bool  # a part of it is not scored

    @property
    def size(self) -> int:
        """Bytes that its pictures take in the file."""
        return sum(map(len, (self.truth, *self.renders.values(), *self.differences.values())))


@dataclass(frozen=True)
class Gallery:
    """The views of the page, by rising PSNR of the first model."""

    views: tuple[GalleryView, ...] = ()
    full: tuple[int, int] = (0, 0)  # (width, height) of the largest one as evaluate wrote it
    encoding: Encoding | None = None  # None without views
    left_out: int = 0  # views for which there was no room
    damaged: tuple[str, ...] = ()  # why views are missing, a sentence each
    # of differences, as in evaluate/difference
    gain: ClassVar[int] = ERROR_GAIN
    most_error: ClassVar[int] = 256 // gain  # in 1/255; beyond, colours no longer change

    @property
    def stops(self) -> list[str]:
        """CSS colours of differences from none to the most, evenly spread."""
        levels = np.linspace(0, 255, 9).round().astype(np.uint8)[None]
        return [f"rgb({r},{g},{b})" for r, g, b in apply_colormap(levels)[0]]

    @property
    def scaled(self) -> bool:
        """Whether any view is smaller here than evaluate wrote it."""
        return self.encoding is not None and max(self.full) > self.encoding.longest


@dataclass(frozen=True, eq=False)
class _ViewPixels:
    """The files of evaluate on one view."""

    truth: NDArray[np.uint8]  # [H, W, 3] RGB
    renders: Mapping[str, NDArray[np.uint8]]  # by model
    hidden: NDArray[np.bool_] | None  # [H, W], True where a mask ignores the pixel


def build_gallery(
    folder: Path, metrics: Metrics, budget: int, progress: Progress | None = None
) -> Gallery:
    """Returns the held-out views in evaluate's folder as large as `budget` bytes allow.

    The best views are left out where not all fit at the lowest quality.
    """
    by_name: dict[str, dict[str, ViewScore]] = {}
    for key, model in metrics.models.items():
        for view in model.views:
            by_name.setdefault(view.name, {})[key] = view
    order = sorted(by_name.values(), key=lambda scores: next(iter(scores.values())).psnr_db)
    sample = [pixels for _, pixels in _iterate(folder, order[:: max(1, len(order) // _SAMPLE)])]
    for encoding in ENCODINGS:
        last = encoding == ENCODINGS[-1]
        expected = sum(_encode_view("", {}, pixels, encoding).size for pixels in sample)
        if not last and expected * len(order) > _SAFE * budget * max(1, len(sample)):
            continue
        gallery = _encode_all(folder, order, encoding, budget, progress or NullProgress())
        if last or not gallery.left_out:
            break
    return gallery


def _encode_all(
    folder: Path, order: Sequence[_ViewScores], encoding: Encoding, budget: int, progress: Progress
) -> Gallery:
    """Returns as many views as fit, all stored in one way."""
    views: list[GalleryView] = []
    damaged: list[str] = []
    full, used = (0, 0), 0
    with progress.bar("pictures", len(order), unit="view") as bar:
        for scores, pixels in _iterate(folder, order, damaged):
            height, width = pixels.truth.shape[:2]
            full = max(full, (width, height), key=max)
            view = _encode_view(_name(scores), scores, pixels, encoding)
            used += view.size
            if used > budget:
                break
            views.append(view)
            bar.advance()
    left_out = len(order) - len(views) - len(damaged) if used > budget else 0
    return Gallery(tuple(views), full, encoding if views else None, left_out, tuple(damaged))


def _name(scores: _ViewScores) -> str:
    return next(iter(scores.values())).name


def _iterate(
    folder: Path, order: Sequence[_ViewScores], damaged: list[str] | None = None
) -> Iterator[tuple[_ViewScores, _ViewPixels]]:
    """Yields the readable views; appends why others cannot be read to `damaged`."""
    for scores in order:
        with note_damage([] if damaged is None else damaged, f"{_name(scores)} is not shown"):
            yield scores, _read_pixels(folder, scores)


def _read_pixels(folder: Path, scores: _ViewScores) -> _ViewPixels:
    # only the last part of a name: metrics.json may have been edited by hand
    file = f"{Path(_name(scores)).stem}.png"
    truth = read_png(folder / "truth" / file)
    renders = {key: read_png(folder / "renders" / key / file) for key in scores}
    if any(render.shape != truth.shape for render in renders.values()):
        raise FormatError("truth and render differ in size")
    first = next(iter(scores))
    return _ViewPixels(truth, renders, _find_hidden(
        truth, renders[first], folder / "difference" / first / file))


def _find_hidden(
    truth: NDArray[np.uint8], render: NDArray[np.uint8], path: Path
) -> NDArray[np.bool_] | None:
    """Returns where evaluate scored nothing: its difference is black where the pixels differ."""
    try:
        difference = read_png(path)
    except (FormatError, OSError):
        return None
    if difference.shape != truth.shape:
        return None
    hidden = (difference == 0).all(axis=2) & (truth != render).any(axis=2)
    return np.asarray(hidden) if hidden.any() else None


def _encode_view(
    name: str, scores: _ViewScores, pixels: _ViewPixels, encoding: Encoding
) -> GalleryView:
    longest, quality = encoding.longest, encoding.quality
    truth = fit_image(pixels.truth, longest)
    return GalleryView(
        name, truth.shape[1], truth.shape[0], data_uri(truth, quality),
        {key: data_uri(fit_image(image, longest), quality)
         for key, image in pixels.renders.items()},
        {key: data_uri(draw_difference(pixels.truth, image, pixels.hidden, longest), quality)
         for key, image in pixels.renders.items()},
        scores, pixels.hidden is not None)


@contextmanager
def note_damage(damaged: list[str], text: str) -> Iterator[None]:
    """Appends `text` with the reason to `damaged` if a file cannot be read."""
    try:
        yield
    except (FormatError, OSError) as error:
        damaged.append(f"{text}: {error}")


def read_picture(path: Path, encoding: Encoding = THUMB) -> Markup:
    """Returns a PNG file as a data URI; FormatError or OSError if it cannot be read."""
    return data_uri(fit_image(read_png(path), encoding.longest), encoding.quality)


def data_uri(image: NDArray[np.uint8], quality: int) -> Markup:
    """Returns RGB pixels [H, W, 3] as a data URI of WebP."""
    data = io.BytesIO()
    Image.fromarray(image).save(data, "WEBP", quality=quality, method=_METHOD)
    return embed(data.getvalue(), "webp")


def embed(picture: bytes, kind: str) -> Markup:
    """Returns the file of a picture as a data URI, in which nothing needs escaping."""
    return Markup(f"data:image/{kind};base64,{base64.b64encode(picture).decode()}")


def encode_sheet(image: NDArray[np.uint8]) -> Markup:
    """Returns a contact sheet as large as its share of the file allows."""
    for encoding in (_SHEET, *ENCODINGS):
        uri = data_uri(fit_image(image, encoding.longest), encoding.quality)
        if len(uri) <= _SHEET_BYTES:
            break
    return uri


def draw_difference(
    truth: NDArray[np.uint8], render: NDArray[np.uint8], hidden: NDArray[np.bool_] | None,
    longest: int,
) -> NDArray[np.uint8]:
    """Returns the error of a render in colours, RGB [h, w, 3], with a longest side of `longest`.

    The mean absolute difference of the channels is reduced by area, so that a picture of any size
    shows the same error. `hidden` [H, W] are the masked pixels.
    """
    difference = cv2.absdiff(truth, render)
    # channel by channel: a mean over the last axis takes six times as long
    error = (difference[..., 0].astype(np.float32) + difference[..., 1] + difference[..., 2]) / 3
    size = fit_size(error.shape[1], error.shape[0], longest)
    if size != error.shape[::-1]:
        error = cv2.resize(error, size, interpolation=cv2.INTER_AREA)
    colors = apply_colormap(np.rint(error * ERROR_GAIN).clip(0, 255).astype(np.uint8))
    if hidden is not None and hidden.any():
        small = cv2.resize(hidden.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        colors[small > 0.5] = _HIDDEN
    return colors


def apply_colormap(levels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Returns levels [H, W] as RGB from black over red to a pale yellow (matplotlib's inferno)."""
    return np.ascontiguousarray(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1])
