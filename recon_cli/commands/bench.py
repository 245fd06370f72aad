"""The verbs of experiments: `recon bench` and `recon study`."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from recon_cli.commands import options
from recon_cli.commands.console import say
from recon_cli.commands.options import Call, Command, Verb, pass_call
from recon_cli.config import settings
from recon_cli.config.protocols import STEPS
from recon_cli.config.settings import Settings
from recon_cli.config.stages import ComputeConfig
from recon_cli.progress import TqdmProgress

if TYPE_CHECKING:
    from recon_cli.experiments.study import Design

_option = functools.partial(click.option, cls=options.Option)
_FILE = options.PathType(dir_okay=False)
_SCENE = options.PathType()


@dataclass(frozen=True)
class SceneOptions:
    """The scenes of a training experiment, and the size and cap of their runs."""

    paths: tuple[Path, ...]
    max_size: int
    max_gaussians: int

    def fields(
        self, call: Call, *, validation: float | None = None, defaults: Settings | None = None
    ) -> dict[str, Any]:
        """Returns the fields of an ExperimentRequest; `validation` as in `runner.base_config`.

        `defaults` are settings that --set may change.
        """
        from recon_cli.experiments.runner import base_config

        assigned = settings.merge([defaults or {}, call.assigned])
        return {
            "scenes": self.paths, "settings": assigned,
            "compute": settings.build(ComputeConfig, call.settings),
            "base": base_config(assigned, max_size=self.max_size,
                                max_gaussians=self.max_gaussians, validation=validation)}


def _scene_options(function: Command) -> Command:
    """Adds SCENE..., `--scenes`, and the size and cap of their runs as one `scenes`."""
    @functools.wraps(function)
    def collect(
        *args: Any, more: tuple[Path, ...], scenes: tuple[Path, ...], max_size: int,
        max_gaussians: int, **typed: Any,
    ) -> Any:
        collected = SceneOptions((*scenes, *more), max_size, max_gaussians)
        return function(*args, scenes=collected, **typed)

    return options.stack([
        click.argument("more", metavar="[SCENE]...", nargs=-1, type=_SCENE),
        _option(
            "--scenes", multiple=True, type=_SCENE, metavar="SCENE...",
            help="Workspaces with cameras, or data sets with poses; the words after it are scenes "
                 "too.  [default: none]"),
        _option(
            "--max-size", expert=True, type=click.IntRange(min=16), default=600, metavar="N",
            help="Longest side of the images.  [pixels; default: 600]"),
        _option(
            "--max-gaussians", expert=True, type=click.IntRange(min=1), default=60_000, metavar="N",
            help="Cap of the count.  [default: 60000]")])(collect)


_compute_options = options.stack([
    options.assignments("ingest.frames=200"), options.compute(), options.verbosity])


@click.command("bench", cls=Verb)
@_option(
    "--scene", type=click.Choice(["room", "small"]), default="room",
    help="room is 100,000 Gaussians at 640x360, small 10,000 at 320x180.  [default: room]")
@_option(
    "--gaussians", expert=True, type=click.IntRange(min=1), metavar="N",
    help="How many Gaussians.  [default: of the scene]")
@_option("--size", expert=True, metavar="WxH", help="Size of the image in pixels.  "
         "[default: of the scene]")
@_option(
    "--sh-degree", expert=True, type=click.IntRange(0, 3), default=3, metavar="N",
    help="Degree of the spherical harmonics.  [default: 3]")
@_option(
    "--backend", "backends", multiple=True, metavar="NAME",
    help="Rasterizer to measure; may be repeated.  [default: all that run on the device]")
@options.compute(without=("backend",))
@_option(
    "--rounds", expert=True, type=click.IntRange(min=1), metavar="N",
    help="Runs behind each median.  [default: 7, with --quick 2]")
@_option(
    "--quick", is_flag=True,
    help="A tiny scene and few rounds: whether it works, not how fast.  [default: off]")
@_option("--out", type=_FILE,
         help="Write all figures to FILE, as JSON.  [default: nowhere]")
@options.verbosity
@pass_call
def bench(call: Call, /, **typed: Any) -> None:
    """Measure the rasterizers: speed and error.

    Times every stage on a synthetic room and compares images and gradients with a rasterizer in
    float64, for every backend.
    """
    compute = settings.build(ComputeConfig, call.settings)
    from recon_cli.experiments.backends import BenchRequest, run

    say(run(
        BenchRequest(**typed, device=compute.device, threads=compute.threads),
        TqdmProgress()).text())


@click.command("study", cls=Verb)
@_scene_options
@_option(
    "--replica", type=options.PathType(file_okay=False), metavar="DIR",
    help="Fill the paper's Tables I and II: DIR holds the rooms of Replica (room0 to room2, "
         "office0 to office4), SCENE are own captures. 3DGS, the paper's prune and ours, at equal "
         "steps, on 200 frames a room; defaults become 30000 steps, 1200 pixels, 400000 "
         "Gaussians and one seed.  [default: none]")
@_option(
    "--seeds", type=click.IntRange(min=1), default=5, metavar="N",
    help="Runs of each variant, with seeds 0 to N - 1.  [default: 5]")
@_option(
    "--iterations", type=click.IntRange(min=1), default=3000, metavar="N",
    help="Steps of every variant where steps are equal.  [default: 3000]")
@_option(
    "--clock", expert=True, type=click.Choice(["wall", "cpu"]), default="wall",
    help="Which seconds are made equal; cpu on a machine that others use too.  [default: wall]")
@_option(
    "--out", type=options.PathType(file_okay=False), default=Path("study"),
    help="Folder of finished runs, study.json, study.md and study.svg; runs found there are not "
         "made again.  [default: study]")
@_compute_options
@pass_call
def study(call: Call, /, scenes: SceneOptions, replica: Path | None, **typed: Any) -> None:
    """Repeat the paper's experiment: 3DGS against ours.

    Trains 3DGS, 3DGS with the paper's prune, ours and ours pruned on every SCENE, at equal steps
    and at equal seconds, and scores them on held-out views, with intervals over the seeds.
    """
    from recon_cli.experiments.study import STUDY, StudyRequest, run

    design, defaults = STUDY, None
    if replica is not None:
        scenes, design, defaults = _fill_paper_tables(replica, scenes, typed)
    # nothing looks at validation views here, so all but the test views are trained on
    request = StudyRequest(
        **scenes.fields(call, validation=0.0, defaults=defaults), **typed, design=design)
    say(run(request, TqdmProgress()).text())


def _fill_paper_tables(
    replica: Path, scenes: SceneOptions, typed: dict[str, Any]
) -> tuple[SceneOptions, Design, Settings]:
    """Returns scenes, design and settings of --replica; sets steps and seeds that were not given.

    Raises:
        InputError: the folder holds no room, or an incomplete one.
    """
    from recon_cli.experiments import replica as rooms
    from recon_cli.experiments.study import PAPER_TABLES

    context = click.get_current_context()

    def choose(name: str, given: int, default: int) -> int:
        typed_in = context.get_parameter_source(name) is ParameterSource.COMMANDLINE
        return given if typed_in else default

    typed["iterations"] = choose("iterations", typed["iterations"], STEPS)
    typed["seeds"] = choose("seeds", typed["seeds"], 1)
    found = SceneOptions(
        (*rooms.find_rooms(replica), *scenes.paths),
        choose("max_size", scenes.max_size, rooms.SIZE),
        choose("max_gaussians", scenes.max_gaussians, rooms.MAX_GAUSSIANS))
    return found, PAPER_TABLES, {
        "ingest": {"frames": rooms.FRAMES}, "train": {"images": "original"}}
