"""The sections of the report, a row each: what it gathers for the template that has its name."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from recon_cli.evaluation.scores import Metrics
from recon_cli.report.capture import read_capture
from recon_cli.report.curves import draw_rounds, draw_training_curves
from recon_cli.report.moving_section import read_moving
from recon_cli.report.parts import read_parts
from recon_cli.report.records import build_scores
from recon_cli.report.room import read_room
from recon_cli.report.stage_status import StageReports, read_decisions, read_provenance
from recon_cli.report.trust_section import read_trust
from recon_cli.trust.quality import delivered_model
from recon_cli.workspace.summaries import ExportSummary


class Section(NamedTuple):
    """One section of the page."""

    name: str  # of its tab, and of its template in this folder
    heading: str
    stages: tuple[str, ...]  # below the heading stands which of them are stale or missing
    # Returns what the template shows, by names that no other section has. The scores are those of
    # evaluate, None where there are none to read.
    gather: Callable[[StageReports, Metrics | None], Mapping[str, Any]]


SECTIONS = (
    Section("views", "Held-out views: truth against render", ("evaluate",),
            lambda _, metrics: {"delivered": delivered_model(metrics)}),
    Section("overview", "Overview", (), lambda *_: {}),
    Section("scores", "Scores on the held-out views", ("evaluate",),
            lambda _, metrics: {"scores": build_scores(metrics)}),
    Section("trust", "Where the scene can be trusted", ("evaluate",),
            lambda stages, _: {"trust": read_trust(stages)}),
    Section("training", "Training", ("train",), lambda stages, metrics: {
        "curves": draw_training_curves(stages, metrics), "moving": read_moving(stages),
        "decisions": read_decisions(stages["train"])}),
    Section("pruning", "Pruning", (), lambda stages, _: {"rounds": draw_rounds(stages["prune"])}),
    Section("capture", "Capture", ("ingest", "denoise", "sfm", "place"), lambda stages, _: {
        "capture": read_capture(stages), "parts": read_parts(stages),
        "part_command": f"recon sfm -w {shlex.quote(str(stages['sfm'].folder.parent))} --part"}),
    Section("exports", "Exports", ("export",), lambda stages, _: {
        "export": stages["export"].read_summary(ExportSummary),
        "room": read_room(stages["export"])}),
    Section("settings", "Settings and reproduction", (),
            lambda stages, _: {"provenance": read_provenance(stages)}),
)
