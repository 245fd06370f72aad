"""Rows that other packages add to a table of recon, by an entry point in their pyproject.toml."""

from __future__ import annotations

import logging
from collections.abc import Collection
from importlib.metadata import entry_points
from typing import Any, TypeVar

Row = TypeVar("Row")

logger = logging.getLogger("recon")


def load_rows(group: str, kind: type[Row], taken: Collection[str]) -> list[Row]:
    """Returns the rows of a group of entry points, each an object of `kind` with a new name.

    One that cannot be used is left out with a warning: recon works without it.
    """
    rows: list[Row] = []
    for point in entry_points(group=group):
        try:
            row: Any = point.load()
        except Exception as error:  # of any package
            logger.warning("%s %s cannot be loaded: %s", group, point.value, error)
            continue
        names = {*taken, *(getattr(one, "name", "") for one in rows)}
        if isinstance(row, kind) and getattr(row, "name", "") not in names:
            rows.append(row)
        else:
            logger.warning("%s %s is left out: it must be a %s with a name that is not taken",
                           group, point.value, kind.__name__)
    return rows
