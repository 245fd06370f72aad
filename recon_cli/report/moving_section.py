"""What training masked because it moves: pictures of the views that show most of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from recon_cli.errors import FormatError
from recon_cli.io.images import fit_image, read_mask, read_png
from recon_cli.report.gallery import MOST_THUMBS, THUMB, data_uri, note_damage
from recon_cli.report.stage_status import StageReports
from recon_cli.train.masks import FOLDER, read_summary

_TINT = np.array([230, 30, 30])


@dataclass(frozen=True)
class Moving:
    """The section on what moves."""

    sentence: str
    pictures: tuple[tuple[str, Markup], ...] = ()  # (caption, data URI), the most masked first
    notes: tuple[str, ...] = ()


def read_moving(stages: StageReports) -> Moving | None:
    """Returns what the last training masked; None where it masked nothing."""
    train = stages["train"]
    if not train.there:
        return None
    try:
        summary = read_summary(train.folder)
    except FormatError as error:
        return Moving("", notes=(f"What was masked is not shown: {error.message}",))
    if summary is None:
        return None
    by_hand = f", {len(summary.by_hand)} of them edited by hand" if summary.by_hand else ""
    sentence = (f"{summary.share:.1%} of the pixels of {len(summary.shares)} of {summary.views} "
                f"views were masked in training, as they move{by_hand}. The masks are in "
                f"train/{FOLDER}: edit or remove them, or add others, and train again.")
    pictures: list[tuple[str, Markup]] = []
    notes: list[str] = []
    images = stages["place"].folder / "undistorted" / "images"
    order = sorted(summary.shares.items(), key=lambda item: (-item[1], item[0]))
    for name, share in order[:MOST_THUMBS]:
        stem = name.rsplit(".", 1)[0]
        with note_damage(notes, f"{name} is not shown"):
            pictures.append((f"{name}, {share:.1%}", _draw(
                images / name, train.folder / FOLDER / f"{stem}.png")))
    return Moving(sentence, tuple(pictures), tuple(notes))


def _draw(image: Path, mask: Path) -> Markup:
    """Returns a photo with what is masked in red, as a data URI."""
    photo = fit_image(read_png(image), THUMB.longest)
    hidden = ~read_mask(mask, photo.shape[1], photo.shape[0])
    photo = photo.copy()
    photo[hidden] = (photo[hidden] * 0.45 + _TINT * 0.55).astype(np.uint8)
    return data_uri(photo, THUMB.quality)
