"""A table of words and figures, for a terminal, a page or a paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

_TEX = str.maketrans({
    "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"})


@dataclass(frozen=True)
class Table:
    """Rows of cells; the first column holds names, the others numbers.

    Attributes:
        headings: of the columns.
        rows: each as long as the headings.
    """

    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

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
        return "\n".join(lines)

    def markdown(self) -> str:
        """Returns the table in Markdown."""
        lines = [self.headings, ("---", *["---:"] * (len(self.headings) - 1)), *self.rows]
        return "".join("| " + " | ".join(line) + " |\n" for line in lines)

    def latex(self) -> str:
        """Returns the table in LaTeX; needs booktabs."""
        def line(cells: Sequence[str]) -> str:
            return " & ".join(cell.translate(_TEX) for cell in cells) + r" \\" + "\n"

        columns = "l" + "r" * (len(self.headings) - 1)
        return (f"\\begin{{tabular}}{{{columns}}}\n\\toprule\n{line(self.headings)}\\midrule\n"
                f"{''.join(map(line, self.rows))}\\bottomrule\n\\end{{tabular}}\n")
