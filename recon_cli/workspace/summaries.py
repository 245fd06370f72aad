"""Typed records between stages: what a stage returns, and the JSON files that others read.

The pipeline stores a stage's record as `summary` in its manifest; later stages read it by
`from_json`, see `json_record`.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recon_cli.errors import FormatError, Hint, name_command
from recon_cli.workspace.atomic import parse_json, read_json, read_text
from recon_cli.workspace.json_record import KEY
from recon_cli.workspace.json_record import JsonRecord as JsonRecord  # whoever reads a record


@dataclass(frozen=True, kw_only=True)
class IngestSummary(JsonRecord):
    """What ingest read and wrote."""

    kind: str  # video, photos, mixed, or the layout of a data set
    declared_frames: int  # according to the files' headers; 0 where unknown
    decoded_frames: int  # complete ones
    lost_frames: int  # missing or damaged
    dropped_blurred: int  # complete frames that were too blurred, clipped or flat
    skipped: tuple[str, ...] = ()  # names of the files that were left out
    metric: bool | None = None  # the poses of a data set are in metres; None without poses
    points: int | None = None  # of a data set; None where it has none
    frames: int  # written
    held_out: int  # of these, for the score
    groups: int  # of frames that share intrinsics
    width: int  # pixels, of the largest group
    height: int


@dataclass(frozen=True, kw_only=True)
class DenoiseSummary(JsonRecord):
    """Which frames denoise filtered."""

    mode: str
    frames: int
    denoised: int
    median_sigma_255: float  # noise of the median frame in 1/255


@dataclass(frozen=True, kw_only=True)
class AttemptSummary(JsonRecord):
    """The outcome of one mapper; see `sfm.fallbacks.MapperAttempt`."""

    name: str  # of the mapper or of its choice of pairs
    reason: str  # for trying it
    skipped: str  # why it was not run; empty where it was
    registered: int  # frames with a camera
    models: tuple[int, ...]  # frames in the model and in what is left of the others
    weak_link: float | None  # share of the matches that agree across the weakest cut
    reprojection_error_px: float | None  # mean; None without a model
    seconds: float
    kept: bool  # its model is the result


@dataclass(frozen=True, kw_only=True)
class PosesSummary(JsonRecord):
    """How given poses were used, and how far refinement moved them (None where it did not)."""

    # keep; refine or auto, which start from them; refuted: by the pictures, so not used
    use: str
    metric: bool  # in metres
    moved_median: float | None = None  # of the camera centres, as a share of their path's size
    moved_max: float | None = None
    turned_median_deg: float | None = None
    turned_max_deg: float | None = None
    reprojection_error_px_before: float | None = None  # mean, with the given poses
    held: int | None = None  # frames that only the given poses could place


@dataclass(frozen=True, kw_only=True)
class WorldEvidence(JsonRecord):
    """Measurements behind the world frame; None where something was not measured or not found."""

    up_found: bool  # z is up
    up_reason: str  # why it is not; empty where it is
    camera_roll_deg: float | None  # median angle of the cameras' x axes to the horizontal
    camera_spread_deg: float | None  # standard deviation of their directions within it
    camera_error_deg: float | None  # standard error of up from the cameras alone
    upright_share: float | None  # of the cameras whose image is not upside down
    floor_found: bool  # z is 0 on the floor
    floor_share: float | None  # of the points that lie in it
    floor_contrast: float | None  # density of points in it over that right above it
    floor_tilt_deg: float | None  # between its normal and up according to the cameras
    axis: str  # direction of x: walls, cameras (their mean right), mapper or data set
    wall_strength: float | None  # sharpness of the points along the walls over the median direction
    scale_source: str  # arbitrary, data set, measured or fused
    metres: bool  # one world unit is one metre
    scale_error: float | None = None  # relative standard error of a fused scale
    scale_sources: tuple[Mapping[str, Any], ...] = ()  # that were fused, or contradict the others
    # relative standard error of the scale of one part of the capture against that of another
    scale_spread: float | None = None


@dataclass(frozen=True, kw_only=True)
class WorldSummary(JsonRecord):
    """The world frame of a workspace, in place/world.json and in the summary of place."""

    FILE: typing.ClassVar[str] = "world.json"

    similarity: Mapping[str, Any]  # from the mapper's frame; `Similarity.from_json` reads it
    evidence: WorldEvidence
    measurement: Mapping[str, Any] | None  # that gave the scale
    sentences: tuple[str, ...]  # the same for a terminal

    @classmethod
    def read(cls, place: Path) -> WorldSummary | None:
        """Returns the world frame in the finished folder of place; None where there is none.

        Raises:
            ManifestError: the file is of another version.
            FormatError: it is damaged.
        """
        path = place / cls.FILE
        hint = Hint("sfm", again=True)
        return cls.from_json(read_json(path, dict, hint=hint)) if path.exists() else None


@dataclass(frozen=True, kw_only=True)
class PartSummary(JsonRecord):
    """A part of a capture that can be trusted by itself, in sfm/parts."""

    names: tuple[str, ...]  # of its frames, sorted
    points: int
    rejected: Mapping[str, str] = field(default_factory=dict)  # why frames were taken out of it


@dataclass(frozen=True, kw_only=True)
class MappedParts(JsonRecord):
    """The parts of a capture, and how they were found."""

    poses: PosesSummary | None  # None without known poses
    models: tuple[int, ...]  # frames in the model and in what is left of the others
    apart: tuple[tuple[str, ...], ...]  # names of the frames that only other models hold
    attempts: tuple[AttemptSummary, ...] = field(metadata={KEY: "rungs"})
    left_out: tuple[str, ...] = ()  # names of the frames whose camera is in no part
    parts: tuple[PartSummary, ...] = ()  # that which shows most first; none in older results
    broken: tuple[str, ...] = ()  # why the model was cut, sentences; none where it was not
    notes: tuple[str, ...] = ()  # sentences on how it was found


@dataclass(frozen=True, kw_only=True)
class SfmSummary(MappedParts):
    """The models that sfm found."""

    frames: int  # of ingest
    seconds: Mapping[str, float]  # by step
    segments: int = 1  # that were mapped apart and joined; 1 for a capture mapped as a whole
    cpu_seconds: Mapping[str, float] | None = None  # by step; those of segments together

    def contradictions(self, options: Mapping[str, Any]) -> tuple[str, ...]:
        """Returns reasons if a part of a broken model was kept, or it was cut into other segments.

        The options are not hashed, so that a refused run can go on with other ones.
        """
        forbids = options["accept_weak"] or not options["partial"]
        cut = bool(self.broken or self.left_out)
        reasons = ["it keeps a part of a broken model"] * (cut and forbids)
        asked = str(options.get("segments", "auto"))
        if asked != "auto" and self.segments != (1 if asked == "off" else int(asked)):
            reasons.append("it was mapped without segments" if self.segments == 1 else
                           f"it was mapped in {self.segments} segments")
        return tuple(reasons)


@dataclass(frozen=True, kw_only=True)
class PlacedPart(JsonRecord):
    """The cameras of one part of the capture in the world, and how far they can be trusted."""

    points: int
    mean_track_length: float | None  # images that see a point; None, as the next two, if given
    reprojection_error_px: float | None  # mean
    median_triangulation_angle_deg: float | None  # widest angle between two rays to a point
    verdict: Mapping[str, Any] | None  # `sfm.verdict.Verdict`; None for poses not examined
    lines: tuple[str, ...]  # the verdict in words
    world: WorldSummary
    cameras: tuple[Mapping[str, float], ...]  # width, height, focal_px (undistorted), frames


@dataclass(frozen=True, kw_only=True)
class PlaceSummary(PlacedPart, SfmSummary):
    """The part of the capture that is used, and what sfm found."""

    registered: int  # frames with a camera
    rejected: Mapping[str, str]  # why frames were taken out of the model, by name
    unregistered: tuple[str, ...]  # names of the frames without a camera
    unregistered_held_out: tuple[str, ...]  # those of them that are held out
    part: int | None = None  # the number of this part; None where there is only one

    @property
    def trusted(self) -> bool | None:
        """Whether the verdict trusts the model; None without a verdict."""
        return None if self.verdict is None else bool(self.verdict["trusted"])

    @property
    def rough(self) -> tuple[str, ...]:
        """The frames whose cameras are known badly, though nothing speaks against them."""
        return () if self.verdict is None else tuple(self.verdict.get("rough", ()))


@dataclass(frozen=True, kw_only=True)
class TrialDecision(JsonRecord):
    """Whether a short trial switched an optional part of the model on."""

    name: str  # of the part
    on: bool
    mean_db: float | None  # mean gain over the views; None where nothing was tried
    standard_error_db: float | None  # of that mean
    reason: str  # one sentence for the log
    seconds: float


@dataclass(frozen=True, kw_only=True)
class TrainPlan(JsonRecord):
    """What training decided before its first step, in plan.json."""

    FILE: typing.ClassVar[str] = "plan.json"

    iterations: int
    max_gaussians: int
    max_size: int  # longest side of a training image, pixels
    first_gaussians: int
    detail: int  # pixels of a mean training view that hold detail
    seconds: float  # expected for the training, with reports and checkpoints
    cost: Mapping[str, Any]  # what the parts of a run take: `time_estimate.TimeEstimator`
    needs: tuple[TrialDecision, ...] = ()
    # steps of the finished run that this one goes on from, 0 for an imported scene; None where it
    # begins anew
    continues_at: int | None = None

    @classmethod
    def read(cls, train: Path) -> TrainPlan:
        """Returns the plan in a folder of train.

        Raises:
            ManifestError: the file is of another version.
            FormatError: it is missing or damaged.
        """
        return cls.from_json(read_json(train / cls.FILE, dict, hint=Hint("train", again=True)))


@dataclass(frozen=True, kw_only=True)
class LogRow(JsonRecord):
    """One line of log.jsonl; None where it holds no such value."""

    FILE: typing.ClassVar[str] = "log.jsonl"

    iteration: int
    seconds: float  # of training from its start
    cpu_seconds: float = 0.0
    loss: float | None = None
    validation_psnr_db: float | None = None
    gaussians: int | None = None
    # to which the run skipped
    skip_to_iteration: int | None = field(default=None, metadata={KEY: "goes_on_at"})

    @classmethod
    def read_all(cls, log: Path) -> tuple[LogRow, ...]:
        """Returns the rows of a log, none if it is missing; an incomplete last line is left out.

        Raises:
            ManifestError: a row is of another version.
            FormatError: a row is damaged.
        """
        try:
            lines = read_text(log).splitlines(True) if log.exists() else []
            # a loss may not be finite: such steps are skipped
            values = [parse_json(line, dict, finite=False)
                      for line in lines if line.endswith("\n")]
        except (OSError, ValueError) as error:
            raise FormatError(f"{log} is damaged: {error}.",
                              hint=f"Run {name_command(f'{log.parent.name} --again')}.") from error
        return tuple(map(cls.from_json, values))


@dataclass(frozen=True, kw_only=True)
class MergeSummary(JsonRecord):
    """The blocks of a scene put together, and what their seams cost."""

    left_out: int  # Gaussians of blocks that lie in the cell of another one
    iterations: int  # steps of fine-tuning on all views
    seam_views: int  # validation views of more than one block; where 0, the next two are None
    # their PSNR less that of the best block that trained beside them, mean and least
    seam_change_db: float | None = None
    worst_seam_db: float | None = None


@dataclass(frozen=True, kw_only=True)
class MovingSummary(JsonRecord):
    """What was masked in training because it moves, in masks.json beside the masks."""

    FILE: typing.ClassVar[str] = "masks.json"

    shares: Mapping[str, float]  # of the pixels, by the names of the views that are masked
    by_hand: tuple[str, ...] = ()  # names of views whose mask a user has made or changed
    views: int  # that training reads, masked or not

    @property
    def share(self) -> float:
        """Share of all pixels that training reads."""
        return sum(self.shares.values()) / max(1, self.views)


@dataclass(frozen=True, kw_only=True)
class VignetteSummary(JsonRecord):
    """The vignette of one camera: exp(a s + b s^2) of the light, s = 1 in the farthest corner."""

    lens: tuple[float, ...]  # of `render.response.lens`
    a: float
    b: float
    corner: float  # share of the light that is left in the corner


@dataclass(frozen=True, kw_only=True)
class PhotometrySummary(JsonRecord):
    """What training took from the images and not from the scene, in photometry.json."""

    FILE: typing.ClassVar[str] = "photometry.json"

    gain_spread: float | None = None  # standard deviation of the log-gains over the views
    vignettes: tuple[VignetteSummary, ...] = ()  # of the cameras

    @classmethod
    def read(cls, folder: Path) -> PhotometrySummary | None:
        """Returns the record in a folder of train or prune; None where nothing was fitted.

        Raises:
            ManifestError: the file is of another version.
            FormatError: it is damaged.
        """
        path = folder / cls.FILE
        hint = Hint("train", again=True)
        return cls.from_json(read_json(path, dict, hint=hint)) if path.exists() else None


@dataclass(frozen=True, kw_only=True)
class TrainSummary(JsonRecord):
    """How a training ended; one in blocks adds up steps and times of all of them."""

    imported_from: str | None = None  # name of the file that it started from
    continued_from_step: int | None = None  # of the finished run that it went on from
    iterations: int  # steps taken
    gaussians: int
    initial_gaussians: int
    max_gaussians: int
    max_size: int  # longest side of a training image, pixels
    planned_iterations: int
    stopped_early_at: int | None
    training_views: int
    validation_views: int
    width: int  # of the largest training image
    height: int
    sizes: tuple[tuple[int, ...], ...] | None = None  # (width, height), where they differ
    validation_psnr_db: float | None  # None without validation views
    train_seconds: float
    parts: Mapping[str, Any]  # optional parts of the model, by the names of their options
    skipped_steps: int  # the loss was not finite
    estimated_seconds: float
    calibration_seconds: float
    cuda_peak_bytes: int
    blocks: int | None = None  # that were trained apart; None for one model
    merge: MergeSummary | None = None  # of these
    moving: MovingSummary | None = None  # None where nothing is masked
    photometry: PhotometrySummary | None = None  # None where none was fitted


@dataclass(frozen=True, kw_only=True)
class RoundSummary(JsonRecord):
    """One round of pruning."""

    gaussians: int  # left
    removed: int
    validation_psnr_db: float | None  # at its end
    kept: bool  # False where it cost too much and was undone


@dataclass(frozen=True, kw_only=True)
class PruneSummary(JsonRecord):
    """What was removed, and what it cost; PSNR is None without validation views."""

    at: str  # end or mid
    score: str
    ratio: float  # share that was removed
    gaussians_before: int
    gaussians: int
    validation_psnr_db_pruned: float | None  # right after the first removal
    rounds: tuple[RoundSummary, ...]
    iterations: int  # steps taken, those before included
    recovery_steps: int
    validation_psnr_db_before: float | None
    validation_psnr_db: float | None
    train_seconds: float  # those of the training before included


@dataclass(frozen=True, kw_only=True)
class EvaluateSummary(JsonRecord):
    """Mean scores on the held-out views, of the models that there are."""

    test_views: int
    unregistered_test: tuple[str, ...]  # names of held-out views without a camera
    masked_out_test: tuple[str, ...] | None = None  # of those whose masks leave too little
    base_psnr_db: float | None = None  # None where only the compact model was wanted
    base_ssim: float | None = None
    base_gaussians: int | None = None
    pruned_psnr_db: float | None = None
    pruned_ssim: float | None = None
    pruned_gaussians: int | None = None
    base_gain_psnr_db: float | None = None  # after the best gain of each view, with --exposure
    pruned_gain_psnr_db: float | None = None
    poorly_seen: tuple[str, ...] | None = None  # largest regions, a line each; docs/trust.md


@dataclass(frozen=True, kw_only=True)
class ExportChange(JsonRecord):
    """The Gaussians and dB that an option of export removed."""

    option: str
    gaussians: int
    gaussians_before: int
    degree: int  # of the spherical harmonics
    degree_before: int
    psnr_change_db: float  # on the views that the export is checked on


@dataclass(frozen=True, kw_only=True)
class ExportSummary(JsonRecord):
    """The result of export: a .ply, which the other formats are compared with."""

    model: str  # base or pruned
    file: str  # name of the .ply
    gaussians: int
    bytes: int  # of the .ply
    transform: Mapping[str, Any]  # similarity from the world of the training to the files
    changes: tuple[ExportChange, ...] | None = None  # by options, in order


@dataclass(frozen=True, kw_only=True)
class ExportedFile(JsonRecord):
    """A file or folder of another format beside the exported .ply."""

    file: str  # name
    bytes: int | None = None  # None for a folder of cameras
    # None, as the next one, for what is not of Gaussians
    smaller: float | None = None  # size of the .ply over its size
    psnr_change_db: float | None = None  # on the views that the export is checked on
    psnr_db: float | None = None  # of the file on them; None where an older version wrote it
    inferred_share: float | None = None  # of a mesh: share of its area that no view confirms


@dataclass(frozen=True, kw_only=True)
class ImportSummary(JsonRecord):
    """The imported scene, and how well it fits the views of the workspace."""

    imported_from: str  # name of the file
    format: str
    gaussians: int
    sh_degree: int
    sha256: str  # of the file, its first 12 digits
    views: int  # training views that it was compared with; where 0, the next five are None
    frame: str | None = None  # coordinate frame of the file: source or workspace
    training_psnr_db: float | None = None  # on these views
    flat_psnr_db: float | None = None  # of flat images in the mean colours of the views
    tried_psnr_db: Mapping[str, float] | None = None  # by frame
    transform: Mapping[str, Any] | None = None  # similarity from the file to the workspace
    notices: tuple[str, ...] | None = None  # for the user
