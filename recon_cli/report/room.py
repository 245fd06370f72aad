"""The measures of the room and its plan, as export left them."""

from __future__ import annotations

from dataclasses import dataclass

from markupsafe import Markup

from recon_cli.errors import FormatError
from recon_cli.report.gallery import embed
from recon_cli.report.stage_status import StageReport
from recon_cli.workspace.atomic import read_bytes, read_json
from recon_cli.workspace.export_formats import MEASURES, PLAN

_MOST_BYTES = 3_000_000  # of a plan; the page has a limit of its own


@dataclass(frozen=True)
class RoomSection:
    """The section on the room."""

    figures: tuple[tuple[str, str], ...]  # (label, value with its interval)
    notes: tuple[str, ...]  # on measures that are missing
    plan: Markup | None  # data URI, in which nothing needs escaping; None if it cannot be shown


def read_room(export: StageReport) -> RoomSection | None:
    """Returns the measures of the last export; None where it wrote no plan."""
    path = export.folder / MEASURES
    if not export.there or not path.exists():
        return None
    try:
        value = read_json(path)
        figures = [(label, f"{value[key]['value']:.2f} ± {max(value[key]['error'], 0.01):.2f} "
                           f"{unit}")
                   for key, label, unit in (("ceiling_height", "Ceiling height", "m"),
                                            ("floor_area", "Floor area", "m²"))
                   if value[key] is not None]
        if value["walls"]:
            figures.append(("Walls", ", ".join(
                f"{wall['value']:.2f} ± {max(wall['error'], 0.01):.2f} m"
                for wall in value["walls"])))
        notes = [str(note) for note in value["notes"]]
        notes[:0] = [f"The plan is stale: {part.why}." for part in export.parts
                     if part.name == f"export.{PLAN}" and not part.fresh]
        drawing = read_bytes(export.folder / PLAN)
    except (FormatError, OSError, KeyError, TypeError, ValueError) as error:
        return RoomSection((), (f"The measures are not shown: {error}",), None)
    plan = embed(drawing, "svg+xml") if len(drawing) <= _MOST_BYTES else None
    return RoomSection(tuple(figures), tuple(notes), plan)
