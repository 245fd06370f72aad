"""What scoring costs in a pruning: the same removals with scores and without, in CPU seconds.

    python tests/bench/bench_prune_scores.py WORKSPACE --ratio 0.66

Scores change no gradient, so a second run that is told which rows stay takes the very same steps.
"""

from __future__ import annotations

import time
import zlib  # noqa: F401 - before pycolmap, which brings a zlib of its own
from pathlib import Path

import click
import torch

from recon_cli.config.stages import PruneConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.experiments.sweep import advancing
from recon_cli.render.registry import use_threads
from recon_cli.train.prune_run import Course, course_of
from recon_cli.train.pruning import remaining, removals, remove, scored, survivors

REPEATS = 3


def seconds(course: Course, ratio: float, told: list[torch.Tensor] | None) -> tuple[
    float, list[torch.Tensor], torch.Tensor
]:
    """Returns CPU seconds, the rows that stayed in each round, and the means at the end."""
    state, first, until = course.start(), course.first, course.until
    task = course.recovering(first, until)
    advance, kept = advancing(task), []
    plan = removals(len(state.splats), remaining(len(state.splats), ratio), course.rounds,
                    until - first)
    begin = time.process_time()
    for number, removal in enumerate(plan):
        at = first + removal.after
        if told is None:
            score = scored(state, task, at, name=course.config.score, beta=0.1, advance=advance)
            kept.append(survivors(score, removal.count))
        else:
            advance(state, max(state.iteration, at - len(task.train)), None)
            state.queue = []
            advance(state, at, None)
            kept.append(told[number])
        remove(state, kept[-1])
    advance(state, until, None)
    return time.process_time() - begin, kept, state.splats.means.detach()


@click.command()
@click.argument("workspace", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--ratio", default=0.66, show_default=True, help="Share that is removed.")
def main(workspace: Path, ratio: float) -> None:
    """Print the least seconds of each way and their ratio; WORKSPACE holds a trained model."""
    use_threads("numba", 1)
    inputs = StageInputs({name: workspace / name for name in ("ingest", "sfm", "train")})
    course = course_of(
        PruneConfig(), inputs, workspace, StageContext(backend="numba"))
    with_scores, without = [], []
    for _ in range(REPEATS):
        spent, rows, means = seconds(course, ratio, None)
        with_scores.append(spent)
        spent, _, same = seconds(course, ratio, rows)
        without.append(spent)
        assert torch.equal(means, same)
    a, b = min(with_scores), min(without)
    click.echo(
        f"{ratio:.0%} in {course.rounds} rounds, {course.until - course.first} steps: "
        f"{a:.2f} s with scores, {b:.2f} s without: {a / b - 1:+.1%}")


if __name__ == "__main__":
    main()
