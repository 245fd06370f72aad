"""`recon run --minutes M`: a time for the whole run, spent by how fast this machine is.

Frames are chosen so that finding their cameras takes a fixed share of the time, and after it no
other mapper improves on cameras that can be trusted; training takes as long as then is left beside
pruning and scores; pruning is left out where there is no time for it. The choices are recorded, so
that the same command continues a run and finds a finished one fresh.
"""

from __future__ import annotations

import dataclasses
import logging
import time
from dataclasses import dataclass
from pathlib import Path

from recon_cli import machine
from recon_cli.commands.jobs import open_job, run_stages
from recon_cli.commands.options import Call, explicit_settings
from recon_cli.config.settings import Settings, build, merge
from recon_cli.config.stages import TrainConfig
from recon_cli.deadline import Clock, Deadline
from recon_cli.errors import ReconError
from recon_cli.sfm.time_estimate import Workload, expected_seconds, measure_slowness
from recon_cli.workspace.atomic import read_json, write_json
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.summaries import IngestSummary, JsonRecord, TrainSummary

FILE = "budget.json"
LEAST_FRAMES = 24
_SFM = 0.4  # of the time that is left after ingest beside scores, at most
_PRUNE = 0.45  # of the seconds of training, set aside
_LATE = 1.15  # of the minutes, from which the user is told
_SCORES = 20.0  # seconds of evaluate, export and report, on the machine of sfm.time_estimate
_LEAST_TRAINING = 12.0  # seconds, likewise

logger = logging.getLogger("recon")


@dataclass(frozen=True, kw_only=True)
class Budget(JsonRecord):
    """What was chosen for a number of minutes; None: not yet."""

    minutes: float
    inputs: tuple[str, ...]  # absolute paths
    frames: int | None = None  # that ingest chooses; None: as many as without a budget
    train_minutes: float | None = None
    prune: bool | None = None


def run_within(
    call: Call, minutes: float, inputs: tuple[Path, ...], base: Settings, *, with_prune: bool,
    clock: Clock = time.monotonic,
) -> None:
    """Runs every stage in about so many minutes, and says what is given up for it."""
    deadline = Deadline(60 * minutes, clock)
    workspace = Workspace(call.workspace)
    given = merge([explicit_settings(call), call.settings])
    # what contradicts a time, such as a number of steps, is refused before anything runs
    build(TrainConfig, merge([base, {"train": {"minutes": minutes}}, given]))
    budget = _recorded(call, minutes, inputs)
    threads = open_job(call).compute.threads or machine.usable_threads()
    slowness = measure_slowness(threads)

    def left() -> float:
        """Returns the seconds that are left beside those of evaluate, export and report."""
        return deadline.left - _SCORES * slowness

    def stages(*names: str, **chosen: Settings) -> None:
        run_stages(call, "run", names, sources=inputs if "ingest" in names else (), base=merge(
            [base, *chosen.values()]))

    call.deadline = Deadline(_SFM * left(), clock)
    if budget is None:
        stages("ingest")
        fewer, call.deadline = None, Deadline(_SFM * left(), clock)
        if given.get("ingest", {}).get("frames") is None:
            fewer = _fewer_frames(workspace, call.deadline.seconds, threads, slowness)
        budget = Budget(
            minutes=minutes, inputs=tuple(str(path.absolute()) for path in inputs), frames=fewer)
        write_json(workspace.root / FILE, budget.to_json())
    frames: Settings = {} if budget.frames is None else {"ingest": {"frames": budget.frames}}
    stages("ingest", "denoise", "sfm", frames=frames)
    if budget.train_minutes is None:
        seconds = left() / (1 + _PRUNE) if with_prune else left()
        seconds = max(seconds, _LEAST_TRAINING * slowness)
        budget = dataclasses.replace(budget, train_minutes=round(seconds / 60, 2))
        write_json(workspace.root / FILE, budget.to_json())
    training: Settings = {"train": {"minutes": budget.train_minutes}}
    stages("train", frames=frames, training=training)
    if budget.prune is None:
        budget = dataclasses.replace(
            budget, prune=with_prune and left() > _pruning_seconds(workspace))
        write_json(workspace.root / FILE, budget.to_json())
        if with_prune and not budget.prune:
            logger.warning("there is no time to prune in %g minutes: the scene keeps all its "
                           "Gaussians; `recon prune` removes some", minutes)
    stages(*["prune"] * bool(budget.prune), "evaluate", "export", frames=frames, training=training)
    if deadline.spent > _LATE * deadline.seconds:
        logger.warning("the run took %.1f minutes, more than the %g of --minutes",
                       deadline.spent / 60, minutes)


def _recorded(call: Call, minutes: float, inputs: tuple[Path, ...]) -> Budget | None:
    """Returns the choices of an earlier run for the same minutes and inputs."""
    path = call.workspace / FILE
    if call.again or not path.is_file():
        return None
    try:
        found = Budget.from_json(read_json(path, dict))
    except ReconError:
        return None
    same = not inputs or found.inputs == tuple(str(item.absolute()) for item in inputs)
    return found if same and found.minutes == minutes else None


def _fewer_frames(
    workspace: Workspace, seconds: float, threads: int, slowness: float
) -> int | None:
    """Returns to how many frames a capture is cut for cameras in time; None: it stays."""
    manifest = workspace.manifest("ingest")
    assert manifest is not None
    ingested = IngestSummary.from_json(manifest.run.summary)
    if ingested.metric is not None:
        return None  # its cameras are known
    megapixels = ingested.width * ingested.height / 1e6

    def estimate(frames: int) -> float:
        return expected_seconds(
            Workload(frames, megapixels, ingested.kind == "video"), threads, slowness=slowness)

    frames = ingested.frames
    if estimate(frames) <= seconds:
        return None
    while frames > LEAST_FRAMES and estimate(frames) > seconds:
        frames = max(LEAST_FRAMES, int(0.95 * frames))
    logger.warning(
        "%d of %d frames are used, so that the run ends within --minutes; --frames keeps more",
        frames, ingested.frames)
    return frames


def _pruning_seconds(workspace: Workspace) -> float:
    """Returns about how long the pruning of a finished model takes, by the steps of its training.
    """
    from recon_cli.train.prune_run import count_recovery_steps  # imports torch

    manifest = workspace.manifest("train")
    assert manifest is not None
    training = TrainSummary.from_json(manifest.run.summary)
    steps = count_recovery_steps(training.planned_iterations, training.training_views)
    step = training.train_seconds / max(1, training.iterations)
    return manifest.run.seconds - training.train_seconds + steps * step
