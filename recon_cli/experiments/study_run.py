"""The runs of a study: those that are kept from before, and those that are still to be made."""

from __future__ import annotations

import importlib.util
import logging
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from recon_cli.context import StageContext
from recon_cli.errors import WorkspaceError
from recon_cli.experiments import study_plot, study_report
from recon_cli.experiments.host import Host, examine
from recon_cli.experiments.records import Record, Records, key_of
from recon_cli.experiments.scenes import checked, opened
from recon_cli.experiments.study_result import (
    ARMS,
    EQUAL_SECONDS,
    EQUAL_STEPS,
    Request,
    Result,
    SceneResult,
)
from recon_cli.experiments.trial import PILOT_STEPS, Point, Run, Stand, pilot, run_trial, stand
from recon_cli.experiments.variants import Arm
from recon_cli.pipeline.execute import rendering
from recon_cli.progress import Progress
from recon_cli.workspace import atomic, lock
from recon_cli.workspace.digests import sha256_json
from recon_cli.workspace.layout import disk_errors

logger = logging.getLogger("recon")


def run(request: Request, progress: Progress) -> str:
    """Runs what is missing, writes the files, and returns what the terminal shows.

    Raises:
        ReconError: something cannot be done; what can be known is found before training.
    """
    paths = checked(request.scenes)
    _make_folder(request.out)
    with (disk_errors(request.out, "running study"),
          lock.held(request.out, "study", other="another folder with --out")):
        ctx = rendering(request.compute, progress)
        host = examine(ctx.threads, ctx.device)
        records = Records(request.out)
        grounds = [_ground(name, path, request, ctx) for name, path in paths.items()]
        work = Work(request, records, _machine(host))
        logger.warning("%s", work.announced(grounds, progress))
        scenes = {one.stand.name: work.done(one, progress) for one in grounds}
        result = Result(host, request.seeds, request.base, request.clock, scenes)
        _write(request.out, result)
    return study_report.text(result)


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkspaceError(
            f"The folder {out} cannot be made: {error.strerror}.",
            hint="Give another folder with --out.") from error


def _machine(host: Host) -> str:
    return f"{host.cpu}, {host.device}, {host.threads} threads"


def _ground(name: str, path: Path, request: Request, ctx: StageContext) -> Ground:
    place = opened(
        name, path, request.out / "scenes", request.settings, request.compute, ctx.progress)
    return Ground(stand(place, "test", request.base, ctx), place.digest)


def _write(out: Path, result: Result) -> None:
    atomic.write_json(out / "study.json", result.record())
    atomic.write_bytes(out / "study.md", study_report.markdown(result).encode())
    if importlib.util.find_spec("matplotlib") is None:
        logger.warning("no picture: matplotlib is missing; pip install 'recon-cli[plot]'")
        return
    study_plot.draw(result, out / "study.svg")


_NEAR = 0.05  # the same run takes seconds that differ by as much when it is repeated


@dataclass(frozen=True, eq=False)
class Ground:
    """A scene of the study.

    Attributes:
        stand: the scene in memory.
        digest: of what it holds.
    """

    stand: Stand
    digest: str


def equal_seconds(
    iterations: int, seconds: Mapping[str, float]
) -> dict[str, int]:
    """Returns the steps of each arm that take as long as the slowest arm's `iterations`.

    A first guess: steps of a longer run cost as much where the count has reached its cap in both.

    Args:
        iterations: steps that every arm took.
        seconds: that they took, by arm.
    """
    slowest = max(seconds.values())
    return {name: max(iterations, round(iterations * slowest / own)) if own > 0 else iterations
            for name, own in seconds.items()}


def corrected(
    iterations: int, guess: int, seconds: float, guess_seconds: float, target: float
) -> int:
    """Returns the steps that take `target` seconds, on the line through two measured runs.

    Args:
        iterations: of the shorter run.
        guess: of the longer run.
        seconds: that the shorter run took.
        guess_seconds: that the longer run took.
        target: seconds to fill.
    """
    near = abs(guess_seconds - target) <= _NEAR * target
    if near or guess <= iterations or guess_seconds <= seconds:
        return guess
    steps = iterations + (target - seconds) * (guess - iterations) / (guess_seconds - seconds)
    return max(iterations, round(steps))


