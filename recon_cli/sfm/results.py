"""What each step of the mapping process finds, as its log keeps it and the stage reads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from recon_cli.sfm.job import MappingJob
from recon_cli.workspace.json_record import JsonRecord
from recon_cli.workspace.steps import StepFolder
from recon_cli.workspace.summaries import MappedParts

Names = tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class StepResult(JsonRecord):
    """What every step says."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0


@dataclass(frozen=True, kw_only=True)
class CountedResult(StepResult):
    """What a step says that fills the database."""

    rows: int  # images with features, or pairs that were matched


@dataclass(frozen=True, kw_only=True)
class FeaturesResult(CountedResult):
    """How many features there are."""

    keypoints: int


@dataclass(frozen=True, kw_only=True)
class MatchesResult(CountedResult):
    """How many matches there are."""

    verified_pairs: int
    matches: int  # verified
    poses_share: float | None = None  # of the matches, that agree with given poses
    poses_contradicted: Names = ()  # frames whose given poses their own matches contradict


@dataclass(frozen=True, kw_only=True)
class SplitResult(StepResult):
    """The names of the frames of each segment."""

    segments: tuple[Names, ...]


@dataclass(frozen=True, kw_only=True)
class ModelResult(StepResult, MappedParts):
    """What the mapper and its fallbacks found."""


# By step; see `job.STEPS`.
RESULTS: Mapping[str, type[StepResult]] = {
    "features": FeaturesResult, "matches": MatchesResult, "split": SplitResult,
    "model": ModelResult}


@dataclass(frozen=True)
class MappingResult:
    """What a finished job found."""

    model: ModelResult
    seconds: Mapping[str, float]  # by step
    cpu_seconds: Mapping[str, float]

    @classmethod
    def read(cls, job: MappingJob) -> MappingResult:
        """Returns what the log of a job says, all of whose steps are finished."""
        log = StepFolder(job.out)
        model = log.find("model", ModelResult)
        every = {step: log.find(step, StepResult) for step in job.steps}
        assert model is not None, "the mapping process ended without a model"
        return cls(
            model, {step: each.seconds for step, each in every.items() if each},
            {step: each.cpu_seconds for step, each in every.items() if each})
