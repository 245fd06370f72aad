"""One scale from all evidence: tracked poses, sensor depth, the data set, a measured distance.

Each source says how many metres a unit has, and how exactly. Sources that agree are averaged by
their inverse variance; one that contradicts the others is named and not used.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

from recon_cli.errors import list_names
from recon_cli.scene.statistics import OUTLIER_SIGMAS
from recon_cli.workspace.json_record import JsonRecord

# sources
MEASURED_BETWEEN, GIVEN = "--scale-between", "the data set"
# Relative error of the unit of a data set in metres, and of the motions that a phone tracked, which
# is the same in all of a capture: assumed, as of phones 0.3 to 1% are reported.
GIVEN_ERROR = 0.003
INTERVAL = 1.96  # standard errors, of an interval of 95% of a normal distribution
# Where as many sources contradict as agree, the interval reaches to all, up to this share; what is
# farther apart is a wrong unit, and no scale is taken.
MOST_UNSURE = 0.2


@dataclass(frozen=True)
class ScaleSource(JsonRecord):
    """What one source says about the scale."""

    name: str  # as in a sentence
    scale: float  # metres in a unit
    error: float  # relative standard error


@dataclass(frozen=True)
class FusedScale(JsonRecord):
    """The scale by all sources that agree."""

    scale: float | None  # metres in a unit; None where sources contradict and none can be chosen
    error: float  # relative standard error
    used: tuple[ScaleSource, ...]
    contradicting: tuple[ScaleSource, ...]

    @property
    def interval(self) -> float:
        """Half of the interval of 95%, as a share of a length."""
        return INTERVAL * self.error

    def describe(self) -> tuple[str, ...]:
        """Returns sentences for the terminal."""
        if self.scale is None:
            return (f"The scale is arbitrary, as its sources contradict each other: "
                    f"{describe_sources((*self.used, *self.contradicting))}. "
                    "--scale-between A B METRES decides.",)
        return (f"One unit is one metre, to {self.interval:.1%}, by {_names(self.used)}.",
                *self.describe_contradicting())

    def describe_contradicting(self) -> tuple[str, ...]:
        """Returns a sentence on each source that is not used."""
        return tuple(
            f"The scale by {source.name} is {_differ(source, self.used)} than by "
            f"{_names(self.used)}: it is not used." for source in self.contradicting)


def describe_sources(sources: Sequence[ScaleSource]) -> str:
    """Returns what each source says."""
    return "; ".join(f"by {source.name} a unit has {source.scale:.4g} m" for source in sources)


def fuse(sources: Sequence[ScaleSource], *, decisive: str | None = None) -> FusedScale:
    """Returns the scale of one source or more, given in the order of trust.

    The largest group that agrees is used, in a tie the one with the most trusted sources. A source
    named `decisive` is in it in any case.
    """
    groups = [group for size in range(len(sources), 0, -1)
              for group in itertools.combinations(sources, size)
              if all(_agree(one, other) for one, other in itertools.combinations(group, 2))
              and (decisive is None or any(source.name == decisive for source in group))]
    used = groups[0]  # combinations come in the order of trust
    others = tuple(source for source in sources if source not in used)
    weights = [source.error**-2 for source in used]
    mean = math.fsum(
        weight * math.log(source.scale) for weight, source in zip(weights, used, strict=True)
    ) / math.fsum(weights)
    error = math.fsum(weights)**-0.5
    if len(used) > 1:  # more apart than their errors say
        chi = math.fsum(weight * (math.log(source.scale) - mean)**2
                        for weight, source in zip(weights, used, strict=True)) / (len(used) - 1)
        error *= max(1.0, math.sqrt(chi))
    if len(others) >= len(used) and decisive is None:
        farthest = max(abs(math.log(source.scale) - mean) for source in others)
        if farthest > MOST_UNSURE:
            return FusedScale(None, math.inf, used, others)
        error = max(error, farthest / INTERVAL)
    # to the bit where one source decides
    scale = used[0].scale if len(used) == 1 else math.exp(mean)
    return FusedScale(scale, error, used, others)


def fuse_measured(scale: float, error: float, known: Sequence[ScaleSource]) -> FusedScale:
    """Returns the scale by what the user measured, which decides, and by what is `known`."""
    return fuse([ScaleSource(MEASURED_BETWEEN, scale, error), *known], decisive=MEASURED_BETWEEN)


def _agree(one: ScaleSource, other: ScaleSource) -> bool:
    apart = abs(math.log(one.scale / other.scale))
    return apart <= OUTLIER_SIGMAS * math.hypot(one.error, other.error)


def _names(sources: Sequence[ScaleSource]) -> str:
    return list_names([source.name for source in sources])


def _differ(source: ScaleSource, used: Sequence[ScaleSource]) -> str:
    ratio = source.scale / used[0].scale
    return f"{ratio - 1:.1%} larger" if ratio > 1 else f"{1 - ratio:.1%} smaller"
