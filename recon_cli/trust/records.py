"""What trust.json holds: the expected errors of a scene, and how well its surface is seen.

Without torch, so that whoever shows it starts at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import Hint
from recon_cli.workspace.atomic import read_json, write_json
from recon_cli.workspace.summaries import JsonRecord

FOLDER = "trust"  # in that of evaluate
RECORD = "trust.json"
MIN_SPAN_DEG = 10.0  # below, depth hangs on a fraction of a pixel
# Weights without any evidence, and where to the fit is drawn: those of seven captures, rounded, a
# third of each missing (tests/bench/fit_trust_weights.py); the rooms that docs/trust.md shows are
# not among them.
PRIOR: Mapping[str, float] = {
    "hole": 1.5, "few": 0.05, "angle": 0.25, "residual": 0.55, "depth": 0.03, "color": 0.4,
    "nearer": 0.2, "edges": 0.05}
TERMS = tuple(PRIOR)


@dataclass(frozen=True, kw_only=True)
class ErrorModel(JsonRecord):
    """The calibrated model of a scene, as trust.json holds it."""

    bias: float
    weights: Mapping[str, float]  # by the names of TERMS
    means: Mapping[str, float]  # of the terms over the pixels that it was fitted to
    views: int  # that it was fitted to
    calibrated: bool  # on validation views; else on training views, which flatter

    def expect(self, terms: Mapping[str, NDArray[np.float32]]) -> NDArray[np.float32]:
        """Returns the expected absolute error, 0 to 1, for terms of one shape."""
        log = sum(self.weights[name] * terms[name] for name in TERMS) + self.bias
        return np.asarray(np.exp(np.minimum(log, 0)), np.float32)


@dataclass(frozen=True, kw_only=True)
class SurfaceShares(JsonRecord):
    """Shares of the surface that some training view shows; they add up to 1."""

    well: float  # by MIN_OBSERVATIONS views or more that span MIN_SPAN_DEG or more
    narrow: float  # by so many views, but from one direction
    few: float  # by fewer views
    cells: int  # of the surface


@dataclass(frozen=True, kw_only=True)
class PoorlySeenRegion(JsonRecord):
    """A region of surface that is not well seen, as `surface` counts it."""

    position: tuple[float, ...]  # [3] of its middle, on the surface; world units
    size: float  # its longest side, world units
    share: float  # of the surface
    few: bool  # most of it is shown by too few views, and not by views from one direction
    views: int  # that show it, the median of its Gaussians
    span_deg: float  # angle that the rays of these views span, the median
    frame: str  # name of the training view that shows most of it

    @property
    def cause(self) -> str:
        """Why it is poorly seen, in words."""
        views = f"{self.views} view{'' if self.views == 1 else 's'}"
        if self.few:
            return f"only {views} show{'s' if self.views == 1 else ''} it"
        return f"{views} show it, from directions only {self.span_deg:.0f} degrees apart"

    def describe(self, unit: str) -> str:
        """Returns the region in words; `unit` is m or scene units."""
        x, y, z = self.position
        return (f"at {x:.2f} {y:.2f} {z:.2f}, {self.size:.2g} {unit} across, {self.share:.1%} of "
                f"the surface: {self.cause}; {self.frame} shows most of it")


@dataclass(frozen=True, kw_only=True)
class Agreement(JsonRecord):
    """Expected against real errors of views that neither trained nor calibrated."""

    views: int
    ause: float  # of the expected error, mean over the views
    ause_opacity: float  # of 1 - alpha, for comparison
    ause_depth: float  # of the depth
    expected: tuple[float, ...]  # mean errors in ten bins of equally many pixels
    real: tuple[float, ...]
    gap: float  # mean of |expected - real| / real over the bins


@dataclass(frozen=True, kw_only=True)
class ModelTrust(JsonRecord):
    """The record of one model in trust.json."""

    views: int  # training views that were looked at
    error: ErrorModel
    surface: SurfaceShares
    agreement: Agreement | None = None  # None without held-out views


@dataclass(frozen=True, kw_only=True)
class TrustRecord(JsonRecord):
    """trust.json: the models of a workspace, and the largest poorly seen regions."""

    models: tuple[str, ...]
    base: ModelTrust | None = None
    pruned: ModelTrust | None = None
    reason: str = ""  # why it was not measured; empty where it was
    metres: bool = False  # world units are metres
    poorly_seen: tuple[PoorlySeenRegion, ...] = ()  # of the model that export takes

    @staticmethod
    def read(evaluate: Path) -> TrustRecord | None:
        """Returns the record in evaluate's folder; None where an earlier version left none.

        FormatError or ManifestError if it is damaged.
        """
        path = evaluate / FOLDER / RECORD
        hint = Hint("eval", again=True)
        return TrustRecord.from_json(read_json(path, dict, hint=hint)) if path.exists() else None

    def write(self, evaluate: Path) -> None:
        """Writes the record into evaluate's folder."""
        write_json(evaluate / FOLDER / RECORD, self.to_json())

    def model_trust(self, model: str) -> ModelTrust | None:
        """Returns the record of base or pruned."""
        return {"base": self.base, "pruned": self.pruned}[model]

    @property
    def unit(self) -> str:
        """The unit of positions, for people."""
        return "m" if self.metres else "scene units"

    def lines(self) -> list[str]:
        """Returns the poorly seen regions in words, a line each."""
        return [f"poorly seen ({number}) {region.describe(self.unit)}"
                for number, region in enumerate(self.poorly_seen, 1)]
