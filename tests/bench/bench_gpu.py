"""The triton backend on a GPU: `python tests/bench/bench_gpu.py`.

Builds the kernels, checks them, and measures pictures, gradients, training steps and memory. Each
figure is printed at once; a table of all of them comes last. Exit code 1 where a check failed or a
part broke off. tests/bench/README.md says how things are measured.

    TRITON_INTERPRET=1 python tests/bench/bench_gpu.py --device cpu --gaussians 60 --size 32x16 \
        --rounds 1 --stretch 2

tries the script where there is no GPU.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import click
import gpu_checks
import gpu_speed
import torch
from gpu_clock import clear
from gpu_figures import Figures

from recon_cli.experiments.bench_scene import SceneSize

_SMALL = 8  # the part of Gaussians and of each side in the first checks, which are soon over
_LEAST = 40, 16  # Gaussians, pixels


def smaller(size: SceneSize) -> SceneSize:
    """Returns a size that is soon checked."""
    return SceneSize(max(min(_LEAST[0], size.gaussians), size.gaussians // _SMALL),
                     max(_LEAST[1], size.width // _SMALL), max(_LEAST[1], size.height // _SMALL))


def parts(
    figures: Figures, whole: SceneSize, rounds: int, stretch: int
) -> list[tuple[str, str, Callable[[], None]]]:
    """Returns the parts in order: what --only calls them, their names, and their work."""
    small = smaller(whole)
    return [
        ("kernels", "kernels", lambda: gpu_speed.build(figures, whole, stretch)),
        ("checks", "small pictures checked", lambda: gpu_checks.agreement(figures, small)),
        ("checks", "small steps checked", lambda: gpu_checks.recordings(figures, small)),
        ("checks", "pictures checked", lambda: gpu_checks.agreement(figures, whole)),
        ("checks", "steps checked", lambda: gpu_checks.recordings(figures, whole)),
        ("checks", "waiting checked", lambda: gpu_checks.waiting(figures, whole)),
        ("pictures", "pictures", lambda: gpu_speed.pictures(figures, whole, rounds)),
        ("gsplat", "gsplat", lambda: gpu_speed.gsplat(figures, whole, rounds)),
        ("steps", "steps", lambda: gpu_speed.steps(figures, whole, rounds, stretch)),
    ]


@click.command()
@click.option("--device", default="cuda", type=click.Choice(["cuda", "cpu"]), show_default=True)
@click.option("--gaussians", default=500_000, show_default=True)
@click.option("--size", default="1200x680", metavar="WxH", show_default=True)
@click.option("--rounds", default=7, show_default=True, help="of each candidate.")
@click.option("--stretch", default=96, show_default=True, type=click.IntRange(1, 99),
              help="Training steps that are timed at a time.")
@click.option("--only", multiple=True, type=click.Choice(
    ["kernels", "checks", "pictures", "gsplat", "steps"]),
    help="Part to do; may be repeated.  [default: all]")
@click.option("--minutes", default=9.0, show_default=True, help="What does not fit is left out.")
@click.option("--cache", type=click.Path(file_okay=False, path_type=Path),
              help="Folder of compiled kernels.  [default: a new one: compilation is timed]")
@click.option("--out", type=click.Path(dir_okay=False, path_type=Path),
              help="Write all figures as JSON.  [default: nowhere]")
def main(device: str, gaussians: int, size: str, rounds: int, stretch: int,
         only: tuple[str, ...], minutes: float, cache: Path | None, out: Path | None) -> None:
    """Check and measure the triton backend on DEVICE."""
    width, _, height = size.partition("x")
    whole = SceneSize(gaussians, int(width), int(height))
    figures = Figures(device, 60 * minutes)
    if device == "cuda":
        found = torch.cuda.get_device_properties(0)
        figures.say(f"{found.name}, {found.total_memory / 2**30:.0f} GiB, torch "
                    f"{torch.__version__}")
    figures.say(f"{gaussians:,} Gaussians of degree 3, {size}")
    clock = figures.watch(out)
    with tempfile.TemporaryDirectory(prefix="recon-triton-") as empty:
        # without --cache kernels of earlier runs are not found: their compilation is timed
        os.environ["TRITON_CACHE_DIR"] = empty if cache is None else str(cache)
        for group, name, work in parts(figures, whole, rounds, stretch):
            if not only or group in only:
                figures.part(name, lambda work=work: (clear(device), work()))
    clock.cancel()
    click.echo(f"\n{figures.table()}")
    if out is not None:
        figures.write(out)
    sys.exit(bool(figures.failures))


if __name__ == "__main__":
    main()
