"""What scoring costs in a pruning: the same removals with scores and without, in CPU seconds.

    python tests/bench/bench_prune_scores.py WORKSPACE --ratio 0.66

Scores change no gradient, so a second run that is told which rows stay takes the very same steps.
"""

from __future__ import annotations

import dataclasses
import time
import zlib  # noqa: F401 - before pycolmap, which brings a zlib of its own
from pathlib import Path

import click
import torch

from recon_cli.config.stages import PruneConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.render.registry import use_threads
from recon_cli.train.prune_loop import PruneRun, prune_loop, remaining, remove, survivors
from recon_cli.train.prune_run import PruneSource, load_prune_source

REPEATS = 3


class Told(PruneRun):
    """Removes rows that it was told and scores nothing, or keeps the rows that its scores give."""

    def __init__(self, source: PruneSource, told: list[torch.Tensor] | None) -> None:
        state, task = source.begin(), source.recovery(source.first, source.until)
        super().__init__(state, dataclasses.replace(task, validation=[]), source.first,
                         source.until, rounds=source.rounds)
        self.told, self.rows = told, list[torch.Tensor]()

    def score(self, until: int) -> torch.Tensor:
        if self.told is None:
            return super().score(until)
        self.advance(max(self.state.iteration, until - len(self.task.train)))
        self.state.queue = []
        self.advance(until)
        return torch.empty(0)

    def remove(self, score: torch.Tensor, count: int) -> None:
        told = self.told
        self.rows.append(survivors(score, count) if told is None else told[len(self.rows)])
        remove(self.state, self.rows[-1])


def seconds(source: PruneSource, ratio: float, told: list[torch.Tensor] | None) -> tuple[
    float, list[torch.Tensor], torch.Tensor
]:
    """Returns CPU seconds, the rows that stayed in each round, and the means at the end."""
    run = Told(source, told)
    begin = time.process_time()
    prune_loop(run, remaining(len(run.state.splats), ratio))
    return time.process_time() - begin, run.rows, run.state.splats.means.detach()


@click.command()
@click.argument("workspace", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--ratio", default=0.66, show_default=True, help="Share that is removed.")
def main(workspace: Path, ratio: float) -> None:
    """Print the least seconds of each way and their ratio; WORKSPACE holds a trained model."""
    use_threads("numba", 1)
    inputs = StageInputs({name: workspace / name for name in ("ingest", "sfm", "train")})
    source = load_prune_source(PruneConfig(), inputs, StageContext(backend="numba"))
    with_scores, without = [], []
    for _ in range(REPEATS):
        spent, rows, means = seconds(source, ratio, None)
        with_scores.append(spent)
        spent, _, same = seconds(source, ratio, rows)
        without.append(spent)
        assert torch.equal(means, same)
    a, b = min(with_scores), min(without)
    click.echo(
        f"{ratio:.0%} in {source.rounds} rounds, {source.until - source.first} steps: "
        f"{a:.2f} s with scores, {b:.2f} s without: {a / b - 1:+.1%}")


if __name__ == "__main__":
    main()
