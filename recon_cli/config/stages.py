"""The options of each stage: one frozen dataclass a stage."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from recon_cli.config import protocols
from recon_cli.config.fields import StageConfig, option
from recon_cli.errors import ConfigError, name_command

SCALE_BETWEEN = (
    "Set the scale: A and B are METRES apart. Each is a frame name (its camera), x,y,z (a point of "
    "the unscaled scene) or FRAME:u,v (a pixel of the undistorted frame).")


@dataclass(frozen=True)
class IngestConfig(StageConfig):
    """Which frames of the capture are kept."""

    frames: int | None = option(
        None, "Number of frames to choose from videos and sequences of images.", unit="frames",
        minimum=3, automatic="by camera motion, up to --max-frames")
    max_frames: int = option(
        3000, "Upper limit of the automatic number.", unit="frames", minimum=3)
    max_size: int = option(
        1920, "Longest side of a stored frame; of a panorama, its height.", unit="pixels",
        minimum=64)
    holdout: str = option(
        "every:8", "Held-out test views: every:N (each Nth by name), segment:A:B (from share A to "
        "share B of the capture) or none.")
    sharpness: float = option(
        0.5, "Minimum sharpness of a video frame relative to its neighbours.", unit="share",
        minimum=0.0, maximum=1.0)
    overlays: str = option(
        "mask", "Text, logos, dirt on the lens or a car's bonnet that stay in place in every frame "
        "of a video, and the black border of a fisheye: mask or keep them.",
        choices=("mask", "keep"))

    camera: str = option(
        "auto", "Projection of the pictures: perspective, equirectangular (360-degree panoramas), "
        "or auto (by metadata and content).",
        choices=("auto", "perspective", "equirectangular"), late=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_holdout(self.holdout)


def parse_holdout(text: str) -> tuple[str, float, float]:
    """Returns (kind, a, b) of --holdout: ("every", N, 0), ("segment", A, B) or ("none", 0, 0)."""
    kind, *numbers = text.split(":")
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = []
    if kind == "none" and not numbers:
        return kind, 0.0, 0.0
    if kind == "every" and len(values) == 1 and values[0] >= 2 and values[0].is_integer():
        return kind, values[0], 0.0
    if kind == "segment" and len(values) == 2 and 0 <= values[0] < values[1] <= 1:
        return kind, values[0], values[1]
    raise ConfigError(
        f"holdout is {text!r}, but it must be every:N (N >= 2), segment:A:B (0 <= A < B <= 1) "
        "or none.",
        hint="Try --holdout every:8.")


@dataclass(frozen=True)
class DenoiseConfig(StageConfig):
    """Whether and how strongly the training images are denoised."""

    mode: str = option(
        "auto", "Frames to denoise: auto (noise above the threshold), force (all) or off (none).",
        choices=("auto", "force", "off"),
        flags={"force": "Denoise every frame.", "off": "Pass every frame through."})
    threshold: float = option(
        3.0, "Noise level of flat regions above which a frame is denoised.", unit="1/255",
        minimum=0.0)
    strength: float = option(
        4.0, "Range sigma of the bilateral filter, as a multiple of the noise.", unit="x noise",
        minimum=0.1)


@dataclass(frozen=True)
class SfmConfig(StageConfig):
    """How cameras and points are found."""

    poses: str = option(
        "auto", "Poses of a data set: keep them, refine them with the pictures, or ignore them. "
        "auto: refine what a phone tracked, if it fits the pictures; keep others.",
        choices=("auto", "keep", "refine", "ignore"))
    pairs: str = option(
        "auto", "Image pairs to match. auto: pairs that a first rough reconstruction shows to "
        "overlap; then more pairs and other mappers if the model is poor.",
        choices=("auto", "exhaustive", "retrieval", "sequential"))
    camera_model: str = option(
        "auto", "Camera model of lenses that are not known, by COLMAP's name; auto: OPENCV, or "
        "what the matches and their errors show, such as OPENCV_FISHEYE.",
        metavar="MODEL", late=True)
    max_features: int = option(
        3000, "Maximum SIFT keypoints per image; the coarsest are kept.", unit="keypoints",
        minimum=100)
    min_registered: float = option(
        0.5, "Fail if a smaller share of the images is registered, in all trusted parts together.",
        unit="share",
        minimum=0.0, maximum=1.0)
    accept_weak: bool = option(
        False, "Continue even if parts of the model are weakly connected, or sources of the scale "
        "contradict each other.", hashed=False)
    partial: bool = option(
        True, "Cut a broken model, and keep the parts that can be trusted on their own.",
        hashed=False)
    part: int = option(
        1, "Part to use of a capture that has several; 1 shows most. Another one needs no new "
        "mapping.", metavar="K", minimum=1)
    seed: int = option(0, "Random seed of the mapper.", minimum=0)
    gravity: str = option(
        "auto", "Turn the world so that z is up and the floor is at 0, if cameras and points show "
        "it; off keeps the axes of the mapper.", choices=("auto", "off"))
    scale_between: tuple[str, str, float] | None = option(
        None, SCALE_BETWEEN, metavar="A B METRES", automatic="arbitrary scale")
    max_minutes: float | None = option(
        None, "Time limit.", unit="minutes", minimum=0.01, hashed=False,
        automatic="20, and 12 s more for each image above 100")
    segments: str = option(
        "auto", "Overlapping segments to map apart and join: auto (above 200 photos or keyframes), "
        "N or off.", metavar="N", hashed=False)
    jobs: int | None = option(
        None, "Segments at once.", minimum=1, hashed=False, expert=True,
        automatic="one for each core, or as many as the cluster has room for")
    on: str = option(
        "local", "Map segments in processes of this machine, or on the Ray cluster at RAY_ADDRESS.",
        choices=("local", "ray"), hashed=False, expert=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_scale_between(self.scale_between)
        _check_number_of("sfm", "segments", self.segments)
        if self.segments.isdecimal() and self.pairs != "auto":
            raise ConfigError(
                f"segments is {self.segments} and pairs is {self.pairs}, but segments choose pairs "
                "by themselves.",
                hint="Leave out --segments or --pairs.")


def _check_number_of(section: str, name: str, asked: str) -> None:
    """Raises ConfigError unless auto, off or a number of at least 1 is asked for."""
    if asked not in ("auto", "off") and not (asked.isdecimal() and int(asked) >= 1):
        raise ConfigError(
            f"{name} is {asked!r}, but needs auto, off or a number of {name}.",
            hint=f"Give --{name} auto, or --set {section}.{name}=auto to a verb without --{name}.")


def check_scale_between(value: tuple[str, str, float] | None) -> None:
    """Raises ConfigError where --scale-between measures nothing."""
    if value is None:
        return
    a, b, metres = value
    hint = "For example --scale-between 000003.png:120,200 000003.png:480,210 1.5"
    if a.strip() == b.strip() or not a.strip() or not b.strip():
        raise ConfigError(
            f"scale_between goes from {a!r} to {b!r}, but it must name two different places.",
            hint=hint)
    if metres <= 0:
        raise ConfigError(
            f"scale_between says {metres:g} metres, but it must be more than 0.", hint=hint)


MODEL_LABELS = {"base": "original", "pruned": "compact"}  # the models as users read them
MIN_GAUSSIANS = 4  # the first ones are as large as the mean distance to 3 neighbours
_VALIDATION = "Share of views for validation."
DENSIFY_UNTIL = 0.6  # share of the run up to which the recipes add Gaussians


@dataclass(frozen=True)
class TrainConfig(StageConfig):
    """How Gaussians are fitted; `train.plan` decides automatic values for a scene."""

    quality: str = option(
        "normal", "Preset: 1500, 2400 or 8000 steps at 400, 600 or 800 pixels.",
        choices=("draft", "normal", "high"))
    minutes: float | None = option(
        None, "Time budget.", unit="minutes", minimum=0.01, automatic="none")
    protocol: str | None = option(
        None, "Protocol of the literature's tables: 3DGS as published, or our recipe.",
        choices=tuple(protocols.PROTOCOLS), automatic="none", late=True)
    densify: str = option(
        "budget", "Add Gaussians where the error is (budget) or as 3DGS does (reference).",
        choices=("budget", "reference"))
    iterations: int | None = option(
        None, "Optimization steps; more than a finished run took continue it.",
        minimum=1, automatic="by --quality")
    batch_views: int = option(
        1, "Views per step; their mean gradient is used.", unit="views", minimum=1,
        expert=True)
    max_size: int | None = option(
        None, "Longest image side.", unit="pixels", minimum=16,
        automatic="by --quality")
    sh_degree: int | None = option(
        None, "Spherical harmonics degree.", minimum=0, maximum=3, automatic="by a trial")
    max_gaussians: int | None = option(
        None, "Maximum number of Gaussians.", minimum=MIN_GAUSSIANS,
        automatic="auto, by image detail, steps and memory")
    early_stop: bool = option(True, "Finish once validation PSNR stays.")
    images: str = option(
        "auto", "Pixels to use; auto: by a trial.",
        choices=("auto", "denoised", "original"))
    background: str = option(
        "auto", "Add a background; auto: in rooms.",
        choices=("auto", "on", "off"), plain="off", formerly="far")
    stereo: str = option(
        "auto", "Start with Gaussians on surfaces that dense stereo finds and sparse points leave "
        "out; auto: on.",
        choices=("auto", "on", "off"), plain="off", expert=True)
    exposure: str = option(
        "auto", "A gain per image; auto: by trial.",
        choices=("auto", "on", "off"), plain="off")
    vignette: str = option(
        "auto", "The falloff of each camera's lens towards the corners; auto: by a trial.",
        choices=("auto", "on", "off"), plain="off", late=True, expert=True)
    depth: str = option(
        "auto", "Compare rendered depth with that of a sensor, where it is sure; auto: with "
        "budget, unless a trial shows a loss.",
        choices=("auto", "on", "off"), plain="off", late=True, expert=True)
    moving: str = option(
        "auto", "Mask people and things that move; auto: where views contradict the others.",
        choices=("auto", "on", "off"), late=True, expert=True)
    brightness: str = option(
        "filmed", "Brightness: as filmed, or even.", choices=("filmed", "even"), late=True,
        formerly="look", old_words={"walk": "filmed"})
    validation: float = option(0.05, _VALIDATION, minimum=0.0, maximum=0.5)
    ssim_weight: float = option(
        0.2, "Weight of 1 - SSIM in the loss; the rest is L1.", minimum=0.0, maximum=1.0,
        expert=True)
    means_rate: float = option(
        1.6e-4, "Initial learning rate of the means, in scene extents; budget: 7x, in units of the "
        "median point-to-camera distance. Decays to a hundredth.",
        minimum=0.0, expert=True)
    quats_rate: float = option(1e-3, "Learning rate of the rotations.", minimum=0.0, expert=True)
    scales_rate: float = option(
        5e-3, "Learning rate of the log-scales; budget: 4x.", minimum=0.0,
        expert=True)
    opacities_rate: float = option(
        5e-2, "Learning rate of the opacity logits.", minimum=0.0, expert=True)
    sh_rate: float = option(
        2.5e-3, "Learning rate of the base colours; budget: 2x. Higher degrees use a "
        "twentieth; budget: a fifth in every fourth step.", minimum=0.0, expert=True)
    densify_every: int = option(
        100, "Interval between densification steps.", unit="steps", minimum=1, expert=True)
    densify_gradient: float = option(
        2e-4, "With reference: clone or split where the mean gradient of the projected mean is "
        "larger.", unit="NDC", minimum=0.0, expert=True)
    # INRIA's code clears the radii before it looks at them: no published run has deleted one so
    max_radius: float = option(
        20.0, "With reference: delete Gaussians wider than this, as 3DGS is described; 0: never, "
        "as its code does.", unit="pixels", minimum=0.0, expert=True, late=True)
    min_opacity: float = option(
        0.005, "Delete Gaussians below this opacity.", minimum=0.0, maximum=1.0, expert=True)
    mid: float = option(
        0.6, "Point of the run whose state is kept for pruning midway.", unit="share",
        minimum=0.05, maximum=1.0, expert=True)
    compact_only: bool = option(
        False, "With pruning: end where it begins, as only the compact model is wanted.",
        late=True, expert=True)
    seed: int = option(0, "Random seed.", minimum=0)
    blocks: str = option(
        "auto", "Blocks to train: auto, N or off.", metavar="N")
    jobs: int | None = option(
        None, "Blocks at once.", minimum=1, hashed=False, expert=True,
        automatic="one for each 4 cores, or as many as the cluster has room for")
    on: str = option(
        "local", "Train blocks in processes of this machine, or on the Ray cluster at RAY_ADDRESS.",
        choices=("local", "ray"), hashed=False, expert=True)
    checkpoint_every: int = option(
        250, "Interval between checkpoints; longer where saving takes over a tenth of the time.",
        unit="steps", minimum=1, hashed=False, expert=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_number_of("train", "blocks", self.blocks)
        if self.mid < DENSIFY_UNTIL:
            raise ConfigError(
                f"mid is {self.mid:g}, but densification runs until {DENSIFY_UNTIL:g} of the run "
                "and would replace the pruned Gaussians.",
                hint=f"Use --mid {DENSIFY_UNTIL:g} or more.")
        if self.iterations is not None and self.minutes is not None:
            raise ConfigError(
                f"iterations is {self.iterations} and minutes is {self.minutes:g}, but both set "
                "the length of the training.",
                hint="Leave out --iterations or --minutes, here and in recon.toml.")

    def settle(self) -> Self:
        """Returns the options with those that the protocol fixes, if it is not followed yet.

        ConfigError where an option asks for something else.
        """
        return dataclasses.replace(self, **protocols.fixed_options(self))

    @classmethod
    def refuse_contradictions(cls, values: Mapping[str, Any]) -> None:
        """Raises ConfigError where an option that is given differs from what a protocol fixes."""
        protocols.refuse_contradictions(cls, values)


@dataclass(frozen=True)
class RunConfig(TrainConfig):
    """TrainConfig with numbers in place of automatic values, as `train.plan` makes it."""

    iterations: int = option(2400, "Optimization steps.", minimum=1)
    max_size: int = option(600, "Longest image side.", unit="pixels", minimum=16)
    sh_degree: int = option(3, "Degree of the spherical harmonics.", minimum=0, maximum=3)
    max_gaussians: int = option(60_000, "Maximum number of Gaussians.", minimum=MIN_GAUSSIANS)

    @property
    def has_gains(self) -> bool:
        """Whether each training image has a gain of its own."""
        return self.exposure == "on"

    @property
    def is_reference(self) -> bool:
        """Whether this is the recipe of 3DGS (Kerbl et al. 2023), with any steps and images."""
        fixed = ("batch_views", "sh_degree", "ssim_weight", "densify_every", "densify_gradient",
                 "min_opacity", "means_rate", "quats_rate", "scales_rate", "opacities_rate",
                 "sh_rate")
        plain = self.plain_values()  # an option that came later is automatic in older records
        return self.densify == "reference" and all(
            getattr(self, name) in (plain[name], "auto" if name in self.late_fields() else None)
            for name in plain) and (
            all(getattr(self, name) == getattr(RunConfig, name) for name in fixed))


# Those that beat a random choice, and the paper's. docs/pruning.md
PRUNE_SCORES = ("loo", "blend_max", "paper")


@dataclass(frozen=True)
class PruneConfig(StageConfig):
    """Which Gaussians are removed, and how the rest is fine-tuned."""

    ratio: float | None = option(
        None, "Fraction of Gaussians to remove.", minimum=0.0, maximum=1.0,
        automatic="0.5 unless another limit is set")
    max_gaussians: int | None = option(
        None, "Maximum number of Gaussians to keep.", minimum=1, automatic="no limit")
    max_mb: float | None = option(
        None, "Maximum size of the .ply.", unit="MB", minimum=0.0, automatic="no limit")
    max_psnr_drop: float | None = option(
        None, "Maximum loss of validation PSNR.", unit="dB", minimum=0.0, automatic="no limit")
    rounds: int | None = option(
        None, "Pruning rounds, with fine-tuning and new scores in between.", minimum=1,
        automatic="3 to 8, one per epoch in half of --recovery")
    score: str = option(
        "loo", "Importance score: loo (leave-one-out error), blend_max (greatest blend weight) or "
        "paper (eq. 3 to 5).", choices=PRUNE_SCORES)
    beta: float = option(
        0.1, "Volume exponent of the `paper` score (eq. 4).", minimum=0.0, expert=True)
    at: str = option(
        "end", "Prune the finished model (end), or a state midway through training and finish from "
        "there (mid, as train --prune).", choices=("end", "mid"))
    recovery: int | None = option(
        None, "Fine-tuning steps after pruning, split over the rounds.", unit="steps", minimum=0,
        automatic="end: a sixth of the run or 6 epochs; mid: the rest of the run")

    def __post_init__(self) -> None:
        super().__post_init__()
        limits = ("ratio", "max_gaussians", "max_mb", "max_psnr_drop")
        limited = [name for name in limits if getattr(self, name) is not None]
        if len(limited) > 1:
            raise ConfigError(
                f"{' and '.join(limited)} are given, but only one can limit the pruning.",
                hint=f"Leave out all but one of {', '.join(limits)}.")
        if self.max_psnr_drop is not None and self.at == "mid":
            raise ConfigError(
                "max_psnr_drop compares with a finished model, but pruning at mid has none yet.",
                hint=f"{name_command('train')} and then {name_command('prune')}, both without "
                "--prune and --at mid.")


@dataclass(frozen=True)
class EvaluateConfig(StageConfig):
    """How the held-out views are scored."""

    max_size: int | None = option(
        None, "Longest side of rendered and scored views.", unit="pixels", minimum=16,
        automatic="as in training")
    trust: bool = option(
        True, "Measure where the scene can be trusted, and list the poorly seen regions.")


@dataclass(frozen=True)
class ImportConfig(StageConfig):
    """How a splat file is brought into a workspace."""

    frame: str = option(
        "auto", "Coordinate frame of the file: that of the capture's own cameras (source) or of "
        "this workspace; auto: the one that shows some training views better.",
        choices=("auto", "source", "workspace"))
    axes: str | None = option(
        None, "Axes of the file, in place of those that it states: z-up and y-down say where up is "
        "without views; rdf (x right, y down, z front), rub (x right, y up, z back) and so on "
        "also turn the scene to y-down, or z-up.",
        choices=("y-down", "z-up", "rdf", "rub", "luf", "ruf", "rfu", "rbu"),
        automatic="as the file states, else y-down, as in viewers")
    max_size: int = option(
        600, "Longest side of rendered and scored views.", unit="pixels", minimum=16)
    moving: str = option(
        "auto", "Mask people and things that move; auto: where views contradict the others.",
        choices=("auto", "on", "off"), late=True, expert=True)
    validation: float = option(0.05, _VALIDATION, minimum=0.0, maximum=0.5)


@dataclass(frozen=True)
class ComputeConfig(StageConfig):
    """Where the numerical work runs. Recorded in the manifest, never part of a fingerprint."""

    device: str = option(
        "auto", "Device; auto: CUDA if available.", metavar="auto|cpu|cuda[:N]",
        hashed=False)
    backend: str = option(
        "auto", "Rasterizer; auto: the fastest.",
        choices=("auto", "triton", "numba", "torch"), hashed=False, expert=True)
    threads: int | None = option(
        None, "CPU threads.", minimum=1, hashed=False, automatic="all cores")
    max_memory: float | None = option(
        None, "Memory that training may take; images that do not fit are read from the disk.",
        unit="GB", minimum=0.1, hashed=False, automatic="all that is free", expert=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not re.fullmatch(r"auto|cpu|cuda(:[0-9]{1,3})?", self.device):
            raise self._error("device", self.device, "auto, cpu, cuda, or cuda:N for one GPU")
