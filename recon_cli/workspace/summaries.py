"""What the stages return: one frozen record a stage, kept as `summary` in its manifest.

A stage builds its record, the pipeline commits `to_json()`, and whoever reads the result of another
stage reads the same type by `from_json`. Fields are the JSON keys, in their order. A field whose
default is None is left out of the JSON while it is None; every other field is always written.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from recon_cli.errors import ManifestError
from recon_cli.workspace.atomic import read_json


@dataclass(frozen=True)
class JsonRecord:
    """A frozen dataclass of JSON values, tuples of them and other such records."""

    def to_json(self) -> dict[str, Any]:
        """Returns JSON values that `from_json` reads; tuples become lists."""
        value = {}
        for field in dataclasses.fields(self):
            item = getattr(self, field.name)
            if item is not None or field.default is not None:
                value[field.name] = _encoded(item)
        return value

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """Returns the record that `to_json` wrote; keys that it does not know are ignored.

        Raises:
            ManifestError: the value is no mapping or lacks a field, as that of another version may.
        """
        if not isinstance(value, Mapping):
            raise ManifestError("the summary is not a JSON object")
        kinds = typing.get_type_hints(cls)
        fields = dataclasses.fields(cls)
        missing = [
            field.name for field in fields if field.name not in value
            and field.default is dataclasses.MISSING
            and field.default_factory is dataclasses.MISSING]
        if missing:
            raise ManifestError(
                f"the summary lacks {', '.join(missing)}: another version of recon wrote it")
        return cls(**{
            field.name: _decoded(kinds[field.name], value[field.name])
            for field in fields if field.name in value})


def _encoded(item: Any) -> Any:
    if isinstance(item, JsonRecord):
        return item.to_json()
    if isinstance(item, (tuple, list)):
        return [_encoded(part) for part in item]
    if isinstance(item, Mapping):
        return {key: _encoded(part) for key, part in item.items()}
    return item


def _decoded(kind: Any, item: Any) -> Any:
    """Returns a JSON value as the type that a field is annotated with."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):  # X | None
        return None if item is None else _decoded(arguments[0], item)
    if origin is tuple and isinstance(item, (list, tuple)):
        return tuple(_decoded(arguments[0], part) for part in item)
    if origin is Mapping and isinstance(item, Mapping):
        return {key: _decoded(arguments[1], part) for key, part in item.items()}
    if isinstance(kind, type) and issubclass(kind, JsonRecord):
        return kind.from_json(item)
    return item


@dataclass(frozen=True, kw_only=True)
class IngestSummary(JsonRecord):
    """What ingest read and wrote.

    Attributes:
        kind: "video", "photos", "mixed" or the layout of a data set.
        declared_frames: that the files claim to hold; 0 where unknown.
        decoded_frames: whole ones.
        lost_frames: missing or damaged.
        dropped_blurred: whole frames that were too blurred, clipped or flat.
        skipped: names of the files that were left out.
        metric: the poses of a data set are in metres; None without poses.
        points: that a data set brings; None where it brings none.
        frames: that were written.
        held_out: how many of them are held out for the score.
        groups: of frames that share intrinsics.
        width: of the frames of the largest group, in pixels.
        height: of the frames of the largest group, in pixels.
    """

    kind: str
    declared_frames: int
    decoded_frames: int
    lost_frames: int
    dropped_blurred: int
    skipped: tuple[str, ...] = ()
    metric: bool | None = None
    points: int | None = None
    frames: int
    held_out: int
    groups: int
    width: int
    height: int


@dataclass(frozen=True, kw_only=True)
class DenoiseSummary(JsonRecord):
    """What denoise did; `median_sigma_255` is the noise of the median frame in 1/255."""

    mode: str
    filter: str
    frames: int
    denoised: int
    median_sigma_255: float


