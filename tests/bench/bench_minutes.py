"""Runs captures within --minutes: the time they took of it, and what training did with its share.

    python tests/bench/bench_minutes.py ../shared/data/walks/*/video.mp4 --minutes 2 --minutes 4

A row is a run in a new folder. "steps" are those of training over those of a normal run, and the
seconds of steps over those of the stage; the other parts are shares of the run's wall time. On a
busy machine the wall time says little: it chooses fewer frames and steps for the same minutes.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import click
import workbench

from recon_cli.train.plan import QUALITIES
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.summaries import EvaluateSummary, TrainSummary

STAGES = ("ingest", "denoise", "sfm", "place", "train", "prune", "evaluate", "export")


def describe_run(workspace: Workspace, wall: float) -> list[str]:
    """Returns the shares of the stages, of the steps, and the score of the original model."""
    found = {name: workspace.manifest(name) for name in STAGES}
    shares = " ".join(f"{manifest.run.seconds / wall:.2f}" if manifest else "-"
                      for manifest in found.values())
    train, evaluate = found["train"], found["evaluate"]
    assert train is not None
    assert evaluate is not None
    training = TrainSummary.from_json(train.run.summary)
    scores = EvaluateSummary.from_json(evaluate.run.summary)
    return [shares, f"{training.iterations / QUALITIES['normal'].iterations:.2f}",
            f"{training.train_seconds / train.run.seconds:.2f}", f"{scores.base_psnr_db:.2f}"]


@click.command()
@click.argument("captures", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--minutes", multiple=True, default=(2.0, 4.0, 8.0), show_default=True)
@click.option("--out", type=click.Path(path_type=Path), help="Folder that keeps the workspaces.")
def main(captures: tuple[Path, ...], minutes: tuple[float, ...], out: Path | None) -> None:
    """Prints the time of each capture within each number of minutes."""
    workbench.print_head("capture", "M", "wall / M", "CPU s", " ".join(STAGES), "steps of normal",
                         "steps of training", "dB")
    with tempfile.TemporaryDirectory() as folder:
        for capture in captures:
            for budget in minutes:
                name = f"{capture.parent.name}-{budget:g}"
                workspace = (out or Path(folder)) / name
                took = workbench.run_recon(
                    workspace, "run", str(capture), "--minutes", f"{budget:g}")
                if took.code:
                    workbench.print_row(capture.parent.name, f"{budget:g}", took.error)
                    continue
                workbench.print_row(
                    capture.parent.name, f"{budget:g}", f"{took.seconds / 60 / budget:.2f}",
                    f"{took.cpu_seconds:.0f}", *describe_run(Workspace(workspace), took.seconds))


if __name__ == "__main__":
    main()
