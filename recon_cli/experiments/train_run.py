"""From a request to curves and files: checks everything, trains, then writes."""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path

from recon_cli.context import StageContext
from recon_cli.experiments import bench_compare, train_plot, train_report
from recon_cli.experiments.host import examine
from recon_cli.experiments.scenes import checked, opened
from recon_cli.experiments.train_result import (
    STEPS,
    ArmResult,
    Request,
    Result,
    SceneResult,
    SeedRun,
    looks,
)
from recon_cli.experiments.trial import PILOT_STEPS, Run, Stand, pilot, run_trial, stand
from recon_cli.experiments.variants import Arm
from recon_cli.pipeline.execute import rendering
from recon_cli.progress import Progress
from recon_cli.workspace import atomic


def run(request: Request, progress: Progress) -> str:
    """Trains what was asked for, writes the files, and returns what the terminal shows.

    Raises:
        ReconError: something cannot be done; what can be known is found before training.
    """
    paths = checked(request.scenes)
    ctx = rendering(request.compute, progress)
    host = examine(ctx.threads, ctx.device)
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="recon-bench-")))
        stands = [_stand(name, path, scratch, request, ctx) for name, path in paths.items()]
        result = Result(host, request.seeds, request.base, request.targets_db, {
            one.name: _measured(one, request, progress) for one in stands})
    _write(request, result)
    return "\n\n".join(
        [train_report.head(result), *(table.text() for table in train_report.tables(result))])


def _stand(
    name: str, path: Path, scratch: Path, request: Request, ctx: StageContext
) -> Stand:
    place = opened(name, path, scratch, request.settings, request.compute, ctx.progress)
    return stand(place, "validation", request.base, ctx)


def _measured(where: Stand, request: Request, progress: Progress) -> SceneResult:
    """Returns the curves of every recipe.

    Seeds are the outer loop, so that a slow minute falls on all recipes. Before them a pilot of
    each recipe warms up, and turns seconds into steps.
    """
    arms = request.arms
    with progress.bar(f"{where.name}: pilots", len(arms), unit="recipe") as bar:
        steps = {}
        for arm in arms:
            steps[arm.name] = _steps(where, arm, request)
            bar.advance()
    runs: dict[str, list[SeedRun]] = {arm.name: [] for arm in arms}
    with progress.bar(where.name, request.seeds * sum(steps.values()), unit="step") as bar:
        for seed in range(request.seeds):
            for arm in arms:
                bar.note(f"{arm.name}, seed {seed}")
                count = steps[arm.name]
                points = run_trial(
                    where, Run(arm, request.base, count, seed), looks(count), on_step=bar.advance)
                runs[arm.name].append(SeedRun(seed, points))
    size = where.scored[0].camera
    return SceneResult(
        len(where.scored), size.width, size.height,
        {arm.name: ArmResult(arm, steps[arm.name], tuple(runs[arm.name])) for arm in arms})


def _steps(where: Stand, arm: Arm, request: Request) -> int:
    """Returns how many steps every run of a recipe takes."""
    found = pilot(where, arm, request.base, on_step=_nothing)
    if request.seconds is None:
        return request.iterations or STEPS
    return max(1, round(PILOT_STEPS * request.seconds / max(found.seconds, 1e-9)))


def _nothing() -> None:
    """Reports to nobody."""


def _write(request: Request, result: Result) -> None:
    if request.json_file is not None:
        atomic.write_json(request.json_file, result.record())
    if request.plot is not None:
        train_plot.draw(result, request.plot)
    if request.markdown is not None:
        tables = [table.markdown() for table in train_report.tables(result)]
        bench_compare.write_page(
            request.markdown, "\n\n".join([train_report.head(result) + ".", *tables]))