@dataclass(frozen=True, kw_only=True)
class AttemptSummary(JsonRecord):
    """What became of one mapper that was tried; see `sfm.fallbacks.MapperAttempt`.

    Attributes:
        name: of the mapper or of its choice of pairs.
        reason: why it was tried.
        skipped: why it was not run; empty where it was.
        registered: frames that got a camera.
        models: frames in the model and in what is left of the others.
        weak_link: share of the matches that agree across the weakest cut; None where unknown.
        reprojection_error_px: mean; None without a model.
        seconds: that it took.
        kept: its model is the result.
    """

    name: str
    reason: str
    skipped: str
    registered: int
    models: tuple[int, ...]
    weak_link: float | None
    reprojection_error_px: float | None
    seconds: float
    kept: bool


@dataclass(frozen=True, kw_only=True)
class PosesSummary(JsonRecord):
    """How given poses were used; how far refining moved them, None where it did not.

    Attributes:
        use: "keep" or "refine".
        metric: they are in metres.
        moved_median: of the camera centres, as a share of the size of their path.
        moved_max: the same of the camera that moved most.
        turned_median_deg: of the orientations.
        turned_max_deg: of the camera that turned most.
        reprojection_error_px_before: mean, with the poses as they were given.
    """

    use: str
    metric: bool
    moved_median: float | None = None
    moved_max: float | None = None
    turned_median_deg: float | None = None
    turned_max_deg: float | None = None
    reprojection_error_px_before: float | None = None


@dataclass(frozen=True, kw_only=True)
class WorldEvidence(JsonRecord):
    """Why the world frame is as it is. None stands for what was not measured or not found.

    Attributes:
        up_found: z is up.
        up_reason: why it is not; empty where it is.
        camera_roll_deg: median angle of the cameras' x axes to the horizontal.
        camera_spread_deg: standard deviation of their directions within it.
        camera_error_deg: standard error of up from the cameras alone.
        upright_share: of the cameras whose image is not upside down.
        floor_found: z is 0 on the floor.
        floor_share: of the points that lie in it.
        floor_contrast: density of points in it over that right above it.
        floor_tilt_deg: between its normal and up as the cameras have it.
        axis: direction of x: "walls", "cameras" (their mean right) or "mapper".
        wall_strength: how much sharper the points line up along the walls than along a median
            direction.
        scale_source: "arbitrary", "data set" or "measured".
        metres: one world unit is one metre.
    """

    up_found: bool
    up_reason: str
    camera_roll_deg: float | None
    camera_spread_deg: float | None
    camera_error_deg: float | None
    upright_share: float | None
    floor_found: bool
    floor_share: float | None
    floor_contrast: float | None
    floor_tilt_deg: float | None
    axis: str
    wall_strength: float | None
    scale_source: str
    metres: bool


@dataclass(frozen=True, kw_only=True)
class WorldSummary(JsonRecord):
    """The world frame of a workspace, as sfm/world.json and the summary of sfm hold it.

    Attributes:
        similarity: from the mapper's frame to the world; `Similarity.from_json` reads it.
        evidence: for it.
        measurement: what gave the scale; None where nothing was measured.
        sentences: the same for a terminal.
        seconds: that it took.
    """

    FILE: typing.ClassVar[str] = "world.json"

    similarity: Mapping[str, Any]
    evidence: WorldEvidence
    measurement: Mapping[str, Any] | None
    sentences: tuple[str, ...]
    seconds: float | None = None

    @classmethod
    def read(cls, sfm: Path) -> WorldSummary | None:
        """Returns the world frame that the finished folder of sfm holds; None where there is none.

        Raises:
            ManifestError: the file is of another version.
            FormatError: it is damaged.
        """
        path = sfm / cls.FILE
        return cls.from_json(read_json(path)) if path.exists() else None


