"""Scores of views and models as JSON files hold them, and tables of them."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from recon_cli.config.stages import MODEL_LABELS
from recon_cli.errors import Hint
from recon_cli.evaluation.intervals import Interval
from recon_cli.workspace.atomic import read_json
from recon_cli.workspace.summaries import JsonRecord

_TEX = str.maketrans({
    "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"})
ERROR_GAIN = 4  # of images of differences
REFERENCE = "3DGS"  # the recipe of Kerbl et al. 2023
_VIEW_FIELDS = ("psnr_db", "psnr_8bit_db", "ssim", "ssim_padded", "lpips", "gain_psnr_db")


@dataclass(frozen=True)
class ViewScore(JsonRecord):
    """The scores of one view."""

    name: str
    psnr_db: float
    psnr_8bit_db: float  # of the render rounded to 8 bits
    ssim: float  # by scikit-image
    ssim_padded: float  # by INRIA's convention
    lpips: float | None = None  # None where it was not measured
    pixels_scored: float | None = None  # fraction that a mask leaves; None without a mask
    gain_psnr_db: float | None = None  # after its best gain per channel; None in older files


@dataclass(frozen=True)
class MeanScore(JsonRecord):
    """Means over some views: PSNR in dB, and SSIM by scikit-image."""

    psnr_db: float
    ssim: float


@dataclass(frozen=True, kw_only=True)
class ModelMetrics(JsonRecord):
    """The scores of one model in metrics.json: means over the held-out views, and the views."""

    psnr_db: float
    psnr_8bit_db: float
    ssim: float
    ssim_padded: float
    lpips: float | None = None  # None where a view has none
    gaussians: int
    bytes: int  # of its file
    render_ms: float  # median milliseconds a view
    train_seconds: float | None  # of training that led to it; None where unknown
    gain_psnr_db: float | None = None  # after the best gain per channel of each view
    # whether `seen_psnr_db` is after gains, too; None in older files: where gain_psnr_db is there
    seen_after_gains: bool | None = None
    seen_psnr_db: Mapping[str, float] = field(default_factory=dict)  # on training views, by split
    # beside what moves in the held-out views, where training masked what moves
    static_psnr_db: float | None = None
    views: tuple[ViewScore, ...]

    @classmethod
    def mean(cls, models: Sequence[ModelMetrics]) -> Self:
        """Returns the means over scenes, each of the same weight; None where one lacks a figure."""
        def mean(name: str) -> float | None:
            values = [getattr(model, name) for model in models]
            return None if None in values else float(np.mean(values))

        scores = {name: mean(name) for name in (*_VIEW_FIELDS, "render_ms", "train_seconds")}
        counts = {name: round(mean(name) or 0) for name in ("gaussians", "bytes")}
        return cls(**scores, **counts, views=())  # type: ignore[arg-type]

    @classmethod
    def from_views(
        cls, views: tuple[ViewScore, ...], *, gaussians: int, bytes: int, render_ms: float,
        train_seconds: float | None = None, seen_after_gains: bool = False,
        seen_psnr_db: Mapping[str, float] | None = None, static_psnr_db: float | None = None,
    ) -> Self:
        """Returns the scores of a model from those of its views."""
        psnr_db, psnr_8bit_db, ssim, ssim_padded = (
            float(np.mean([getattr(view, name) for view in views])) for name in _VIEW_FIELDS[:4])
        lpips, gained = ([value for view in views if (value := getattr(view, name)) is not None]
                         for name in ("lpips", "gain_psnr_db"))
        return cls(
            psnr_db=psnr_db, psnr_8bit_db=psnr_8bit_db, ssim=ssim, ssim_padded=ssim_padded,
            lpips=float(np.mean(lpips)) if len(lpips) == len(views) else None,
            gaussians=gaussians, bytes=bytes, render_ms=render_ms, train_seconds=train_seconds,
            gain_psnr_db=float(np.mean(gained)) if len(gained) == len(views) else None,
            seen_after_gains=seen_after_gains, seen_psnr_db=seen_psnr_db or {},
            static_psnr_db=static_psnr_db, views=views)

    @property
    def gap_psnr_db(self) -> float:
        """PSNR of the held-out views that compares with `seen_psnr_db`."""
        after = self.seen_after_gains is not False and self.gain_psnr_db is not None
        return self.gain_psnr_db if after and self.gain_psnr_db is not None else self.psnr_db


@dataclass(frozen=True, kw_only=True)
class Metrics(JsonRecord):
    """The content of metrics.json."""

    FILE: ClassVar[str] = "metrics.json"

    models: Mapping[str, ModelMetrics]
    pruned_minus_base: Mapping[str, Interval] | None = None  # by score
    psnr_convention: str
    psnr_8bit_convention: str
    ssim_convention: str
    ssim_padded_convention: str
    lpips_convention: str
    mask_convention: str | None = None
    truth_digest: str  # of the views; scores can be paired where it is equal
    width: int  # pixels, of the largest view
    height: int
    sizes: tuple[tuple[int, ...], ...] | None = None  # (width, height), where they differ
    test_views: int
    unregistered_test: tuple[str, ...]  # held-out frames without a camera
    masked_out_test: tuple[str, ...] | None = None  # held-out frames whose masks leave too little
    imported_from: str | None = None  # name of the file of an imported scene
    base_recipe: str | None = None  # REFERENCE where base was trained so; None: not, or unknown
    protocol: str | None = None  # of `recon train --protocol`, if it was followed up to the scores
    frames: int | None = None  # of ingest; None, as the next two, in files of older versions
    training_views: int | None = None  # None for an imported scene, too
    unregistered: tuple[str, ...] | None = None  # names of all frames without a camera
    # share of the pixels of held-out views that move, by name, where training masked what moves;
    # the scores are of all pixels but `static_psnr_db`
    moving: Mapping[str, float] | None = None

    def describe_moving(self, model: ModelMetrics) -> str:
        """Returns a sentence on what moves in the held-out views; empty where nothing does."""
        if not self.moving or model.static_psnr_db is None:
            return ""
        names = ", ".join(f"{name} ({share:.1%})" for name, share in self.moving.items())
        return (f"PSNR outside what moves {model.static_psnr_db:.2f} dB, of all pixels "
                f"{model.psnr_db:.2f} dB; something moves in {names}")

    @property
    def coverage(self) -> str:
        """How much of the capture the scores stand for; empty if all of it, or if not known."""
        if self.frames is None or not self.unregistered:
            return ""
        trained = "" if self.training_views is None else (
            f"trained on {self.training_views} of {self.frames} frames; ")
        left_out, held_out = len(self.unregistered), len(self.unregistered_test)
        return (f"{trained}{left_out} frames left out, as they have no camera in this model, "
                f"{held_out or 'none'} of them held out{' and so not scored' * bool(held_out)}")

    def label(self, model: str) -> str:
        """Returns the label of a model in tables: 3DGS only where it was trained as 3DGS is."""
        name = self.base_recipe if model == "base" and self.base_recipe else (
            MODEL_LABELS.get(model, model))
        return f"{name} (protocol {self.protocol})" if self.protocol else name

    @classmethod
    def read(cls, evaluate: Path) -> Self:
        """Returns a folder's scores; ManifestError for another version, FormatError if damaged."""
        return cls.from_json(read_json(
            evaluate / cls.FILE, dict, hint=Hint("eval", again=True)))


