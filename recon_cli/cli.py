"""One thin command per verb. main() is the only place that catches everything."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

import click

from recon_cli import __version__
from recon_cli.commands import compare_filters, console, doctor, options
from recon_cli.commands import compare_scores as scoreboard
from recon_cli.commands import console as report
from recon_cli.commands import prune_sweep as sweeping
from recon_cli.commands.bench import bench
from recon_cli.commands.import_scene import import_scene
from recon_cli.commands.options import Call, pass_call
from recon_cli.commands.render import render
from recon_cli.commands.report import report as write_report
from recon_cli.commands.shared import beside, perform
from recon_cli.commands.study import study
from recon_cli.commands.view import looking_on, view
from recon_cli.config.settings import Settings
from recon_cli.config.stages import (
    ComputeConfig,
    DenoiseConfig,
    EvaluateConfig,
    ExportConfig,
    IngestConfig,
    PruneConfig,
    SfmConfig,
    TrainConfig,
)
from recon_cli.errors import ReconError
from recon_cli.evaluation import tables
from recon_cli.pipeline import clean as cleaning
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job
from recon_cli.progress import bars_aside
from recon_cli.stages import STAGES
from recon_cli.train.distributed import launch
from recon_cli.workspace.layout import Workspace

SAMPLE = Path(__file__).parent / "samples" / "room.mp4"
MID: Settings = {"prune": {"at": "mid"}}  # what the paper does: prune while training goes on
INTERRUPTED = 130

logger = logging.getLogger("recon")


class _InOrder(click.Group):
    """Lists its commands in the order of the work, not of the alphabet."""

    def list_commands(self, ctx: click.Context) -> list[str]:  # noqa: ARG002
        """Returns the verbs as they were defined."""
        return list(self.commands)


@click.group(cls=_InOrder)
@click.version_option(__version__, prog_name="recon")
def cli() -> None:
    """Turn a video or photos of a room into a 3D Gaussian Splatting scene."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command line and returns its exit code."""
    call = Call()
    handler = console.show_log(detailed=lambda: call.verbose, aside=bars_aside)
    try:
        if launch.follows():
            return launch.follow()
        with launch.leading() as call.ranks:
            code = cli.main(arguments, prog_name="recon", standalone_mode=False, obj=call)
        return code if isinstance(code, int) else 0
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted; run the same command again to resume", err=True)
        return INTERRUPTED
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return error.exit_code
    except click.ClickException as error:
        console.complain(error.format_message(), console.usage_hint(error))
        return error.exit_code
    except ReconError as error:
        logger.debug("failed", exc_info=True)
        console.complain(error.message, error.hint)
        return error.exit_code
    except Exception as error:
        logger.debug("failed", exc_info=True)
        console.complain(
            f"{type(error).__name__}: {error}",
            "This is a bug in recon. Run the command again with -v and report what it prints.")
        return 1
    finally:
        logger.removeHandler(handler)


_inputs = click.argument(
    "inputs", metavar="[INPUT]...", nargs=-1, type=click.Path(path_type=Path))


@cli.command()
@_inputs
@options.stage(IngestConfig)
@pass_call
def ingest(call: Call, inputs: tuple[Path, ...]) -> None:
    """Choose frames from INPUT: videos, photos and folders of photos, or a data set with poses.

    Each video and folder gets intrinsics of its own. A COLMAP model, transforms.json, Replica or
    ScanNet is told by its layout. Without INPUT, that of the last time is read again.
    """
    perform(call, "ingest", ["ingest"], sources=inputs)


@cli.command()
@options.compare()
@options.stage(DenoiseConfig)
@pass_call
def denoise(call: Call, compare: bool) -> None:
    """Filter noisy frames and pass the others through."""
    if compare:
        click.echo(compare_filters.compare_filters(*beside(call, DenoiseConfig)))
        return
    perform(call, "denoise", ["denoise"])


@cli.command()
@options.stage(SfmConfig)
@pass_call
def sfm(call: Call) -> None:
    """Find cameras and a sparse point cloud."""
    perform(call, "sfm", ["sfm"])


@cli.command()
@click.option(
    "--prune", "with_prune", is_flag=True,
    help="Then branch off in mid-training, prune there and train the rest of the run again.  "
         "[default: off]")
@options.of(PruneConfig, without=("at", "max_gaussians", "max_psnr_drop"), lead="With --prune: ")
@click.option(
    "--view", "with_view", is_flag=True,
    help="Show the Gaussians in the browser while they are trained; the result is the same.  "
         "[default: off]")
@options.stage(TrainConfig, renders=True)
@pass_call
def train(call: Call, with_prune: bool, with_view: bool) -> None:
    """Fit Gaussians; denoise and sfm run first where needed."""
    for name in call.settings.get("prune", {}) if not with_prune else ():
        raise click.UsageError(f"--{name.replace('_', '-')} has no effect without --prune.")
    with looking_on(call) if with_view and not call.print_config else nullcontext() as watcher:
        if with_prune:
            perform(
                call, "train --prune", ["train", "prune"], forced=MID, watcher=watcher)
        else:
            perform(call, "train", ["train"], watcher=watcher)


cli.add_command(import_scene)


