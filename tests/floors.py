"""Prints the lowest versions that pyproject.toml allows, as constraints of pip.

`make test-floors` installs and tests them: `python tests/floors.py pyproject.toml > floors.txt`.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

# A bound from below and nothing else: any other form says nothing that could be installed.
REQUIREMENT = re.compile(
    r"(?P<name>[A-Za-z0-9][\w.-]*)>=(?P<version>\d+(?:\.\d+)*)(?P<marker>\s*;.*)?")


def read_requirements(pyproject: Path) -> list[str]:
    """Returns the requirements of the package and of all its extras, as they are written."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    return [*project["dependencies"],
            *(each for extra in project["optional-dependencies"].values() for each in extra)]


def lowest(requirement: str) -> str:
    """Returns `name==x` for `name>=x`, with the marker, if any."""
    found = REQUIREMENT.fullmatch(requirement)
    if found is None:
        raise ValueError(f"{requirement!r} is not name>=version")
    return f"{found['name']}=={found['version']}{found['marker'] or ''}"


def floors(pyproject: Path) -> list[str]:
    """Returns one constraint for each package; ones that contradict each other make pip stop."""
    return sorted({lowest(requirement) for requirement in read_requirements(pyproject)})


if __name__ == "__main__":
    print(*floors(Path(sys.argv[1])), sep="\n")
