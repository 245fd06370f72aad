"""What was asked of `recon bench train`, before anything is measured."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recon_cli.bench import page
from recon_cli.bench.picture import check_picture
from recon_cli.bench.request import refuse_missing_folders
from recon_cli.bench.training.arms import Arm
from recon_cli.config import ComputeConfig, RunConfig
from recon_cli.errors import ConfigError
from recon_cli.settings import Settings

# A run of this size takes about half a minute on two cores and tells recipes apart.
SIZE, STEPS, CAP = 600, 3000, 60_000
SECTIONS = ("ingest", "denoise", "sfm", "train")  # that --set may reach
# of training, that have options of their own here, or no effect
_OWN = {"iterations", "max_size", "max_gaussians", "seed", "densify", "mid", "checkpoint_every",
        "quality", "minutes", "early_stop", "sh_degree"}


@dataclass(frozen=True)
class Request:
    """The options of the verb.

    Attributes:
        scenes: workspaces or data sets with poses.
        arms: the recipes.
        iterations: steps of every run; None where seconds are given or neither is.
        seconds: of every run instead; None where steps are given or neither is.
        seeds: runs of each recipe.
        targets_db: PSNR to reach; empty for what all runs of a scene reach.
        base: options that all recipes share, size and cap included.
        settings: options of ingest, denoise and sfm for data sets.
        compute: device, backend and threads.
        json_file: where all figures go.
        plot: where the picture goes.
        markdown: the page that the tables go into.

    Raises:
        ConfigError: there is no recipe, or steps and seconds are both given.
        ReconError: an output cannot be written.
    """

    scenes: tuple[Path, ...]
    arms: tuple[Arm, ...]
    iterations: int | None
    seconds: float | None
    seeds: int
    targets_db: tuple[float, ...]
    base: RunConfig
    settings: Settings = field(default_factory=dict)
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    json_file: Path | None = None
    plot: Path | None = None
    markdown: Path | None = None

    def __post_init__(self) -> None:
        if not self.arms:
            raise ConfigError("No recipe was given.", hint="Try --recipes reference,budget.")
        if self.iterations is not None and self.seconds is not None:
            raise ConfigError(
                "--iterations and --seconds exclude each other.", hint="Leave one out.")
        refuse_missing_folders(self.json_file, self.plot)
        if self.plot is not None:
            check_picture(self.plot)
        if self.markdown is not None:
            page.check_page(self.markdown)


def base_config(
    settings: Settings, *, max_size: int, max_gaussians: int, validation: float | None = None
) -> RunConfig:
    """Returns the options that all arms share.

    Args:
        settings: what --set set.
        max_size: longest side of the images in pixels.
        max_gaussians: cap of the count.
        validation: share of the views that is not trained on; None where --set may say so.

    Raises:
        ConfigError: --set reaches a stage that is not run, or what has an option of its own.
    """
    for section in settings.keys() - set(SECTIONS):
        if settings[section]:
            raise ConfigError(
                f"--set {section}.{next(iter(settings[section]))} has no effect here.",
                hint=f"Options of {', '.join(SECTIONS)} can be set.")
    values: dict[str, Any] = dict(settings.get("train", {}))
    own = _OWN if validation is None else _OWN | {"validation"}
    for name in sorted(own & values.keys()):
        raise ConfigError(
            f"--set train.{name} has no effect here.",
            hint="See --help for sizes, steps and seeds; recipes say how to densify.")
    if validation is not None:
        values["validation"] = validation
    return RunConfig(
        **values, iterations=STEPS, max_size=max_size, max_gaussians=max_gaussians,
        early_stop=False)  # every run takes the steps that it is said to take


def shared(base: RunConfig) -> dict[str, Any]:
    """Returns the options that all arms share, without those that each run has of its own."""
    return {name: value for name, value in base.hashed().items()
            if name not in _OWN - {"max_size", "max_gaussians", "sh_degree"}}