@cli.command()
@options.sweep()
@options.stage(PruneConfig, renders=True)
@pass_call
def prune(call: Call, sweep: bool, ratios: tuple[float, ...]) -> None:
    """Remove the least important Gaussians; the rest recovers."""
    if sweep:
        click.echo(sweeping.sweep(*beside(call, PruneConfig), ratios))
        return
    perform(call, "prune", ["prune"])


@cli.command("eval")
@click.argument("items", metavar="[ITEM]...", nargs=-1, type=click.Path(path_type=Path))
@click.option(
    "--seeds", type=click.IntRange(min=1), metavar="N",
    help="Train the models N - 1 times more, each with another seed, and print mean and deviation. "
         " [default: off]")
@click.option(
    "--form", type=click.Choice(scoreboard.FORMS), default="text",
    help="With ITEM or --seeds: how the table is printed.  [default: text]")
@options.stage(EvaluateConfig, renders=True)
@pass_call
def evaluate(call: Call, items: tuple[Path, ...], seeds: int | None, form: str) -> None:
    """Score every model on the held-out views.

    With ITEM, workspaces and files of Gaussians (.ply, .spz, .sog, .splat, .glb): their models in
    one table. Files are scored on the views of the workspace.
    """
    if items and seeds:
        raise click.UsageError("--seeds is about one workspace: give it with -w, without ITEM.")
    if seeds:
        click.echo(scoreboard.over_seeds(*beside(call, EvaluateConfig), seeds, form))
        return
    if items:
        click.echo(scoreboard.compare(
            lambda path: beside(dataclasses.replace(call, workspace=path), EvaluateConfig),
            call.workspace, items, form))
        return
    perform(call, "eval", ["evaluate"])


@cli.command()
@options.stage(ExportConfig, renders=True)
@pass_call
def export(call: Call) -> None:
    """Write a .ply that other viewers open, and other formats; check each."""
    perform(call, "export", ["export"])


cli.add_command(render)
cli.add_command(view)
cli.add_command(write_report)


@cli.command("run")
@_inputs
@click.option(
    "--prune/--no-prune", "with_prune", default=True,
    help="Prune in mid-training too.  [default: --prune]")
@options.assignments()
@options.of(ComputeConfig)
@options.again()
@options.print_config()
@options.common()
@pass_call
def run_all(call: Call, inputs: tuple[Path, ...], with_prune: bool) -> None:
    """Do everything from INPUT to the .ply.

    INPUT is what `recon ingest` takes. Without it, that of the last time is read again.
    """
    stages = [row.name for row in STAGES if with_prune or row.name != "prune"]
    perform(call, "run", stages, sources=inputs, base=MID)


@cli.command()
@options.assignments()
@options.of(ComputeConfig)
@options.again()
@options.common(workspace="demo", envvar=None)
@pass_call
def demo(call: Call) -> None:
    """Do everything on the bundled room video."""
    stages = [row.name for row in STAGES]
    perform(call, "demo", stages, sources=(SAMPLE,), base=MID)
    click.echo(f"The scene is in {call.workspace / 'export' / 'splats.ply'}")


@cli.command()
@click.option(
    "--json", "as_json", is_flag=True,
    help="Print JSON: workspace, and stages with name, state, reasons, done, total, seconds, "
         "summary, notices.  [default: off]")
@options.common()
@pass_call
def status(call: Call, as_json: bool) -> None:
    """Show what is fresh, stale and why, partial, or missing."""
    job = Job(Workspace(call.workspace), options.explicit(call), table=STAGES)
    stages = plan.status(job)
    if as_json:
        click.echo(json.dumps({
            "workspace": str(job.workspace.root),
            "stages": [dataclasses.asdict(stage) for stage in stages]}, indent=1))
        return
    if not job.workspace.root.exists():
        logger.warning("there is no workspace at %s yet", job.workspace.root)
    click.echo(report.status_table(stages))
    for stage in stages:
        for notice in stage.notices:
            logger.warning("%s: %s", stage.name, notice)


@cli.command()
@click.argument(
    "stages", metavar="[STAGE]...", nargs=-1, type=click.Choice([row.name for row in STAGES]))
@click.option("--dry-run", is_flag=True, help="Only say what would go.  [default: off]")
@options.common()
@pass_call
def clean(call: Call, stages: tuple[str, ...], dry_run: bool) -> None:
    """Free disk space.

    Without STAGE, unfinished work and scratch files go and every finished result stays. With STAGE,
    the results of those stages go.
    """
    job = Job(Workspace(call.workspace), table=STAGES)
    freed = cleaning.clean(job, stages, dry=dry_run)
    for one in freed:
        click.echo(f"{one.path}: {tables.format_megabytes(one.size)}")
    verb = "would be freed" if dry_run else "freed"
    click.echo(f"{tables.format_megabytes(sum(one.size for one in freed))} {verb}")


@cli.command("doctor")
@click.option("--json", "as_json", is_flag=True, help="Print the same as JSON.  [default: off]")
@options.common()
@pass_call
def show_doctor(call: Call, as_json: bool) -> None:
    """Show versions, rasterizers, memory and disk."""
    found = doctor.examine(call.workspace)
    text = json.dumps(dataclasses.asdict(found), indent=1)
    click.echo(text if as_json else report.doctor_text(found))


cli.add_command(bench)
cli.add_command(study)