@dataclass(frozen=True)
class Table:
    """Rows of cells, each as long as the headings; the first column holds names, others numbers."""

    headings: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    title: str = ""
    means: int = 0  # rows at the end that are means of those above; LaTeX sets them apart

    def text(self, *, rule: bool = False) -> str:
        """Returns aligned columns for a terminal; with a line below the headings if `rule`."""
        rows = [self.headings, *self.rows]
        widths = [max(len(row[i]) for row in rows) for i in range(len(self.headings))]
        lines = ["  ".join(
            cell.rjust(width) if column else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))).rstrip()
            for row in rows]
        if rule:
            lines.insert(1, "-" * max(map(len, lines)))
        return "\n".join([self.title, *lines] if self.title else lines)

    def markdown(self) -> str:
        """Returns a pipe table, under a heading where it has a title."""
        lines = [self.headings, ("---", *["---:"] * (len(self.headings) - 1)), *self.rows]
        table = "".join("| " + " | ".join(line) + " |\n" for line in lines)
        return f"### {self.title}\n\n{table}".rstrip() if self.title else table

    def csv(self) -> str:
        """Returns the table as CSV, below its title where it has one."""
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([*[[self.title]] * bool(self.title), self.headings, *self.rows])
        return file.getvalue()

    def latex(self, caption: str = "", label: str = "") -> str:
        """Returns the table in LaTeX, as a float where it has a caption or label; needs booktabs.

        `caption` and `label` are LaTeX and stay as they are.
        """
        def line(cells: Sequence[str]) -> str:
            return " & ".join(cell.translate(_TEX) for cell in cells) + r" \\" + "\n"

        columns = "l" + "r" * (len(self.headings) - 1)
        body = len(self.rows) - self.means
        means = "\\midrule\n" + "".join(map(line, self.rows[body:])) if self.means else ""
        tabular = (f"\\begin{{tabular}}{{{columns}}}\n\\toprule\n{line(self.headings)}\\midrule\n"
                   f"{''.join(map(line, self.rows[:body]))}{means}"
                   "\\bottomrule\n\\end{tabular}\n")
        if not caption and not label:
            return tabular
        named = f"\\caption{{{caption}}}\n" * bool(caption) + f"\\label{{{label}}}\n" * bool(label)
        return f"\\begin{{table}}\n\\centering\n{named}{tabular}\\end{{table}}\n"


