"""The contact sheet: one picture of the kept and dropped frames of a capture, with the reasons.

Its size is bounded: where not all frames fit, an even sample of each kind is shown.
"""

from __future__ import annotations

import io
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from recon_cli.capture.frame_selection import MEANINGS, FrameCandidate, Reason, count_reasons
from recon_cli.workspace import atomic

SHEET = "contact.png"
MAX_BYTES = 3_000_000
# Tried until the file is small enough; the last takes at most half a byte a pixel.
PALETTES = (256, 64, 16)
MAX_WIDTH = 2000  # pixels; two sheets side by side on a large screen
MAX_PIXELS = MAX_WIDTH * 2250  # usually 1.1 MB
THUMB_PIXELS = 14_000  # 158x89 at 16:9
# Kept frames get at most this share of the cells, to leave room for dropped ones.
KEPT_SHARE = 0.65
TEXT = 12  # pixels
BORDER, GAP, LINE = TEXT // 3, TEXT // 2, TEXT * 5 // 4
CELL_WIDTH = 118  # at least, for the caption
HELD_OUT = "held out"

Colour = tuple[int, int, int]
Words = list[tuple[str, Colour | None]]  # texts, some with a colour swatch
PAPER, INK, FAINT = (255, 255, 255), (20, 20, 20), (110, 110, 110)
# Okabe and Ito (2008): eight colours that people with any colour vision tell apart.
COLOURS: dict[str, Colour] = {
    Reason.KEPT: (0, 158, 115), HELD_OUT: (0, 114, 178), Reason.BLURRED: (213, 94, 0),
    Reason.CLIPPED: (20, 20, 20), Reason.DUPLICATE: (204, 121, 167),
    Reason.EXPOSURE: (230, 159, 0), Reason.CLOSE: (190, 190, 190), Reason.DAMAGED: (240, 228, 66)}
MOST_OBLONG = 4  # width to height of a cell; a longer picture, such as a panorama, has margins


@dataclass(frozen=True)
class _SheetLayout:
    """Sizes in pixels of a thumbnail and of its cell, and the number of cells."""

    thumb: tuple[int, int]
    cell: tuple[int, int]
    most: int
    columns: int


class ContactSheet:
    """Collects thumbnails of the frames, [height, width], of a capture and draws them in order."""

    def __init__(
        self, title: str, candidates: Sequence[FrameCandidate], width: int, height: int
    ) -> None:
        self._title, self._candidates = title, candidates
        self._several = len({candidate.source for candidate in candidates}) > 1
        self._layout = _plan_layout(width, height)
        self._sample = _choose_sample(candidates, self._layout.most)
        self._thumbs: dict[int, Image.Image] = {}

    @property
    def wanted(self) -> frozenset[int]:
        """Indices of the candidates whose pixels the sheet shows."""
        return frozenset(candidate.index for candidate in self._sample)

    def add(self, index: int, rgb: NDArray[np.uint8]) -> None:
        """Adds the pixels [H, W, 3] of a candidate; those that are not shown are ignored."""
        if index in self.wanted:
            self._thumbs[index] = _thumbnail(rgb, self._layout.thumb)

    def write(self, path: Path, held_out: Collection[str]) -> None:
        """Draws the sheet as a PNG, atomically; `held_out` are names of stored frames."""
        width, height = self._layout.cell
        columns = min(self._layout.columns, max(1, len(self._sample)))
        head = _wrap(self._heading(held_out), max(columns * width, 4 * width))
        top = GAP + len(head) * LINE + GAP
        rows = math.ceil(len(self._sample) / columns)
        canvas = Image.new("RGB", (max(columns, 4) * width + GAP, top + rows * height + GAP), PAPER)
        draw = ImageDraw.Draw(canvas)
        for line, words in enumerate(head):
            _write_words(draw, words, GAP, GAP + line * LINE)
        for place, candidate in enumerate(self._sample):
            row, column = divmod(place, columns)
            kind = _kind(candidate, held_out)
            self._draw_cell(canvas, candidate, kind, GAP + column * width, top + row * height)
        atomic.write_bytes(path, _encode(canvas))

    def _draw_cell(
        self, canvas: Image.Image, candidate: FrameCandidate, kind: str, x: int, y: int
    ) -> None:
        draw = ImageDraw.Draw(canvas)
        thumb_width, thumb_height = self._layout.thumb
        right, bottom = x + thumb_width + 2 * BORDER, y + thumb_height + 2 * BORDER
        draw.rectangle((x, y, right - 1, bottom - 1), COLOURS[kind])
        thumb = self._thumbs.get(candidate.index)
        if thumb is None:
            draw.rectangle((x + BORDER, y + BORDER, right - BORDER - 1, bottom - BORDER - 1), PAPER)
        else:
            canvas.paste(thumb, (x + BORDER, y + BORDER))
        font, width = ImageFont.load_default(TEXT), self._layout.cell[0] - GAP
        like = "" if candidate.like is None else f" #{candidate.like}"
        draw.text((x, bottom), _shorten(f"#{candidate.index} {kind}{like}", font, width), INK, font)
        sharp = "" if candidate.sharpness is None else f"{candidate.sharpness:.0f}"
        detail = f"{sharp} {candidate.source}".strip() if self._several else f"sharp {sharp}"
        draw.text((x, bottom + LINE), _shorten(detail, font, width), FAINT, font)

    def _heading(self, held_out: Collection[str]) -> Words:
        """Returns the counts and the legend."""
        counts = count_reasons(self._candidates)
        chosen = counts.pop(Reason.KEPT, 0)
        held = sum(_kind(candidate, held_out) == HELD_OUT for candidate in self._candidates)
        dropped = sum(counts.values())
        drawn = sum(candidate.reason is not Reason.KEPT for candidate in self._sample)
        words: Words = [
            (f"{self._title}: {chosen} of {chosen + dropped} frames kept, {held} of them held out "
             f"for the score; {dropped} dropped.", None),
            (f"Shown in order: {len(self._sample) - drawn} kept, {drawn} dropped; below each: "
             f"sharpness{', file' if self._several else ''}.", None),
            (f"{chosen - held} kept for training", COLOURS[Reason.KEPT]),
            (f"{held} held out", COLOURS[HELD_OUT])]
        return words + [
            (f"{count} {reason}: {MEANINGS[Reason(reason)]}", COLOURS[reason])
            for reason, count in counts.items()]


