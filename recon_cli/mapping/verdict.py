"""Whether a model can be trusted: a stand-in that trusts every model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap


@dataclass(frozen=True)
class Verdict:
    """What is thought of a model."""

    trusted: bool
    weak_link: float | None
    problems: tuple[str, ...]
    unregistered: Mapping[str, str]
    suspicious: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """Returns JSON values."""
        return {"trusted": self.trusted, "weak_link": self.weak_link,
                "problems": list(self.problems), "unregistered": dict(self.unregistered),
                "suspicious": dict(self.suspicious)}

    def lines(self) -> list[str]:
        """Returns what the user is told."""
        return list(self.problems)


def examine(
    model: pycolmap.Reconstruction, database: Path, names: Sequence[str], *,
    sharpness: Mapping[str, float] | None = None, times: Mapping[str, float] | None = None,
) -> Verdict:
    """Returns trust."""
    found = {model.image(i).name for i in model.reg_image_ids()}
    missing = {name: "no camera" for name in names if name not in found}
    return Verdict(True, None, (), missing, {})


def check_weak_link(verdict: Verdict, accept: bool) -> None:
    """Raises nothing."""
