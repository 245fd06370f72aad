"""The section on trust: the surface, agreement with held-out views, poorly seen regions."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from recon_cli.config.stages import MODEL_LABELS
from recon_cli.errors import FormatError
from recon_cli.evaluation.scores import Table
from recon_cli.report.chart import Axis, Series, draw_chart
from recon_cli.report.gallery import MOST_THUMBS, note_damage, read_picture
from recon_cli.report.records import MODELS, read_trust_record
from recon_cli.report.stage_status import StageReports
from recon_cli.scene.statistics import MIN_OBSERVATIONS
from recon_cli.trust.heat_map import INVENTED, TRUSTED, legend_stops
from recon_cli.trust.records import FOLDER, MIN_SPAN_DEG, ModelTrust


@dataclass(frozen=True)
class TrustSection:
    """The section on trust."""

    missing: str  # why there is nothing, as a sentence; empty where there is
    headline: str = ""  # share of the surface that is well seen
    surface: Table | None = None
    agreement: Table | None = None  # None without held-out views
    reliability: Markup | None = None
    pictures: tuple[tuple[str, Markup, Markup], ...] = ()  # (view, render, heat map)
    regions: tuple[str, ...] = ()  # poorly seen, one a line, in the order of the plan
    stops: str = ""  # CSS colours of the heat maps
    ends: tuple[float, float] = (TRUSTED, INVENTED)


def read_trust(stages: StageReports) -> TrustSection:
    """Returns the section of a workspace, as far as its files can be read."""
    try:
        record = read_trust_record(stages)
    except FormatError as error:
        return TrustSection(f"Trust is not shown: {error.message}")
    if record is None:
        return TrustSection(
            "Trust was not measured." if stages["evaluate"].there else "Trust needs evaluate.")
    if record.reason:
        return TrustSection(record.reason)
    models = {name: trust for name in MODELS if (trust := record.model_trust(name)) is not None}
    first = next(iter(models.values()))
    return TrustSection(
        "", f"{first.surface.well:.0%} of the surface that the views show is well seen: by "
        f"{MIN_OBSERVATIONS} views or more that span {MIN_SPAN_DEG:g} degrees or more.",
        _surface_table(models), _agreement_table(models), _draw_reliability(models),
        _read_pictures(stages["evaluate"].folder, next(iter(models))),
        tuple(each.describe(record.unit) for each in record.poorly_seen),
        ", ".join(legend_stops()))


def _surface_table(models: dict[str, ModelTrust]) -> Table:
    return Table(
        ("model", "well seen", "from one direction only", f"by fewer than {MIN_OBSERVATIONS} views",
         "training views"),
        tuple((MODEL_LABELS[name], f"{trust.surface.well:.1%}", f"{trust.surface.narrow:.1%}",
               f"{trust.surface.few:.1%}", f"{trust.views:,}") for name, trust in models.items()))


def _agreement_table(models: dict[str, ModelTrust]) -> Table | None:
    rows = [(MODEL_LABELS[name], f"{found.ause:.3f}", f"{found.ause_opacity:.3f}",
             f"{found.ause_depth:.3f}", f"{found.gap:.0%}", f"{found.views:,}")
            for name, trust in models.items() if (found := trust.agreement) is not None]
    return Table(("model", "AUSE", "AUSE of opacity", "AUSE of depth", "gap of ten bins",
                  "held-out views"), rows) if rows else None


def _draw_reliability(models: dict[str, ModelTrust]) -> Markup | None:
    lines = [Series(MODEL_LABELS[name], tuple(zip(found.expected, found.real, strict=True)),
                    2 * number, "circle")
             for number, (name, trust) in enumerate(models.items())
             if (found := trust.agreement) is not None]
    if not lines:
        return None
    every = [value for line in lines for point in line.points for value in point if value > 0]
    ends = (min(every), max(every)) if every else (TRUSTED, INVENTED)
    same = Series("as expected", tuple(zip(ends, ends, strict=True)), 7, dashed=True)
    return draw_chart(
        "Expected against real error on the held-out views, which calibrated nothing",
        Axis("expected absolute error", log=True), Axis("real absolute error", log=True),
        [same, *lines])


def _read_pictures(evaluate: Path, model: str) -> tuple[tuple[str, Markup, Markup], ...]:
    """Returns some held-out views with their heat maps, evenly spread; none if files are gone."""
    paths = sorted((evaluate / FOLDER / model).glob("*.png"))
    pictures = []
    for path in paths[:: max(1, -(-len(paths) // MOST_THUMBS))]:
        with note_damage([], path.stem):
            render = read_picture(evaluate / "renders" / model / path.name)
            pictures.append((path.stem, render, read_picture(path)))
    return tuple(pictures)
