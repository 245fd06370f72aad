"""What was asked of `recon study`, before anything is run."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from recon_cli.bench.training.arms import BUDGET, BUDGET_PRUNED, PAPER, REFERENCE, Arm
from recon_cli.config import ComputeConfig, RunConfig
from recon_cli.settings import Settings

# The paper compares the first two; the others are what `recon train` does without and with --prune.
ARMS: tuple[Arm, ...] = (REFERENCE, PAPER, BUDGET, BUDGET_PRUNED)
BASELINE, DEFAULT = REFERENCE, BUDGET  # what the others are held against
EQUAL_STEPS, EQUAL_SECONDS = "equal steps", "equal seconds"
COMPARISONS = (EQUAL_STEPS, EQUAL_SECONDS)


@dataclass(frozen=True)
class Request:
    """The options of the verb.

    Attributes:
        scenes: workspaces or data sets with poses.
        seeds: runs of each arm.
        iterations: steps of every arm where steps are equal.
        base: options that all arms share, size and cap included.
        out: folder of records, tables and the workspaces of data sets.
        settings: options of ingest, denoise and sfm for data sets.
        compute: device, backend and threads.
        clock: "wall" or "cpu": which seconds are made equal.
    """

    scenes: tuple[Path, ...]
    seeds: int
    iterations: int
    base: RunConfig
    out: Path
    settings: Settings = field(default_factory=dict)
    compute: ComputeConfig = field(default_factory=ComputeConfig)
    clock: str = "wall"
