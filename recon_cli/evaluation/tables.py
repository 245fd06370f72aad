"""Tables as plain text for a terminal and as Markdown for a page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

_TEX = str.maketrans({
    "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"})


@dataclass(frozen=True)
class Table:
    """Rows of cells, each as long as the headings; the first column holds names, others numbers."""

    headings: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    title: str = ""

    def text(self, *, rule: bool = False) -> str:
        """Returns aligned columns for a terminal; with a line below the headings if `rule`."""
        rows = [self.headings, *self.rows]
        widths = [max(len(row[i]) for row in rows) for i in range(len(self.headings))]
        lines = ["  ".join(
            cell.rjust(width) if place else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(row, widths, strict=True))).rstrip()
            for row in rows]
        if rule:
            lines.insert(1, "-" * max(map(len, lines)))
        return "\n".join([self.title, *lines] if self.title else lines)

    def markdown(self) -> str:
        """Returns a pipe table, under a heading where it has a title."""
        lines = [self.headings, ("---", *["---:"] * (len(self.headings) - 1)), *self.rows]
        table = "".join("| " + " | ".join(line) + " |\n" for line in lines)
        return f"### {self.title}\n\n{table}".rstrip() if self.title else table

    def latex(self) -> str:
        """Returns the table in LaTeX; needs booktabs."""
        def line(cells: Sequence[str]) -> str:
            return " & ".join(cell.translate(_TEX) for cell in cells) + r" \\" + "\n"

        columns = "l" + "r" * (len(self.headings) - 1)
        return (f"\\begin{{tabular}}{{{columns}}}\n\\toprule\n{line(self.headings)}\\midrule\n"
                f"{''.join(map(line, self.rows))}\\bottomrule\n\\end{{tabular}}\n")


def number(value: float | None, digits: int = 3) -> str:
    """Returns a figure with that many significant digits, "-" for one that is not known."""
    if value is None:
        return "-"
    if value == 0 or 1e-3 <= abs(value) < 10.0**digits:
        return f"{value:.{digits}g}"
    return f"{value:.0f}" if 1e-3 <= abs(value) < 1e6 else f"{value:.{digits - 1}e}"


def percent(value: float | None) -> str:
    """Returns a fraction in percent, "-" for one that is not known."""
    return "-" if value is None else f"{100 * value:.3g}%"