def _kind(candidate: FrameCandidate, held_out: Collection[str]) -> str:
    """Returns the meaning of a border: a reason, or that a kept frame is held out."""
    held = candidate.reason is Reason.KEPT and candidate.name in held_out
    return HELD_OUT if held else candidate.reason.value


def _encode(canvas: Image.Image) -> bytes:
    """Returns a PNG of at most `MAX_BYTES`."""
    stored = io.BytesIO()
    for colours in PALETTES:
        stored = io.BytesIO()
        canvas.quantize(
            palette=_choose_palette(canvas, colours), dither=Image.Dither.NONE).save(stored, "PNG")
        if stored.tell() <= MAX_BYTES:
            break
    return stored.getvalue()


def _choose_palette(canvas: Image.Image, colours: int) -> Image.Image:
    """Returns a palette of the sheet's own colours and of those that its pictures need.

    An octree finds them in a tenth of the time of a median cut, and neither keeps the colour of a
    border that is rare.
    """
    own = dict.fromkeys((PAPER, INK, FAINT, *COLOURS.values()))
    found = canvas.quantize(
        colours - len(own), method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    palette = Image.new("P", (1, 1))
    palette.putpalette([value for colour in own for value in colour] + (found.getpalette() or []))
    return palette


def _thumbnail(rgb: NDArray[np.uint8], size: tuple[int, int]) -> Image.Image:
    """Returns a picture [H, W, 3] reduced to fit into `size`, in any orientation."""
    height, width = rgb.shape[:2]
    scale = min(size[0] / width, size[1] / height)
    fitted = max(1, round(width * scale)), max(1, round(height * scale))
    thumb = Image.new("RGB", size, PAPER)
    small = Image.fromarray(cv2.resize(rgb, fitted, interpolation=cv2.INTER_AREA))
    thumb.paste(small, ((size[0] - fitted[0]) // 2, (size[1] - fitted[1]) // 2))
    return thumb


def _plan_layout(width: int, height: int) -> _SheetLayout:
    width, height = max(width, height // MOST_OBLONG), max(height, width // MOST_OBLONG)
    scale = math.sqrt(THUMB_PIXELS / (width * height))
    thumb = max(8, round(width * scale)), max(8, round(height * scale))
    cell = max(CELL_WIDTH, thumb[0] + 2 * BORDER) + GAP, thumb[1] + 2 * BORDER + 2 * LINE + GAP
    columns = max(1, (MAX_WIDTH - GAP) // cell[0])
    # The heading takes part of the budget: some lines of the full width.
    pixels = MAX_PIXELS - (columns * cell[0] + GAP) * (8 * LINE + 3 * GAP)
    rows = max(1, pixels // ((columns * cell[0] + GAP) * cell[1]))
    return _SheetLayout(thumb, cell, columns * rows, columns)


def _choose_sample(candidates: Sequence[FrameCandidate], most: int) -> list[FrameCandidate]:
    """Returns at most `most` candidates in order, every reason among them."""
    by_reason = {
        reason: [frame for frame in candidates if frame.reason is reason] for reason in Reason}
    chosen = by_reason.pop(Reason.KEPT)
    dropped = sum(map(len, by_reason.values()))
    room = {Reason.KEPT: min(len(chosen), max(int(KEPT_SHARE * most), most - dropped))}
    left = most - room[Reason.KEPT]
    # The rarest reason first: its unused share goes to the others.
    for place, reason in enumerate(sorted(by_reason, key=lambda name: len(by_reason[name]))):
        room[reason] = min(len(by_reason[reason]), left // (len(by_reason) - place))
        left -= room[reason]
    sample: list[FrameCandidate] = []
    for reason, members in {Reason.KEPT: chosen, **by_reason}.items():
        count = room[reason]
        sample += [members[(2 * i + 1) * len(members) // (2 * count)] for i in range(count)]
    return sorted(sample, key=lambda frame: frame.index)


def _wrap(words: Words, width: int) -> list[Words]:
    """Returns texts in lines that are not wider than `width` where possible."""
    font = ImageFont.load_default(TEXT)
    lines: list[Words] = [[]]
    used = 0.0
    for text, colour in words:
        needed = font.getlength(text) + 2 * LINE + GAP
        if lines[-1] and used + needed > width:
            lines.append([])
            used = 0.0
        lines[-1].append((text, colour))
        used += needed
    return lines


def _write_words(draw: ImageDraw.ImageDraw, words: Words, x: float, y: float) -> None:
    font = ImageFont.load_default(TEXT)
    for text, colour in words:
        if colour is not None:
            draw.rectangle((x, y + 2, x + LINE - 4, y + LINE - 3), colour)
            x += LINE + 2
        draw.text((x, y), text, INK, font)
        x += font.getlength(text) + LINE


def _shorten(text: str, font: ImageFont.FreeTypeFont | ImageFont.ImageFont, width: float) -> str:
    """Returns a text shortened to fit a width."""
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "…") > width:
        text = text[:-1]
    return text + "…"
