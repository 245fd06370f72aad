"""The shape that every experiment ends in: a record, tables and a picture, and their files.

An experiment is one function of a request: it measures a grid of variants and repeats
(`runner.run_grid`) and returns a `Result`. Writing, drawing and printing it are here alone.
"""

from __future__ import annotations

import importlib.util
import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon_cli.machine import install_command
from recon_cli.workspace import atomic

if TYPE_CHECKING:  # it imports scipy, for which `--help` must not wait
    from recon_cli.evaluation.scores import Table


logger = logging.getLogger("recon")


@dataclass(frozen=True)
class Result:
    """The result of an experiment."""

    record: Mapping[str, Any]  # the content of its JSON file
    head: str  # what was measured, where and how
    tables: Sequence[Table]
    notes: Sequence[str] = ()  # how the tables are to be read
    draw: Callable[[Path], None] | None = None  # draws the picture into a .png or .svg

    def text(self) -> str:
        """Returns the text for the terminal."""
        return "\n\n".join([self.head, *(table.text() for table in self.tables), *self.notes])

    def markdown(self) -> str:
        """Returns the same in Markdown."""
        tables = (table.markdown().rstrip() for table in self.tables)
        return "\n\n".join([self.head + ".", *tables, *self.notes])

    def format(self, form: str) -> str:
        """Returns it as text, markdown, latex, csv (a blank line between tables) or json."""
        if form == "json":
            return json.dumps(self.record, indent=1)
        if form == "csv":
            return "\n".join(table.csv() for table in self.tables).rstrip()
        if form == "latex":
            return "\n".join(table.latex() for table in self.tables).rstrip()
        return self.markdown() if form == "markdown" else self.text()

    def save(self, folder: Path, name: str) -> None:
        """Writes NAME.json, and NAME.svg unless matplotlib is missing."""
        atomic.write_json(folder / f"{name}.json", self.record)
        if self.draw is None:
            return
        if _can_draw():
            self.draw(folder / f"{name}.svg")
        else:
            logger.warning("%s.svg is not drawn: matplotlib is not installed; run `%s`", name,
                           install_command("plot"))


def _can_draw() -> bool:
    return importlib.util.find_spec("matplotlib") is not None


@contextmanager
def drawing(path: Path, width: float, height: float, *, dpi: int = 110) -> Iterator[Any]:
    """Opens a figure of a size in inches and saves it after the block, atomically."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    yield figure
    with atomic.replacing(path) as temporary:
        figure.savefig(temporary, dpi=dpi)


def add_legend(figure: Any, axes: Any) -> None:
    """Adds the legend of one panel below all of them."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
