"""What --transform takes: a matrix in a JSON file."""

from __future__ import annotations

from pathlib import Path

from recon_cli.atomic import read_json
from recon_cli.errors import ConfigError

TRANSFORM = (
    "Hand the scene and its cameras out in another frame: a JSON file with a matrix of 4 rows of 4 "
    "numbers that takes points of the scene as it is without this option (in metres after "
    "--scale-between) there. It may turn, shift and scale evenly. In recon.toml: the 16 numbers, "
    "row after row.")


def read_matrix(path: str) -> list[float]:
    """Returns the 16 numbers of a JSON file with 4 rows of 4 numbers, row after row.

    Raises:
        FormatError: the file is missing or no JSON.
        ConfigError: it holds something else.
    """
    rows = read_json(Path(path))
    if not (isinstance(rows, list) and len(rows) == 4 and all(
            isinstance(row, list) and len(row) == 4
            and all(type(value) in (int, float) for value in row) for row in rows)):
        raise ConfigError(
            f"{path} holds something else than a matrix of 4 rows of 4 numbers.",
            hint="For example [[0.01, 0, 0, 0], [0, 0.01, 0, 0], [0, 0, 0.01, 0], [0, 0, 0, 1]].")
    return [float(value) for row in rows for value in row]
