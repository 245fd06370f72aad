"""The verbs that run stages: one each, and `run` and `demo`, which run them all."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.console import say
from recon_cli.commands.jobs import open_job, open_job_with, run_stages
from recon_cli.commands.options import Call, explicit_settings, pass_call, verb
from recon_cli.commands.sentences import end_run
from recon_cli.commands.view import show_training
from recon_cli.config.export import ExportConfig
from recon_cli.config.settings import Settings, merge
from recon_cli.config.stages import (
    DenoiseConfig,
    EvaluateConfig,
    ImportConfig,
    IngestConfig,
    PruneConfig,
    SfmConfig,
    TrainConfig,
)
from recon_cli.errors import command_line
from recon_cli.stages import IMPORT, STAGES

SAMPLE = Path(__file__).parents[1] / "samples" / "room.mp4"
MID: Settings = {"prune": {"at": "mid"}}  # as in the paper: prune midway through training
# Fewer steps than a capture of one's own gets: this room scores as 3DGS does after them already.
# Surfaces by stereo would take a tenth of the time, for less than steps gain in it.
DEMO: Settings = {**MID, "train": {"iterations": 1700, "stereo": "off"}}
FORMS = ("text", "markdown", "csv", "latex", "json")

_inputs = click.argument("inputs", metavar="[INPUT]...", nargs=-1, type=options.PathType())


@verb("ingest")
@_inputs
@options.stage(IngestConfig)
@pass_call
def ingest(call: Call, inputs: tuple[Path, ...]) -> None:
    """Choose frames from videos, photos or a capture with poses.

    INPUT: videos, photos, folders of photos, or a capture with poses, recognised by its layout: of
    a scanning app (Polycam, Record3D, Stray Scanner and others), of photogrammetry (COLMAP,
    Metashape, RealityScan and others) or a data set. Each video and each folder gets its own
    intrinsics. Without INPUT, the previous input is used.
    """
    run_stages(call, "ingest", ["ingest"], sources=inputs)


@verb("denoise")
@options.stage(DenoiseConfig)
@pass_call
def denoise(call: Call) -> None:
    """Filter noisy frames and pass the others through."""
    run_stages(call, "denoise", ["denoise"])


@verb("sfm")
@options.stage(SfmConfig)
@pass_call
def sfm(call: Call) -> None:
    """Estimate cameras and a sparse point cloud."""
    run_stages(call, "sfm", ["sfm", "place"])


@verb("train")
@click.option(
    "--prune", "with_prune", is_flag=True,
    help="Also prune midway through training.  [default: off]")
@options.config_options(
    PruneConfig, without=("at", "max_gaussians", "max_psnr_drop"),
    expert=("max_mb", "rounds", "score", "recovery"), lead="With --prune: ")
@click.option(
    "--view", "with_view", is_flag=True, help="Show the training in the browser.  [default: off]")
@options.from_import
@options.stage(TrainConfig, renders=True)
@pass_call
def train(call: Call, with_prune: bool, with_view: bool) -> None:
    """Fit Gaussians; denoise and sfm run first where needed."""
    for name in call.settings.get("prune", {}) if not with_prune else ():
        raise click.UsageError(f"--{name.replace('_', '-')} has no effect without --prune.")
    with show_training(call) if with_view and not call.print_config else nullcontext() as live:
        callbacks = () if live is None else (live,)
        if with_prune:
            run_stages(call, "train --prune", ["train", "prune"], forced=MID, callbacks=callbacks)
        else:
            run_stages(call, "train", ["train"], callbacks=callbacks)


@verb("import")
@click.argument("file", required=False, type=options.PathType())
@options.stage(ImportConfig, renders=True)
@pass_call
def import_scene(call: Call, file: Path | None) -> None:
    """Import a splat file instead of training.

    FILE is a scene of any program: {formats}. In a workspace with views (`recon ingest`, `recon
    sfm`) it is checked against some of them, and can be pruned and scored; without, it can be
    viewed, rendered and exported. Without FILE, the previous file is used.
    """
    table = tuple(IMPORT if row.name == IMPORT.name else row for row in STAGES)
    run_stages(
        call, IMPORT.verb, [IMPORT.name], sources=() if file is None else (file,), table=table)
    if not call.print_config:
        say(f"next:    {command_line('view')} or {command_line('export --format html')}")


@verb("prune")
@options.stage(PruneConfig, renders=True)
@pass_call
def prune(call: Call) -> None:
    """Remove the least important Gaussians and fine-tune the rest."""
    run_stages(call, "prune", ["prune"])


@verb("eval")
@click.argument("items", metavar="[ITEM]...", nargs=-1, type=options.PathType())
@click.option(
    "--form", type=click.Choice(FORMS), default="text",
    help="With ITEM: format of the table.  [default: text]")
@click.option(
    "--caption", default="", metavar="TEX",
    help="With ITEM and --form latex: caption of the table.  [default: none]")
@click.option(
    "--label", default="", metavar="TEX",
    help="With ITEM and --form latex: label of the table.  [default: none]")
@click.option(
    "--explain", is_flag=True, help="Print below the table what each score means.  [default: off]")
@options.stage(EvaluateConfig, renders=True)
@pass_call
def evaluate(
    call: Call, items: tuple[Path, ...], form: str, caption: str, label: str, explain: bool,
) -> None:
    """Score every model on the held-out views.

    With ITEM, workspaces and splat files ({formats}): their models in one table. Files are scored
    on the views of the workspace.
    """
    if (caption or label) and (form != "latex" or not items):
        raise click.UsageError("--caption and --label need ITEM and --form latex.")
    if explain and form != "text":
        raise click.UsageError("--explain stands below a table of --form text.")
    if items:
        from recon_cli.commands.compare_scores import compare

        say(compare(
            lambda path: open_job_with(dataclasses.replace(call, workspace=path), EvaluateConfig),
            call.workspace, items, form, caption=caption, label=label))
    else:
        run_stages(call, "eval", ["evaluate"])
    if explain and not call.print_config:
        from recon_cli.evaluation.metrics import EXPLANATION  # imports torch

        say(EXPLANATION)


@verb("export")
@options.stage(ExportConfig, renders=True)
@pass_call
def export(call: Call) -> None:
    """Write a .ply and other formats that viewers open; verify each."""
    run_stages(call, "export", ["export"])


@verb("run")
@_inputs
@options.with_prune
@click.option(
    "--minutes", type=click.FloatRange(min=0.1), metavar="X",
    help="Time for the whole run; frames, steps and pruning are chosen for it.  "
         "[minutes; default: no limit]")
@options.config_options(IngestConfig, only=("frames",))
@options.config_options(TrainConfig, only=("quality", "compact_only"))
@options.config_options(ExportConfig, only=("format", "title"))
@click.option(
    "--open", "with_open", is_flag=True,
    help="Open the page of the scene in the browser at the end.  [default: off]")
@options.assignments()
@options.compute(trains=True)
@options.again
@options.print_config
@options.common()
@pass_call
def run(
    call: Call, inputs: tuple[Path, ...], with_prune: bool, minutes: float | None, with_open: bool
) -> None:
    """Run every stage from INPUT to a page that shows the scene.

    INPUT is as for `recon ingest`. Without it, the previous input is used. The results are the
    scene (.ply), a page to look around in it (.html), and a report.
    """
    given = merge([explicit_settings(call), call.settings])
    if given.get("train", {}).get("compact_only") and not with_prune:
        raise click.UsageError("--compact-only needs pruning: leave out --no-prune.")
    stages = [row.name for row in STAGES if with_prune or row.name != "prune"]
    if minutes is not None and not call.print_config:
        from recon_cli.commands.budget import run_within  # imports OpenCV

        run_within(call, minutes, inputs, _with_page(MID, call), with_prune=with_prune)
    else:
        run_stages(call, "run", stages, sources=inputs, base=_with_page(MID, call))
    if not call.print_config:
        end_run(open_job(call), open_page=with_open)


@verb("demo")
@options.assignments()
@options.compute(trains=True)
@options.again
@options.common(workspace="demo", envvar=None)
@pass_call
def demo(call: Call) -> None:
    """Run every stage on the bundled room video."""
    stages = [row.name for row in STAGES]
    run_stages(call, "demo", stages, sources=(SAMPLE,), base=_with_page(DEMO, call))
    end_run(open_job(call))


def _with_page(base: Settings, call: Call) -> Settings:
    """Returns settings with the page, which only who asks for formats by name gets for certain."""
    asked = any("format" in settings.get("export", {})
                for settings in (call.settings, explicit_settings(call)))
    return {**base, "export": {"format": "html", "skip_lossy": not asked}}
