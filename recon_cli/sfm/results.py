"""What each step of the mapping process finds, as its log keeps it and the stage reads it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from recon_cli.sfm.job import MappingJob
from recon_cli.workspace.json_record import KEY, JsonRecord
from recon_cli.workspace.steps import Record, StepFolder
from recon_cli.workspace.summaries import AttemptSummary, PosesSummary, WorldSummary

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
class PartResult(JsonRecord):
    """A part of the capture; figures without tracks are None. See also `SfmSummary`."""

    registered: Names  # frames with a camera, sorted
    points: int
    mean_track_length: float | None
    reprojection_error_px: float | None
    median_triangulation_angle_deg: float | None
    rejected: Mapping[str, str]
    verdict: Mapping[str, Any] | None
    lines: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class EarlierRun(JsonRecord):
    """The run that found the parts, where another one takes a part of them."""

    segments: int
    cpu_seconds: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class ModelResult(StepResult):
    """The parts of the capture, and how they were found; see `SfmSummary`."""

    parts: tuple[PartResult, ...]  # that which shows most first
    models: tuple[int, ...]
    poses: PosesSummary | None = field(default_factory=lambda: None)
    apart: tuple[Names, ...] = ()
    attempts: tuple[AttemptSummary, ...] = field(default=(), metadata={KEY: "rungs"})
    broken: tuple[str, ...] = ()
    left_out: Names = ()
    notes: tuple[str, ...] = ()
    earlier: EarlierRun | None = field(default=None, metadata={KEY: "finished"})


@dataclass(frozen=True, kw_only=True)
class PlacedResult(StepResult):
    """The world frame of the part that is placed."""

    world: WorldSummary


@dataclass(frozen=True, kw_only=True)
class UndistortedResult(StepResult):
    """Its undistorted cameras: width, height, focal_px and frames."""

    cameras: tuple[Mapping[str, float], ...]


# By step; see `job.STEPS`.
RESULTS: Mapping[str, type[StepResult]] = {
    "features": FeaturesResult, "matches": MatchesResult, "split": SplitResult,
    "model": ModelResult, "sparse": PlacedResult, "undistorted": UndistortedResult}


@dataclass(frozen=True)
class MappingResult:
    """What a finished job found."""

    model: ModelResult
    world: WorldSummary
    cameras: tuple[Mapping[str, float], ...]  # undistorted
    seconds: Mapping[str, float]  # by step
    cpu_seconds: Mapping[str, float]

    @classmethod
    def read(cls, job: MappingJob) -> MappingResult:
        """Returns what the log of a job says, all of whose steps are finished."""
        log = StepFolder(job.out)

        def result(step: str, kind: type[Record]) -> Record:
            found = log.find(step, kind)
            assert found is not None, f"the mapping process ended without {step}"
            return found

        placed = result("sparse", PlacedResult)
        every = {step: result(step, StepResult) for step in job.steps}
        return cls(
            result("model", ModelResult), replace(placed.world, seconds=placed.seconds),
            result("undistorted", UndistortedResult).cameras,
            {step: each.seconds for step, each in every.items()},
            {step: each.cpu_seconds for step, each in every.items()})
