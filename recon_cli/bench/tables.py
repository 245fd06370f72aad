"""Tables as plain text for a terminal and as Markdown for a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """A titled table; the first column is text, the others are figures.

    Attributes:
        title: what it is about.
        header: of the columns.
        rows: cells, as many in each as the header has.
    """

    title: str
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]

    def text(self) -> str:
        """Returns aligned columns under the title."""
        lines = [self.header, *self.rows]
        widths = [max(len(line[i]) for line in lines) for i in range(len(self.header))]
        shown = [
            "  ".join(cell.rjust(width) if i else cell.ljust(width)
                      for i, (cell, width) in enumerate(zip(line, widths, strict=True))).rstrip()
            for line in lines]
        return "\n".join([self.title, *shown])

    def markdown(self) -> str:
        """Returns a pipe table under a heading."""
        rule = ["---", *["---:"] * (len(self.header) - 1)]
        lines = [list(self.header), rule, *[list(row) for row in self.rows]]
        return "\n".join([
            f"### {self.title}", "", *("| " + " | ".join(line) + " |" for line in lines)])


def number(value: float | None, digits: int = 3) -> str:
    """Returns a figure with that many significant digits, "-" for one that is not known."""
    if value is None:
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 10.0**digits:
        return f"{value:.{digits}g}"
    return f"{value:.0f}" if 1e-3 <= abs(value) < 1e6 else f"{value:.{digits - 1}e}"


def percent(value: float | None) -> str:
    """Returns a share in percent, "-" for one that is not known."""
    return "-" if value is None else f"{100 * value:.3g}%"