@dataclass(frozen=True, kw_only=True)
class SfmSummary(JsonRecord):
    """The cameras that sfm found, and how far they can be trusted.

    Attributes:
        frames: of ingest.
        registered: frames with a camera.
        points: of the model.
        mean_track_length: images that see a point; None, as the next two, for given points.
        reprojection_error_px: mean.
        median_triangulation_angle_deg: widest angle between two rays to a point.
        poses: of known poses; None without.
        models: frames in the model and in what is left of the others.
        apart: names of the frames that only other models hold.
        rejected: why frames were taken out of the model, by name.
        verdict: `sfm.verdict.Verdict` as JSON; None where given poses were not examined.
        lines: the verdict in words.
        rungs: the mappers that were tried.
        seconds: by step.
        unregistered: names of the frames without a camera.
        unregistered_held_out: those of them that are held out.
        world: the world frame.
        cameras: width, height, focal_px (undistorted) and frames of each.
    """

    frames: int
    registered: int
    points: int
    mean_track_length: float | None
    reprojection_error_px: float | None
    median_triangulation_angle_deg: float | None
    poses: PosesSummary | None
    models: tuple[int, ...]
    apart: tuple[tuple[str, ...], ...]
    rejected: Mapping[str, str]
    verdict: Mapping[str, Any] | None
    lines: tuple[str, ...]
    rungs: tuple[AttemptSummary, ...]
    seconds: Mapping[str, float]
    unregistered: tuple[str, ...]
    unregistered_held_out: tuple[str, ...]
    world: WorldSummary
    cameras: tuple[Mapping[str, float], ...]

    @property
    def trusted(self) -> bool | None:
        """Whether the verdict trusts the model; None without a verdict."""
        return None if self.verdict is None else bool(self.verdict["trusted"])


@dataclass(frozen=True, kw_only=True)
class ImportSummary(JsonRecord):
    """The scene that was imported, and how well it fits the views of the workspace.

    Attributes:
        imported_from: name of the file.
        format: of the file.
        gaussians: count.
        sh_degree: of the colours.
        sha256: of the file, its first 12 digits.
        views: training views that it was compared with; 0 without views, and None below.
        frame: coordinate frame of the file, "source" or "workspace".
        training_psnr_db: on these views.
        flat_psnr_db: of flat images in the mean colours of the views.
        tried_psnr_db: by frame that was tried.
        transform: similarity from the file to the workspace.
        notices: for the user; None where there are none.
    """

    imported_from: str
    format: str
    gaussians: int
    sh_degree: int
    sha256: str
    views: int
    frame: str | None = None
    training_psnr_db: float | None = None
    flat_psnr_db: float | None = None
    tried_psnr_db: Mapping[str, float] | None = None
    transform: Mapping[str, Any] | None = None
    notices: tuple[str, ...] | None = None


@dataclass(frozen=True, kw_only=True)
class ExportChange(JsonRecord):
    """What an option of export removed.

    Attributes:
        option: name of the field.
        gaussians: that are left.
        gaussians_before: count.
        degree: of the colours that is left.
        degree_before: of the colours.
        psnr_change_db: on the views that the export is checked on.
    """

    option: str
    gaussians: int
    gaussians_before: int
    degree: int
    degree_before: int
    psnr_change_db: float


@dataclass(frozen=True, kw_only=True)
class ExportedFile(JsonRecord):
    """A file or folder beside the exported .ply; the size and loss are None for cameras and points.

    Attributes:
        file: its name.
        bytes: its size.
        smaller: size of the .ply over its size.
        psnr_change_db: on the views that the export is checked on.
    """

    file: str
    bytes: int | None = None
    smaller: float | None = None
    psnr_change_db: float | None = None


@dataclass(frozen=True, kw_only=True)
class ExportSummary(JsonRecord):
    """What export wrote.

    Attributes:
        model: "base" or "pruned".
        file: name of the .ply.
        gaussians: count.
        bytes: size of the .ply.
        transform: similarity from the world of the training to that of the files.
        changes: what options removed, in order; None where nothing was asked for.
        files: the other formats by name; None where there are none.
    """

    model: str
    file: str
    gaussians: int
    bytes: int
    transform: Mapping[str, Any]
    changes: tuple[ExportChange, ...] | None = None
    files: Mapping[str, ExportedFile] | None = None
