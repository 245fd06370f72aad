"""What each stage can be told: one frozen dataclass a stage, each option written down once.

The command line, recon.toml, the fingerprint of a stage and the documentation are all made from
these fields.
"""

from __future__ import annotations

from dataclasses import dataclass

from recon_cli.config.export import EXPORT_FORMATS as EXPORT_FORMATS
from recon_cli.config.export import ExportConfig as ExportConfig
from recon_cli.config.fields import (
    SCALE_BETWEEN,
    StageConfig,
    check_scale_between,
    option,
    parse_holdout,
)
from recon_cli.errors import ConfigError


@dataclass(frozen=True)
class IngestConfig(StageConfig):
    """Which frames of the capture are kept."""

    frames: int | None = option(
        None, "How many frames to choose from videos and posed sequences.", unit="frames",
        minimum=3,
        automatic="from the camera's motion, at most --max-frames",
    )
    max_frames: int = option(
        100, "Most frames that the automatic choice takes.", unit="frames", minimum=3)
    max_size: int = option(
        1920, "Longest side of a stored frame; larger ones are reduced by area.",
        unit="pixels", minimum=64)
    holdout: str = option(
        "every:8", "Views kept for the score and never trained on: every:N takes each Nth by "
        "name, segment:A:B a contiguous share of the capture (0 to 1), none takes none.")
    sharpness: float = option(
        0.5, "A video frame must reach this share of the sharpness around it.",
        unit="share", minimum=0.0, maximum=1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        parse_holdout(self.holdout)


@dataclass(frozen=True)
class DenoiseConfig(StageConfig):
    """Whether and how strongly the training images are denoised."""

    mode: str = option(
        "auto", "auto denoises frames whose noise reaches the threshold; force denoises all; "
        "off passes all through.", choices=("auto", "force", "off"), flags=True)
    threshold: float = option(
        3.0, "Noise in the flat parts of a frame from which it is denoised.", unit="1/255",
        minimum=0.0)
    filter: str = option(
        "joint", "joint filters with less noisy guides and keeps edges best; bilateral takes a "
        "quarter of the time.", choices=("joint", "bilateral"))
    strength: float = option(
        4.0, "Range sigma of the filter, as a multiple of the noise that it sees: the estimated "
        "one for bilateral, what is left of it in the guide for joint.", unit="x noise",
        minimum=0.1)


@dataclass(frozen=True)
class SfmConfig(StageConfig):
    """How cameras and points are found."""

    poses: str = option(
        "keep", "What becomes of the poses that a data set comes with: keep them, refine them "
        "together with the points, or ignore them.", choices=("keep", "refine", "ignore"))
    pairs: str = option(
        "auto", "Image pairs to match: auto takes all of up to 100 images, else neighbours and "
        "images that look alike, and goes on to more pairs and other ways of mapping where the "
        "model is not good enough; a named way is the only one tried.",
        choices=("auto", "exhaustive", "retrieval", "sequential"))
    max_features: int = option(
        3000, "Most SIFT keypoints of an image; the coarsest are kept.", unit="keypoints",
        minimum=100)
    min_registered: float = option(
        0.5, "Fail when fewer images than this share get a camera.", unit="share",
        minimum=0.0, maximum=1.0)
    accept_weak: bool = option(
        False, "Take a model whose parts hang together by few matches, too.", hashed=False)
    seed: int = option(0, "Seed of the mapper's random sampling.", minimum=0)
    gravity: str = option(
        "auto", "auto turns the world so that z is up and the floor lies at 0, where cameras and "
        "points show it; off leaves it as the mapper made it.", choices=("auto", "off"))
    scale_between: tuple[str, str, float] | None = option(
        None, SCALE_BETWEEN, metavar="A B METRES", automatic="the scale stays arbitrary")
    max_minutes: float = option(
        20.0, "Give up after this long.", unit="minutes", minimum=0.01, hashed=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_scale_between(self.scale_between)


MIN_GAUSSIANS = 4  # the first ones are as large as the mean distance to 3 neighbours


@dataclass(frozen=True)
class TrainConfig(StageConfig):
    """How Gaussians are fitted: a recipe, scaled to the number of iterations.

    What is left automatic is decided by `train.plan`, once the scene is known.
    """

    quality: str = option(
        "normal", "Sets what is not given: iterations, longest side and cap of the count. On two "
        "cores draft takes about 10 seconds, normal 40, high 2 to 4 minutes.",
        choices=("draft", "normal", "high"))
    minutes: float | None = option(
        None, "Time for the training: the steps and the cap of the count that fill it here, by a "
        "few that are timed first. Excludes --iterations.", unit="minutes", minimum=0.01,
        automatic="as long as the iterations take")
    densify: str = option(
        "budget", "How Gaussians are added: budget (where the error is, the count on a line), "
        "reference (clone, split and reset as in 3DGS) or mcmc (relocation and noise).",
        choices=("budget", "reference", "mcmc"))
    iterations: int | None = option(
        None, "Optimization steps of --batch-views views each.", unit="steps", minimum=1,
        automatic="by --quality: 1,500, 3,000 or 8,000")
    batch_views: int = option(
        1, "Views of one step, whose mean gradient is taken; processes that train together each "
        "take so many.", unit="views", minimum=1)
    max_size: int | None = option(
        None, "Longest side of a training image; larger ones are reduced by area.",
        unit="pixels", minimum=16, automatic="by --quality: 400, 600 or 800")
    sh_degree: int | None = option(
        None, "Highest spherical-harmonics degree of the colours.", minimum=0, maximum=3,
        automatic="the lowest that a higher one does not beat by enough in a trial")
    sh_uniform: float = option(
        0.0, "Gaussians whose colour deviates less over the training views lose their harmonics "
        "once densification has ended; 0 keeps all.", minimum=0.0, maximum=1.0)
    max_gaussians: int | None = option(
        None, "Densification stops at this count.", unit="Gaussians", minimum=MIN_GAUSSIANS,
        automatic="by the detail of the images, the length of the run and the memory")
    early_stop: bool = option(
        True, "Go on to the final phase once the validation views gain nothing more.")
    images: str = option(
        "auto", "Pixels to train on; scores always use the originals. auto: denoised where a trial "
        "shows that it pays.", choices=("auto", "denoised", "original"))
    far: str = option(
        "auto", "Gaussians far outside, for what is seen through windows. auto: where several "
        "views see nothing near and a trial shows that it pays.", choices=("auto", "on", "off"))
    exposure: str = option(
        "auto", "A gain for each image and channel, for cameras that set their exposure. auto: "
        "where the images drift and a trial shows that it pays.", choices=("auto", "on", "off"))
    poses: str = option(
        "auto", "Refine the training cameras. auto: where their error is large and a trial shows "
        "that it pays.", choices=("auto", "on", "off"))
    validation: float = option(
        0.05, "Share of the training views kept out to watch progress.", unit="share",
        minimum=0.0, maximum=0.5)
    ssim_weight: float = option(
        0.2, "Weight of 1 - SSIM in the loss; the rest is L1.", minimum=0.0, maximum=1.0)
    means_rate: float = option(
        1.6e-4, "Initial learning rate of the means, times the scene extent, and 6 with budget; it "
        "falls to a hundredth.", minimum=0.0)
    quats_rate: float = option(1e-3, "Learning rate of the rotations.", minimum=0.0)
    scales_rate: float = option(
        5e-3, "Learning rate of the log-scales, twice that with budget.", minimum=0.0)
    opacities_rate: float = option(5e-2, "Learning rate of the opacity logits.", minimum=0.0)
    sh_rate: float = option(
        2.5e-3, "Learning rate of the base colours, twice that with budget; higher degrees get a "
        "twentieth.", minimum=0.0)
    densify_every: int = option(
        100, "Add and delete Gaussians this often.", unit="steps", minimum=1)
    densify_gradient: float = option(
        2e-4, "With reference: mean gradient of the projected mean from which a Gaussian is cloned "
        "or split.",
        unit="NDC", minimum=0.0)
    densify_scale: float = option(
        0.01, "With reference: clone up to this largest scale, split above it.",
        unit="x extent", minimum=0.0)
    min_opacity: float = option(
        0.005, "Gaussians below this opacity are deleted.", minimum=0.0, maximum=1.0)
    mid: float = option(
        0.6, "Point of the run whose state is kept, so that pruning can branch off there.",
        unit="share", minimum=0.05, maximum=1.0)
    seed: int = option(0, "Seed of every random choice.", minimum=0)
    checkpoint_every: int = option(
        250, "Save the full state this often, or as often as takes a tenth of the time.",
        unit="steps", minimum=1, hashed=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mid < DENSIFY_UNTIL:
            raise ConfigError(
                f"mid is {self.mid:g}, but densification runs until {DENSIFY_UNTIL:g} of the run "
                "and would grow back what was pruned.",
                hint=f"Use --mid {DENSIFY_UNTIL:g} or more.")
        if self.iterations is not None and self.minutes is not None:
            raise ConfigError(
                f"iterations is {self.iterations} and minutes is {self.minutes:g}, but each "
                "decides how long the training is.",
                hint="Leave out --iterations or --minutes, here and in recon.toml.")


@dataclass(frozen=True)
class RunConfig(TrainConfig):
    """The same with numbers in place of what was automatic; a run and what builds on it read this.

    `train.plan` makes it. The defaults are those of a run on which nobody decided.
    """

    iterations: int = option(3000, "Optimization steps.", unit="steps", minimum=1)
    max_size: int = option(600, "Longest side of a training image.", unit="pixels", minimum=16)
    sh_degree: int = option(3, "Highest degree of the colours.", minimum=0, maximum=3)
    max_gaussians: int = option(
        60_000, "Densification stops at this count.", unit="Gaussians", minimum=MIN_GAUSSIANS)


DENSIFY_UNTIL = 0.6  # share of the run up to which the recipes add Gaussians
PRUNE_SCORES = ("loo", "paper", "lightgaussian", "blend_sum", "blend_max", "opacity", "random")


@dataclass(frozen=True)
class PruneConfig(StageConfig):
    """Which Gaussians go, and how the rest recovers."""

    ratio: float | None = option(
        None, "Share that is removed; one stays.", unit="share", minimum=0.0, maximum=1.0,
        automatic="0.5 where no other limit is given")
    max_gaussians: int | None = option(
        None, "Most Gaussians that stay.", unit="Gaussians", minimum=1, automatic="no limit")
    max_mb: float | None = option(
        None, "Largest .ply that is written.", unit="MB", minimum=0.0, automatic="no limit")
    max_psnr_drop: float | None = option(
        None, "Most PSNR that validation views lose.", unit="dB", minimum=0.0, automatic="no limit")
    rounds: int | None = option(
        None, "Rounds of removal, with training and new scores in between; 1 removes all at once.",
        unit="rounds", minimum=1, automatic="one an epoch of half the recovery, 3 to 8")
    score: str = option(
        "loo", "Rank by loo (error of leaving one out), paper (equations 3 to 5), lightgaussian "
        "(unclamped), blend_sum, blend_max (its weights), opacity or random.", choices=PRUNE_SCORES)
    beta: float = option(0.1, "With paper: exponent of the volume (equation 4).", minimum=0.0)
    at: str = option(
        "end", "Prune the finished model, or at mid branch off there and train the rest of the run "
        "(what train --prune does).", choices=("end", "mid"))
    recovery: int | None = option(
        None, "Training steps from first to last; with --max-psnr-drop shared out to the rounds.",
        unit="steps", minimum=0, automatic="the rest of the run at mid; a sixth or 6 epochs at end")

    def __post_init__(self) -> None:
        super().__post_init__()
        limits = ("ratio", "max_gaussians", "max_mb", "max_psnr_drop")
        given = [name for name in limits if getattr(self, name) is not None]
        if len(given) > 1:
            raise ConfigError(
                f"{' and '.join(given)} are given, but only one can say how much goes.",
                hint=f"Leave out all but one of {', '.join(limits)}.")
        if self.max_psnr_drop is not None and self.at == "mid":
            raise ConfigError(
                "max_psnr_drop needs a finished model to hold the pruned one against.",
                hint="`recon train` and then `recon prune`, both without --prune and --at mid.")


@dataclass(frozen=True)
class EvaluateConfig(StageConfig):
    """How the held-out views are scored."""

    max_size: int | None = option(
        None, "Longest side at which views are rendered and scored.", unit="pixels", minimum=16,
        automatic="the size that was trained on")


@dataclass(frozen=True)
class ImportConfig(StageConfig):
    """How a scene from elsewhere comes into a workspace."""

    frame: str = option(
        "auto", "The world that the file lies in: that of the capture's own cameras (source), that "
        "of this workspace, or whichever shows some training views better.",
        choices=("auto", "source", "workspace"))
    axes: str | None = option(
        None, "Where up is in the file; only matters without views.",
        choices=("y-down", "z-up"), automatic="z-up for .glb, else y-down, as viewers take it")
    max_size: int = option(
        600, "Longest side at which the scene is rendered, scored and pruned.", unit="pixels",
        minimum=16)
    validation: float = option(
        0.05, "Share of the training views kept out of pruning to watch it.", unit="share",
        minimum=0.0, maximum=0.5)


@dataclass(frozen=True)
class ComputeConfig(StageConfig):
    """Where the numerical work runs. Recorded in the manifest, never part of a fingerprint."""

    device: str = option(
        "auto", "Where tensors live; auto takes CUDA where there is one.",
        choices=("auto", "cpu", "cuda"), hashed=False)
    backend: str = option(
        "auto", "Rasterizer; auto takes the fastest that runs on the device.",
        choices=("auto", "triton", "numba", "torch"), hashed=False)
    threads: int | None = option(
        None, "CPU threads.", unit="threads", minimum=1, hashed=False, automatic="all cores")
