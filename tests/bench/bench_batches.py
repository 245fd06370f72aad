"""Steps of several views against steps of one: `python tests/bench/bench_batches.py WORKSPACE`.

Trains a copy of a workspace whose sfm is done, at the same number of views and at the same number
of steps, with all learning rates times a factor. Prints a Markdown table.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import click

from recon_cli.config.stages import RunConfig

_RATES = ("means_rate", "quats_rate", "scales_rate", "opacities_rate", "sh_rate")
_MOST = 0.2  # of the rate of opacities


@click.command()
@click.argument("workspace", type=click.Path(path_type=Path))
@click.option("--steps", default=2000, show_default=True, help="of one view.")
@click.option("--views", default=4, show_default=True, help="of the larger steps.")
@click.option("--factors", default="1,2,4", show_default=True, help="of the rates.")
@click.option("--seed", default=0, show_default=True)
@click.argument("options", nargs=-1, type=click.UNPROCESSED)
def main(workspace: Path, steps: int, views: int, factors: str, seed: int,
         options: tuple[str, ...]) -> None:
    """Compare batches on a copy of WORKSPACE; OPTIONS after -- go to recon train."""
    runs = [(steps, 1, 1.0)]
    runs += [(count, views, float(factor)) for count in (steps // views, steps)
             for factor in factors.split(",")]
    click.echo("| steps | views a step | rates | validation dB | held out dB | seconds |\n"
               "|---:|---:|---:|---:|---:|---:|")
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "w"
        shutil.copytree(workspace, copy)
        for count, batch, factor in runs:
            every = RunConfig().densify_every * count // steps  # as often in the run
            found = _trained(copy, count, batch, factor, every, seed, options)
            click.echo(f"| {count:,} | {batch} | x {factor:g} | {found} |")


def _trained(
    workspace: Path, steps: int, batch: int, factor: float, every: int, seed: int,
    options: tuple[str, ...],
) -> str:
    """Returns validation and held-out PSNR and the seconds of one run, as cells of a table."""
    plain = RunConfig()
    rates = {name: getattr(plain, name) * factor for name in _RATES}
    rates["opacities_rate"] = min(_MOST, rates["opacities_rate"])
    given = {"iterations": steps, "batch_views": batch, "densify_every": every, "seed": seed,
             **rates}
    words = [word for name, value in given.items()
             for word in (f"--{name.replace('_', '-')}", str(value))]
    for verb in (["train", "--again", *words, *options], ["eval"]):
        subprocess.run([sys.executable, "-m", "recon_cli", *verb, "-w", str(workspace)],
                       check=True, capture_output=True)
    summary = json.loads((workspace / "train" / "manifest.json").read_text())["summary"]
    scores = json.loads((workspace / "evaluate" / "metrics.json").read_text())
    return (f"{summary['validation_psnr_db']:.2f} | {scores['models']['base']['psnr_db']:.2f} | "
            f"{summary['train_seconds']:.0f}")


if __name__ == "__main__":
    main()
