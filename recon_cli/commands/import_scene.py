"""The verb `recon import`: the table of stages with an imported scene in the place of training."""

from __future__ import annotations

from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.options import Call, pass_call
from recon_cli.commands.shared import tell
from recon_cli.config import settings
from recon_cli.config.stages import ComputeConfig, ImportConfig
from recon_cli.pipeline import plan
from recon_cli.pipeline.plan import Job, Target
from recon_cli.progress import TqdmProgress
from recon_cli.stages import IMPORT, STAGES
from recon_cli.workspace.layout import Workspace


@click.command("import")
@click.argument("file", required=False, type=click.Path(path_type=Path))
@options.stage(ImportConfig, renders=True)
@pass_call
def import_scene(call: Call, file: Path | None) -> None:
    """Take the scene in FILE in place of a trained one.

    FILE is a .ply, .compressed.ply, .splat, .spz, .sog or .glb of whichever program. In a workspace
    with views (`recon ingest`, `recon sfm`) it is held against some of them, and can be pruned and
    scored; without, it can be looked at, rendered and exported. Without FILE, that of the last time
    is read again.
    """
    given = options.explicit(call)
    values = settings.merged([given, call.settings])
    config = settings.build(ImportConfig, values)
    compute = settings.build(ComputeConfig, values)
    if call.print_config:
        click.echo(settings.to_toml({"import": config, "compute": compute}), nl=False)
        return
    table = tuple(IMPORT if row.name == IMPORT.name else row for row in STAGES)
    job = Job(Workspace(call.workspace), given, compute, TqdmProgress(), tell, table)
    target = Target(IMPORT.name, config, () if file is None else (file,))
    plan.run(job, IMPORT.verb, [target], again=call.again)
