"""What stages return: the typed summary, the files, and their content as arrays when it is read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.workspace.json_record import JsonRecord
from recon_cli.workspace.records import FOLDER, FrameList, read_frame_list
from recon_cli.workspace.summaries import (
    EvaluateSummary,
    ExportSummary,
    IngestSummary,
    LogRow,
    PlaceSummary,
)

if TYPE_CHECKING:  # they import torch, SciPy or pycolmap
    from recon_cli.api.splats import Splats
    from recon_cli.evaluation.scores import ModelMetrics

S = TypeVar("S", bound=JsonRecord)


@dataclass(frozen=True, kw_only=True)
class StageResult(Generic[S]):
    """The result of a stage."""

    stage: str
    folder: Path  # of its files; a later run of the stage replaces them
    ran: bool  # False where it was up to date
    seconds: float  # that it took, when it ran
    summary: S  # as in its manifest
    notices: tuple[str, ...]  # for the user


@dataclass(frozen=True, kw_only=True)
class IngestResult(StageResult[IngestSummary]):
    """The frames that were chosen."""

    @cached_property
    def _list(self) -> FrameList:
        return read_frame_list(self.folder)

    @property
    def frames(self) -> tuple[Path, ...]:
        """The files of the frames."""
        return tuple(self.folder / FOLDER / frame.name for frame in self._list.frames)

    @property
    def held_out(self) -> tuple[str, ...]:
        """The names of the frames that are held out for scores."""
        return tuple(frame.name for frame in self._list.frames if frame.held_out)


@dataclass(frozen=True, kw_only=True)
class SfmResult(StageResult[PlaceSummary]):
    """Cameras of the undistorted views, and sparse points."""

    @cached_property
    def cameras(self) -> Mapping[str, Camera]:
        """The cameras by the names of their frames."""
        from recon_cli.api.cameras import read_cameras

        return read_cameras(self.folder / "undistorted" / "sparse")

    @property
    def points(self) -> NDArray[np.float64]:
        """The sparse points, [P, 3] in world units."""
        return self._points[0]

    @property
    def colors(self) -> NDArray[np.uint8]:
        """Their colours, [P, 3] RGB."""
        return self._points[1]

    @cached_property
    def _points(self) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        from recon_cli.io.colmap import read_points

        return read_points(self.folder / "undistorted" / "sparse" / "points3D.bin")


@dataclass(frozen=True, eq=False)
class TrainingCurve:
    """How a training went, one entry for each report."""

    iteration: NDArray[np.int64]  # [R]
    seconds: NDArray[np.float64]  # [R] of training from its start
    loss: NDArray[np.float64]  # [R] nan where it was not reported
    validation_psnr_db: NDArray[np.float64]  # [R] nan without validation views
    gaussians: NDArray[np.int64]  # [R]


@dataclass(frozen=True, kw_only=True)
class ModelResult(StageResult[S]):
    """Gaussians, of a training, an import or a pruning."""

    @property
    def ply(self) -> Path:
        """Their file."""
        return self.folder / "splats.ply"

    @cached_property
    def splats(self) -> Splats:
        """The Gaussians."""
        from recon_cli.api.splats import Splats

        return Splats.read(self.ply)

    @cached_property
    def curve(self) -> TrainingCurve:
        """How the loss, the validation PSNR and the number of Gaussians went; none of an import."""
        rows = [row for row in LogRow.read_all(self.folder / LogRow.FILE)
                if row.gaussians is not None]
        nan = float("nan")
        return TrainingCurve(
            np.array([row.iteration for row in rows], np.int64),
            np.array([row.seconds for row in rows], np.float64),
            np.array([nan if row.loss is None else row.loss for row in rows], np.float64),
            np.array([nan if row.validation_psnr_db is None else row.validation_psnr_db
                      for row in rows], np.float64),
            np.array([row.gaussians for row in rows], np.int64))


@dataclass(frozen=True, kw_only=True)
class EvaluateResult(StageResult[EvaluateSummary]):
    """The scores on the held-out views."""

    @cached_property
    def metrics(self) -> Mapping[str, ModelMetrics]:
        """The scores of each model, base and pruned, and of its views."""
        from recon_cli.evaluation.scores import Metrics

        return Metrics.read(self.folder).models

    @property
    def table(self) -> str:
        """The table that `recon eval` prints."""
        return (self.folder / "table.txt").read_text(encoding="utf-8")

    def renders(self, model: str = "base") -> tuple[Path, ...]:
        """Returns the files of the rendered views of a model."""
        return tuple(sorted((self.folder / "renders" / model).glob("*.png")))


@dataclass(frozen=True, kw_only=True)
class ExportResult(StageResult[ExportSummary]):
    """The exported files."""

    # files, or folders of files, of the other formats that fit the .ply, by name
    files: Mapping[str, Path] = field(default_factory=dict)

    @property
    def ply(self) -> Path:
        """The .ply."""
        return self.folder / self.summary.file



@dataclass(frozen=True, eq=False)
class View:
    """An undistorted view of a capture with its pixels."""

    name: str  # of its frame
    camera: Camera  # at the size of the image
    image: NDArray[np.uint8]  # [H, W, 3] RGB; one colour under the mask
    mask: NDArray[np.bool_] | None  # [H, W], True where a pixel counts; None where all do
