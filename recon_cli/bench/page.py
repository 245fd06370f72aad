"""The part of a Markdown page that the benchmark writes; what people wrote around it stays."""

from __future__ import annotations

from pathlib import Path

from recon_cli import atomic
from recon_cli.errors import FormatError

BEGIN, END = "<!-- recon bench: begin -->", "<!-- recon bench: end -->"


def replaced(page: str, text: str) -> str:
    """Returns the page with `text` between its two marks.

    Raises:
        ValueError: the page lacks a mark, or they are not in order.
    """
    lines = page.splitlines()
    begins = [i for i, line in enumerate(lines) if line.strip() == BEGIN]
    ends = [i for i, line in enumerate(lines) if line.strip() == END]
    if len(begins) != 1 or len(ends) != 1 or ends[0] < begins[0]:
        raise ValueError("the marks are missing, repeated or out of order")
    inner = ["", *text.strip("\n").splitlines(), ""]  # a table ends at a blank line
    kept = [*lines[: begins[0] + 1], *inner, *lines[ends[0] :]]
    return "\n".join(kept) + "\n"


def check_page(path: Path) -> None:
    """Raises FormatError unless `path` is a page with both marks."""
    _written(path, "")


def write_page(path: Path, text: str) -> None:
    """Puts `text` between the marks of the page.

    Raises:
        FormatError: the page cannot be read or has no marks.
    """
    atomic.write_bytes(path, _written(path, text).encode())


def _written(path: Path, text: str) -> str:
    try:
        return replaced(path.read_text(encoding="utf-8"), text)
    except OSError as error:
        raise FormatError(
            f"{path} cannot be read: {error.strerror}.",
            hint=f"Make it, with the lines {BEGIN} and {END}.") from error
    except ValueError as error:
        raise FormatError(
            f"{path} does not hold the lines {BEGIN} and {END}, once each and in this order.",
            hint="Add both lines where the tables should stand.") from error
