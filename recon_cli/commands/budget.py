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
from recon_cli.config.stages import IngestConfig, TrainConfig
from recon_cli.deadline import Clock, Deadline
from recon_cli.errors import ReconError, name_command
from recon_cli.time_estimate import Cost, TimeEstimator, Work, list_mapping, measure_machine
from recon_cli.workspace.atomic import read_json, write_json
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.summaries import IngestSummary, JsonRecord, TrainSummary

FILE = "budget.json"
LEAST_FRAMES = 24
_SFM = 0.4  # of the time that is left after ingest beside scores, at most
_PRUNE = 0.45  # of the seconds of training, set aside
_LATE = 1.15  # of the minutes, from which the user is told
# seconds on the machine of `COSTS`; the demo is pruned in 13
_LEAST_TRAINING, _LEAST_PRUNING = 12.0, 12.0

logger = logging.getLogger("recon")


@dataclass(frozen=True, kw_only=True)
class Budget(JsonRecord):
    """What was chosen for a number of minutes; None: not yet."""

    minutes: float
    inputs: tuple[str, ...]  # absolute paths
    max_frames: int | None = None  # of ingest; None: as without a budget
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
    # only the result of pruning is wanted
    compact = with_prune and bool(given.get("train", {}).get("compact_only"))
    budget = _recorded(call, minutes, inputs)
    if budget is not None and compact and not budget.prune:
        budget = dataclasses.replace(budget, train_minutes=None, prune=None)
    estimator = measure_machine(open_job(call).compute.threads or machine.usable_threads())

    def left() -> float:
        """Returns the seconds that are left beside those of evaluate, export and report."""
        return deadline.left - estimator.total([Work("scores", 1)])

    def stages(*names: str, **chosen: Settings) -> None:
        run_stages(call, "run", names, sources=inputs if "ingest" in names else (), base=merge(
            [base, *chosen.values()]))

    if budget is None:
        most = None
        if not {"frames", "max_frames"} & given.get("ingest", {}).keys():
            # before anything is read, as a second reading takes as long as the first
            most = _most_frames(inputs, left(), estimator)
        budget = Budget(
            minutes=minutes, inputs=tuple(str(path.absolute()) for path in inputs), max_frames=most)
    frames: Settings = ({} if budget.max_frames is None
                        else {"ingest": {"max_frames": budget.max_frames}})
    stages("ingest", frames=frames)
    write_json(workspace.root / FILE, budget.to_json())  # now that there is a folder
    call.deadline = Deadline(_SFM * left(), clock)
    _report_frames(workspace, budget, call.deadline.seconds, estimator)
    stages("denoise", "sfm", "place", frames=frames)
    if budget.train_minutes is None:
        # pruning takes the place of the steps that are left out
        pruning = 0.0 if compact else left() * _PRUNE / (1 + _PRUNE)
        prune = compact or (with_prune and pruning >= _LEAST_PRUNING * estimator.slowness)
        seconds = max(left() - pruning * prune, _LEAST_TRAINING * estimator.slowness)
        budget = dataclasses.replace(
            budget, train_minutes=round(seconds / 60, 2),
            prune=True if compact else None if prune else False)
        write_json(workspace.root / FILE, budget.to_json())
    training: Settings = {"train": {"minutes": budget.train_minutes}}
    stages("train", frames=frames, training=training)
    if budget.prune is None:
        budget = dataclasses.replace(budget, prune=left() > _pruning_seconds(workspace))
        write_json(workspace.root / FILE, budget.to_json())
    if with_prune and not budget.prune:
        logger.warning("there is no time to prune in %g minutes: the scene keeps all its "
                       "Gaussians; %s removes some", minutes, name_command("prune"))
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


def _most_frames(
    inputs: tuple[Path, ...], left: float, estimator: TimeEstimator
) -> int | None:
    """Returns how many frames of videos have cameras in time; None where the inputs are no videos.
    """
    from recon_cli.capture.video import open_video, read_declared_length  # imports PyAV

    pictures, megapixels = 0.0, 0.0
    try:
        for path in inputs:
            length = read_declared_length(path)
            pictures += length.count(length.rate)
            with open_video(path) as (_, stream):
                megapixels = max(megapixels, stream.width * stream.height / 1e6)
    except ReconError:  # ingest says what they are, or what is wrong with them
        return None
    longest = IngestConfig().max_size ** 2 * 9 / 16 / 1e6  # megapixels of a stored frame
    seconds = _SFM * (
        left - estimator.total([Work("picture", pictures, megapixels, shared=True)]))
    frames = IngestConfig().max_frames
    while frames > LEAST_FRAMES and estimator.total(
            list_mapping(frames, min(megapixels, longest), tracked=True)) > seconds:
        frames = max(LEAST_FRAMES, int(0.95 * frames))
    return frames


def _report_frames(
    workspace: Workspace, budget: Budget, seconds: float, estimator: TimeEstimator
) -> None:
    """Says that fewer frames are used than without a budget, or that more are than it has time for.
    """
    manifest = workspace.manifest("ingest")
    assert manifest is not None
    ingested = IngestSummary.from_json(manifest.run.summary)
    if ingested.frames == budget.max_frames:
        logger.warning("no more than %d frames are used, so that the run ends within --minutes; "
                       "--frames keeps more", ingested.frames)
    expected = estimator.total(list_mapping(
        ingested.frames, ingested.width * ingested.height / 1e6,
        tracked=ingested.kind == "video"))
    if ingested.kind != "video" and ingested.metric is None and expected > 2 * seconds:
        logger.warning("the cameras of %d photos take about %.1f of the %g minutes: fewer photos "
                       "leave more for training", ingested.frames, expected / 60, budget.minutes)


def _pruning_seconds(workspace: Workspace) -> float:
    """Returns about how long the pruning of a finished model takes, by the steps of its training.
    """
    from recon_cli.train.prune.prune_run import count_recovery_steps  # imports torch

    manifest = workspace.manifest("train")
    assert manifest is not None
    training = TrainSummary.from_json(manifest.run.summary)
    steps = count_recovery_steps(training.planned_iterations, training.training_views)
    return Cost(
        manifest.run.seconds - training.train_seconds,
        training.train_seconds / max(1, training.iterations)).seconds(steps)
