"""The verb `recon import`: the table of stages with import in the place of training."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.jobs import report_outcome
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig, ImportConfig
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job, Target
from recon_cli.progress import TqdmProgress
from recon_cli.stages import IMPORT, STAGES
from recon_cli.workspace.layout import Workspace


@verb("import")
@click.argument("file", required=False, type=click.Path(path_type=Path))
@options.stage(ImportConfig, renders=True)
@pass_call
def import_scene(call: Call, file: Path | None) -> None:
    """Import a splat file instead of training.

    FILE is a .ply, .compressed.ply, .splat, .spz, .sog or .glb of any program. In a workspace with
    views (`recon ingest`, `recon sfm`) it is checked against some of them, and can be pruned and
    scored; without, it can be viewed, rendered and exported. Without FILE, the previous file is
    used.
    """
    given = options.explicit_settings(call)
    values = settings.merge([given, call.settings])
    config = settings.build(ImportConfig, values)
    compute = settings.build(ComputeConfig, values)
    if call.print_config:
        click.echo(settings.to_toml({"import": config, "compute": compute}), nl=False)
        return
    table = tuple(IMPORT if row.name == IMPORT.name else row for row in STAGES)
    job = Job(Workspace(call.workspace), given, compute, TqdmProgress(), report_outcome, table)
    target = Target(IMPORT.name, config, () if file is None else (file,))
    plan.run(job, IMPORT.verb, [target], again=call.again)
