"""The comparison in words and tables."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

from recon_cli.metrics import (
    MASK_CONVENTION,
    PSNR_8BIT_CONVENTION,
    PSNR_CONVENTION,
    SSIM_CONVENTION,
    SSIM_PADDED_CONVENTION,
    PairedDifference,
    csv_table,
    model_table,
    paired_bootstrap,
    paper_table,
)
from recon_cli.scoreboard.entries import Entry
from recon_cli.tables import Table


def report(entries: Sequence[Entry], form: str) -> str:
    """Returns the entries, at least one, in one of `command.FORMS`."""
    if form == "json":
        return json.dumps(_record(entries), indent=1)
    if form == "csv":
        return csv_table({entry.score.label: entry.score for entry in entries}).rstrip()
    tables = [table for table in (
        model_table([entry.score for entry in entries]), difference_table(entries),
        _beside_the_paper(entries)) if table.rows]
    if form == "latex":
        return "\n".join(table.latex() for table in tables).rstrip()
    if form == "markdown":
        return "\n".join(table.markdown() for table in tables) + "\n" + _note()
    return "\n\n".join(table.text(rule=True) for table in tables) + "\n\n" + _note()


def pairs(entries: Sequence[Entry]) -> list[tuple[Entry, Entry]]:
    """Returns each entry with the first one that was held against the very same views."""
    found = []
    for place, entry in enumerate(entries):
        first = next(one for one in entries if one.truth == entry.truth)
        if entries.index(first) < place:
            found.append((entry, first))
    return found


def difference_table(entries: Sequence[Entry]) -> Table:
    """Returns how each entry differs from the first one with the same views, with intervals."""
    def shown(found: PairedDifference, form: str) -> str:
        if found.low is None or found.high is None:
            return f"{found.mean:{form}} (one view)"
        return f"{found.mean:{form}} [{found.low:{form}}, {found.high:{form}}]"

    return Table(("difference, 95%", "PSNR dB", "SSIM"), tuple(
        (f"{ours.score.label} minus {theirs.score.label}",
         shown(_paired(ours, theirs, "psnr_db"), "+.2f"),
         shown(_paired(ours, theirs, "ssim"), "+.4f")) for ours, theirs in pairs(entries)))


def _beside_the_paper(entries: Sequence[Entry]) -> Table:
    """Returns 3DGS against ours for each workspace that has both."""
    models = {(entry.group, entry.model): entry.score for entry in entries}
    groups = dict.fromkeys(entry.group for entry in entries)
    return paper_table({
        group: (models[group, "base"], models[group, "pruned"]) for group in groups
        if (group, "base") in models and (group, "pruned") in models})


def _paired(ours: Entry, theirs: Entry, key: str) -> PairedDifference:
    return paired_bootstrap(*([getattr(view, key) for view in entry.score.views]
                              for entry in (ours, theirs)))


def _record(entries: Sequence[Entry]) -> dict[str, Any]:
    return {
        "models": [{
            "workspace": entry.group, "model": entry.model, "truth_digest": entry.truth,
            **{key: getattr(entry.score, key) for key in (
                "psnr_db", "psnr_8bit_db", "ssim", "ssim_padded", "lpips")},
            **dataclasses.asdict(entry.score)} for entry in entries],
        "differences": [{
            "ours": ours.score.label, "theirs": theirs.score.label,
            **{key: dataclasses.asdict(_paired(ours, theirs, key)) for key in ("psnr_db", "ssim")}}
            for ours, theirs in pairs(entries)],
        "psnr_convention": PSNR_CONVENTION, "psnr_8bit_convention": PSNR_8BIT_CONVENTION,
        "ssim_convention": SSIM_CONVENTION, "ssim_padded_convention": SSIM_PADDED_CONVENTION,
        "mask_convention": MASK_CONVENTION}


def _note() -> str:
    return (f"PSNR: {PSNR_CONVENTION}\n8-bit: {PSNR_8BIT_CONVENTION}\nSSIM: {SSIM_CONVENTION}\n"
            f"SSIM 0-pad: {SSIM_PADDED_CONVENTION}\n"
            "Differences: paired, bootstrap over the views; only where both were held against the "
            "very same views.")