def number(value: float | None, digits: int = 3) -> str:
    """Returns a number with that many significant digits, "-" for None."""
    if value is None:
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 10.0**digits:
        return f"{value:.{digits}g}"
    return f"{value:.0f}" if 1e-3 <= abs(value) < 1e6 else f"{value:.{digits - 1}e}"


def percent(value: float | None) -> str:
    """Returns a fraction in percent, "-" for None."""
    return "-" if value is None else f"{100 * value:.3g}%"


def or_dash(value: float | None, form: str) -> str:
    """Returns a number in a format such as ".2f", "-" for None."""
    return "-" if value is None else format(value, form)


def model_table(
    models: Mapping[str, ModelMetrics], means: Mapping[str, ModelMetrics] | None = None
) -> Table:
    """Returns the models side by side by label, `means` below; LPIPS has a column where one has it.
    """
    rows = {**models, **(means or {})}
    perceptual = any(model.lpips is not None for model in rows.values())
    gains = any(model.gain_psnr_db is not None for model in rows.values())
    headings = ("model", "PSNR dB", *["after gain"] * gains, "8-bit", "SSIM", "SSIM 0-pad",
                *["LPIPS"] * perceptual, "Gaussians", "MB", "ms/view", "train s")
    return Table(headings, tuple((
        label, f"{model.psnr_db:.2f}", *[or_dash(model.gain_psnr_db, ".2f")] * gains,
        f"{model.psnr_8bit_db:.2f}", f"{model.ssim:.4f}",
        f"{model.ssim_padded:.4f}", *[or_dash(model.lpips, ".4f")] * perceptual,
        f"{model.gaussians:,}", f"{model.bytes / 1e6:.1f}", f"{model.render_ms:.0f}",
        or_dash(model.train_seconds, ".0f")) for label, model in rows.items()),
        means=len(means or {}))


def view_table(models: Mapping[str, ModelMetrics]) -> Table:
    """Returns each view of the first model with the scores of all models, "-" where one lacks it.
    """
    scores = {"PSNR dB": ("psnr_db", ".2f"), "SSIM": ("ssim", ".4f")}
    by_name = [{view.name: view for view in model.views} for model in models.values()]
    return Table(("view", *(f"{score} {label}" for score in scores for label in models)), tuple((
        name, *(or_dash(getattr(views.get(name), key, None), form)
                for key, form in scores.values() for views in by_name))
        for name in by_name[0]))


def paper_table(
    sets: Mapping[str, tuple[ModelMetrics, ModelMetrics]], labels: tuple[str, str]
) -> Table:
    """Returns a row for each data set, of two models, as in the paper's tables I and II."""
    return Table(
        ("data set", *(f"{score} {label}" for score in ("PSNR", "SSIM") for label in labels)),
        tuple((name, f"{base.psnr_db:.2f}", f"{ours.psnr_db:.2f}", f"{base.ssim:.4f}",
               f"{ours.ssim:.4f}") for name, (base, ours) in sets.items()))


def csv_table(models: Mapping[str, ModelMetrics]) -> str:
    """Returns one row for each model and view, and one with the mean, as CSV."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(["model", "view", *_VIEW_FIELDS])
    for key, model in models.items():
        for name, source in [*((view.name, view) for view in model.views), ("mean", model)]:
            writer.writerow([key, name, *(
                "" if value is None else f"{value:.6f}"
                for value in (getattr(source, field) for field in _VIEW_FIELDS))])
    return file.getvalue()
