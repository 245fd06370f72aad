"""The verb `recon view`, and the page that shows a training while it runs."""

from __future__ import annotations

import logging
import os
import sys
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click

from recon_cli.commands import options
from recon_cli.commands.console import say
from recon_cli.commands.jobs import open_job
from recon_cli.commands.options import Call, pass_call, verb
from recon_cli.commands.usage import suggest_command
from recon_cli.context import TrainCallback
from recon_cli.errors import ExitCode, InputError, StageError, name_command
from recon_cli.signals import exit_code
from recon_cli.workspace.layout import Workspace

_SCENES = ("ingest", "train")  # one of them is there once anything was done

logger = logging.getLogger("recon")


@verb("view")
@click.argument("item", metavar="[ITEM]", required=False, type=options.PathType())
@click.option(
    "--model", type=click.Choice(["auto", "base", "pruned"]), default="auto", show_default=True,
    help="Model to show first; auto: the compact one (pruned) if it is fresh, else the "
         "original (base).")
@click.option(
    "--host", default="127.0.0.1", metavar="ADDRESS", show_default=True,
    help="Address to listen on; 0.0.0.0 accepts every machine that reaches this one.")
@click.option(
    "--port", type=click.IntRange(1, 65535), metavar="N",
    help="Port to listen on.  [default: 8080, or the next free one]")
@click.option(
    "--open/--no-open", "opening", cls=options.Option, default=None,
    help="Open the page in the browser.  [default: on in a terminal with a desktop]")
@options.compute()
@options.common()
@pass_call
def view(
    call: Call, item: Path | None, model: str, host: str, port: int | None, opening: bool | None
) -> None:
    """View the trained scene in the browser.

    ITEM is a workspace (instead of -w) or a splat file ({formats}). Ctrl-C ends
    it.
    """
    workspace = _workspace(call, item)
    if item is not None and workspace is None and model != "auto":
        raise click.UsageError("--model has no effect on a file.")
    logger.info("opening %s", item if workspace is None else f"the scene of {workspace}")
    from recon_cli.viewer.content import PhotoPairs, load_file, load_workspace
    from recon_cli.viewer.server import serve_scene
    from recon_cli.viewer.trust_tint import TrustTint

    trust = None
    if workspace is None:
        assert item is not None, "the workspace of the call is one"
        content, photos = load_file(item), None
    else:
        call.workspace = workspace
        job = open_job(call)
        content = load_workspace(job, model)
        photos = PhotoPairs(job, content.max_size)
        # an import without views has no trust
        trust = TrustTint(job) if content.views else None
    try:
        with serve_scene(content, photos, host, port, trust) as (_, address):
            say(f"The scene is at {address} (Ctrl-C ends it)")
            if _at_a_desktop() if opening is None else opening:
                webbrowser.open(address)
            wait()
    except KeyboardInterrupt as error:
        if exit_code(error) != ExitCode.INTERRUPTED:
            raise
        click.echo("closed", err=True)  # by Ctrl-C, which is how a viewer is meant to end


@contextmanager
def show_training(call: Call) -> Iterator[TrainCallback]:
    """Yields a callback that shows a training in the browser, on this machine alone."""
    from recon_cli.viewer.live import LiveView
    from recon_cli.viewer.server import HOST, start_server

    with start_server(HOST, None, label="recon train") as (server, address):
        live = LiveView(server, Workspace(call.workspace))
        say(f"The training can be watched at {address}")
        try:
            yield live
        finally:
            live.close()
    click.echo(f"The page is closed; {name_command('view')} shows the finished scene.", err=True)


def _workspace(call: Call, item: Path | None) -> Path | None:
    """Returns the workspace to show; None where ITEM is a file."""
    if item is None:
        if not any(path.is_dir() for path in map(Workspace(call.workspace).folder, _SCENES)):
            raise StageError(
                f"There is no scene to view in {call.workspace.absolute()}.",
                hint=f"Make one by {name_command('run VIDEO')}, name another workspace with -w, or "
                "give a splat file: `recon view FILE`.")
        return call.workspace
    source = click.get_current_context().get_parameter_source("workspace")
    if source == click.core.ParameterSource.COMMANDLINE:
        raise click.UsageError("ITEM and -w exclude each other.")
    if not item.exists():
        raise InputError(f"{item} does not exist.", hint="Check the path.")
    if not item.is_dir():
        return None
    if not Workspace(item).holds_results:
        raise InputError(
            f"{item} is neither a workspace nor a splat file.",
            hint=suggest_command("", [str(item)]))
    return item


def _at_a_desktop() -> bool:
    """Returns whether a browser would open in a window and not inside this terminal."""
    desktop = sys.platform in ("darwin", "win32") or bool(
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return sys.stdout.isatty() and desktop


def wait() -> None:
    """Waits for Ctrl-C."""
    while True:
        time.sleep(3600)
