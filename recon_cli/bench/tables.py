"""Tables as plain text for a terminal and as Markdown for a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from recon_cli.tables import Table


@dataclass(frozen=True)
class TitledTable:
    """A table with a title.

    Attributes:
        title: what it is about.
        header: of the columns.
        rows: cells, as many in each as the header has; the first is text, the others figures.
    """

    title: str
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]

    def text(self) -> str:
        """Returns aligned columns under the title."""
        return f"{self.title}\n{self._table.text()}"

    def markdown(self) -> str:
        """Returns a pipe table under a heading."""
        return f"### {self.title}\n\n{self._table.markdown()}".rstrip()

    @property
    def _table(self) -> Table:
        return Table(self.header, tuple(self.rows))


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
