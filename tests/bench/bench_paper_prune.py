"""Whether any setting of the paper's prune gains over 3DGS: `bench_paper_prune.py SCENES OUT`.

Ratio, time, rounds and recovery of the prune by equations 3 to 5 in mid-training, each run beside
3DGS of the same seed and as many steps, scored on held-out views. 3DGS is trained once a scene and
seed; a setting branches off its state at the time of its prune, so that both have the same steps
before. The grid is fractional (GRID): all ratios at LightGaussian's two thirds, others by turns.
OUT/runs.jsonl keeps finished runs, and another call makes only the missing ones:

    python tests/bench/bench_paper_prune.py living office fox bonsai out --seeds 3
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Iterator
from pathlib import Path

import click

from recon_cli.config.stages import ComputeConfig, PruneConfig, RunConfig
from recon_cli.evaluation.intervals import paired_t
from recon_cli.evaluation.scores import Table
from recon_cli.experiments.runner import _prune_run, score_as_ply
from recon_cli.experiments.scenes import (
    ExperimentScene,
    check_scenes,
    load_for_training,
    open_scene,
)
from recon_cli.experiments.variants import REFERENCE, MidPrune, TrainingRun
from recon_cli.pipeline.execute import render_context
from recon_cli.progress import NullProgress
from recon_cli.train.fit.initialize import first_state, restore_state
from recon_cli.train.fit.loop import fit
from recon_cli.train.fit.state import save_state
from recon_cli.train.plan import first_count
from recon_cli.train.prune.prune_loop import prune_loop, remaining

THIRD = 1 / 3


@dataclasses.dataclass(frozen=True)
class Setting:
    """One way to prune midway."""

    ratio: float
    at: float = 2 * THIRD  # share of the run; densification ends at a half
    rounds: int = 1
    restarts: bool = False  # learning rates restart afterwards, and nothing grows back
    score: str = "paper"

    @property
    def name(self) -> str:
        """Its name in tables and files."""
        words = [self.score, f"{self.ratio:.0%} at {self.at:.2f}"]
        words += [f"{self.rounds} rounds"] * (self.rounds > 1)
        words += ["rates restart"] * self.restarts
        return ", ".join(words)

    @property
    def prune(self) -> MidPrune:
        """The options of the prune."""
        config = PruneConfig(ratio=self.ratio, score="paper", at="mid", rounds=self.rounds)
        object.__setattr__(config, "score", self.score)  # random is no choice of `recon prune`
        return MidPrune(self.at, config, restarts=self.restarts)


GRID = (
    *(Setting(ratio) for ratio in (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)),
    *(Setting(ratio, at) for at in (THIRD, 0.5, 5 / 6) for ratio in (0.1, 0.3)),
    *(Setting(ratio, rounds=3) for ratio in (0.1, 0.3, 0.6)),
    *(Setting(ratio, restarts=True) for ratio in (0.1, 0.3, 0.6)),
    # controls: as many removed otherwise, and the restart of the rates alone
    Setting(0.3, score="random"), Setting(0.3, score="loo"), Setting(0.0, restarts=True),
    *(Setting(ratio, THIRD, score="random") for ratio in (0.1, 0.3)))
NONE = "3DGS"


def make_runs(loaded: ExperimentScene, seed: int, steps: int, wanted: set[str], scratch: Path
              ) -> Iterator[dict[str, object]]:
    """Yields the score of 3DGS and of every wanted setting."""
    run = TrainingRun(REFERENCE, loaded.base, steps, seed)
    task = loaded.task(run)
    config = task.schedule.config
    times = sorted({setting.at for setting in GRID})
    begin = time.process_time()
    state = first_state(task, loaded.scene.points, loaded.scene.colors,
                        most=first_count(config, len(loaded.scene.points)))
    for at in times:
        fit(state, task, round(at * steps))
        save_state(scratch / f"{at:.3f}.safetensors", state)
    fit(state, task, steps)

    def score(name: str, seconds: float) -> dict[str, object]:
        splats = state.splats.map(lambda tensor: tensor.detach())
        found, _ = score_as_ply(splats, loaded.scored, config.sh_degree, loaded.ctx)
        return {"scene": loaded.folders.name, "seed": seed, "setting": name, "steps": steps,
                "psnr_db": found.psnr_db, "ssim": found.ssim, "gaussians": len(splats),
                "cpu_seconds": round(seconds, 1)}

    if NONE in wanted:
        yield score(NONE, time.process_time() - begin)
    for setting in GRID:
        if setting.name not in wanted:
            continue
        begin = time.process_time()
        state = restore_state(scratch / f"{setting.at:.3f}.safetensors", task)
        prune_loop(_prune_run(state, task, setting.prune, steps, ()),
                   remaining(len(state.splats), setting.ratio))
        yield score(setting.name, time.process_time() - begin)


def difference_table(rows: list[dict[str, object]]) -> Table:
    """Returns each setting minus 3DGS of the same scene and seed.

    The means are over seeds, then over scenes; the intervals are Student's over the scenes, so they
    are about other captures.
    """
    value = {(row["scene"], row["seed"], row["setting"]): row for row in rows}
    scenes = list(dict.fromkeys(row["scene"] for row in rows))

    def by_scene(setting: str, figure: str) -> list[float]:
        found = [[float(row[figure]) - float(value[scene, seed, NONE][figure])
                  for (of, seed, name), row in value.items()
                  if (of, name) == (scene, setting) and (scene, seed, NONE) in value]
                 for scene in scenes]
        return [sum(values) / len(values) for values in found if values]

    lines = []
    for setting in GRID:
        psnr, ssim = (by_scene(setting.name, figure) for figure in ("psnr_db", "ssim"))
        if not psnr:
            continue
        nothing = [0.0] * len(psnr)
        interval = paired_t(psnr, nothing)
        lines.append((
            setting.name, interval.text("+.2f"), interval.verdict,
            paired_t(ssim, nothing).text("+.4f"), *(f"{value:+.2f}" for value in psnr),
            *["-"] * (len(scenes) - len(psnr))))
    return Table(("prune", "PSNR dB", "so it is", "SSIM", *map(str, scenes)), lines)


@click.command()
@click.argument("scenes", nargs=-1, type=click.Path(path_type=Path), required=True)
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--seeds", default=3)
@click.option("--iterations", default=3000)
@click.option("--max-size", default=400)
@click.option("--max-gaussians", default=80_000)
@click.option("--threads", default=2)
@click.option("--setting", "only", multiple=True, type=click.Choice([s.name for s in GRID]),
              help="This setting alone; may be repeated.")
def main(scenes: tuple[Path, ...], out: Path, seeds: int, iterations: int, max_size: int,
         max_gaussians: int, threads: int, only: tuple[str, ...]) -> None:
    """Makes the missing runs and prints the table after each scene."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "runs.jsonl"
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    compute = ComputeConfig(threads=threads)
    base = RunConfig(max_size=max_size, max_gaussians=max_gaussians, validation=0.0,
                     early_stop=False, images="original")
    ctx = render_context(compute, NullProgress())
    wanted = {NONE, *(only or (setting.name for setting in GRID))}
    for seed in range(seeds):
        for name, path in check_scenes(scenes).items():
            done = {row["setting"] for row in rows
                    if (row["scene"], row["seed"], row["steps"]) == (name, seed, iterations)}
            if wanted <= done:
                continue
            loaded = load_for_training(
                open_scene(name, path, out, {}, compute, NullProgress()), "test", base, ctx)
            for row in make_runs(loaded, seed, iterations, wanted - done, out):
                rows.append(row)
                with file.open("a") as stream:
                    stream.write(json.dumps(row) + "\n")
                click.echo(json.dumps(row))
        click.echo(difference_table(rows).markdown())


if __name__ == "__main__":
    main()