class Work:
    """Makes the runs that are missing and hands out all of them.

    Args:
        request: what is asked.
        records: what is kept.
        machine: that runs are made on, in words.
    """

    def __init__(self, request: Request, records: Records, machine: str) -> None:
        self._request, self._records, self._machine = request, records, machine

    def announced(self, grounds: Sequence[Ground], progress: Progress) -> str:
        """Returns in words what is to be done and about how long it will take."""
        seconds, missing, kept = 0.0, 0, 0
        for ground in grounds:
            left = {arm.name: self._missing(ground, arm) for arm in ARMS}
            missing += sum(left.values())
            kept += 2 * len(ARMS) * self._request.seeds - sum(left.values())
            if any(left.values()):
                costs = self._costs(ground, progress)
                seconds += sum(
                    costs[name] * min(count, self._request.seeds)
                    + max(costs.values()) * max(0, count - self._request.seeds)
                    for name, count in left.items())
        text = f"about {missing} runs are to be made, {kept} are kept from before"
        if not missing:
            return f"all {kept} runs are kept from before"
        return f"{text}; about {max(1, round(seconds / 60))} minutes"

    def _costs(self, ground: Ground, progress: Progress) -> dict[str, float]:
        """Returns the seconds of a run by arm, from pilots, which warm the caches too."""
        costs = {}
        label = f"{ground.stand.name}: pilots"
        with progress.bar(label, len(ARMS), unit="arm") as bar:
            for arm in ARMS:
                point = pilot(ground.stand, arm, self._request.base, on_step=_nothing)
                costs[arm.name] = point.seconds * self._request.iterations / PILOT_STEPS
                bar.advance()
        return costs

    def _missing(self, ground: Ground, arm: Arm) -> int:
        """Returns how many runs of an arm are not kept; unfixed steps count as not kept."""
        steps = [{arm.name: self._request.iterations}, self._records.steps(self._steps_key(ground))]
        return sum(
            found is None or self._kept(ground, self._run(arm, found[arm.name], seed)) is None
            for found in steps for seed in range(self._request.seeds))

    def done(self, ground: Ground, progress: Progress) -> SceneResult:
        """Returns all runs on a scene, those that are missing made now."""
        steps = dict.fromkeys((arm.name for arm in ARMS), self._request.iterations)
        equal = self._all(ground, EQUAL_STEPS, steps, progress)
        steps = dict(self._fixed(ground, equal, progress))
        longer = self._all(ground, EQUAL_SECONDS, steps, progress)
        runs = {EQUAL_STEPS: equal, EQUAL_SECONDS: longer}
        size = ground.stand.scored[0].camera
        return SceneResult(
            len(ground.stand.scored), size.width, size.height, ground.digest, runs)

    def _fixed(
        self, ground: Ground, equal: Mapping[str, tuple[Record, ...]], progress: Progress
    ) -> Mapping[str, int]:
        """Returns the steps at equal seconds; once computed they are kept, whatever comes."""
        key = self._steps_key(ground)
        steps = self._records.steps(key)
        if steps is None:
            seconds = {name: statistics.median(self._seconds(record.point) for record in records)
                       for name, records in equal.items()}
            steps = self._tried(ground, seconds, progress)
            self._records.add_steps(key, steps)
        return steps

    def _tried(
        self, ground: Ground, seconds: Mapping[str, float], progress: Progress
    ) -> dict[str, int]:
        """Returns the steps of each arm at equal seconds, corrected by one run of its guess."""
        count, target = self._request.iterations, max(seconds.values())
        steps = equal_seconds(count, seconds)
        label = f"{ground.stand.name}, finding {EQUAL_SECONDS}"
        with progress.bar(label, sum(steps.values()), unit="step") as bar:
            for arm in ARMS:
                guess = self._run(arm, steps[arm.name], 0)
                record = self._kept(ground, guess) or self._made(ground, guess, bar.advance)
                steps[arm.name] = corrected(
                    count, guess.iterations, seconds[arm.name], self._seconds(record.point),
                    target)
        return steps

    def _all(
        self, ground: Ground, comparison: str, steps: Mapping[str, int], progress: Progress
    ) -> dict[str, tuple[Record, ...]]:
        """Returns the records by arm; seeds are the outer loop: a slow minute falls on all arms."""
        found: dict[str, list[Record]] = {arm.name: [] for arm in ARMS}
        total = self._request.seeds * sum(steps.values())
        label = f"{ground.stand.name}, {comparison}"
        with progress.bar(label, total, unit="step") as bar:
            for seed in range(self._request.seeds):
                for arm in ARMS:
                    bar.note(f"{arm.label}, seed {seed}")
                    run = self._run(arm, steps[arm.name], seed)
                    record = self._kept(ground, run)
                    if record is None:
                        record = self._made(ground, run, bar.advance)
                    else:
                        bar.advance(run.iterations)
                    found[arm.name].append(record)
        return {name: tuple(records) for name, records in found.items()}

    def _made(self, ground: Ground, run: Run, on_step: Callable[[], None]) -> Record:
        """Makes a run and keeps it."""
        points = run_trial(ground.stand, run, (), on_step=on_step)
        config = ground.stand.task(run).schedule.config
        on = [name for name in ("far", "exposure", "poses") if getattr(config, name) == "on"]
        record = Record(points[-1], self._machine, ", ".join(
            [f"{config.images} images", f"degree {config.sh_degree}", *on]))
        self._records.add_run(
            key_of(ground.stand, ground.digest, run), record, run, ground.stand.name)
        return record

    def _seconds(self, point: Point) -> float:
        return point.cpu_seconds if self._request.clock == "cpu" else point.seconds

    def _kept(self, ground: Ground, run: Run) -> Record | None:
        return self._records.run(key_of(ground.stand, ground.digest, run))

    def _run(self, arm: Arm, iterations: int, seed: int) -> Run:
        return Run(arm, self._request.base, iterations, seed)

    def _steps_key(self, ground: Ground) -> str:
        """Returns what the steps at equal seconds are known by, whatever the number of seeds."""
        first = [key_of(ground.stand, ground.digest, self._run(arm, self._request.iterations, 0))
                 for arm in ARMS]
        return sha256_json({"steps of": first, "clock": self._request.clock})


def _nothing() -> None:
    """Reports to nobody."""
