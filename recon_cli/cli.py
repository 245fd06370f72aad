"""The group of commands, each loaded when typed. main() is the only place that catches all."""

from __future__ import annotations

import importlib
import logging
import os
import sys
import time
from collections import UserDict
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from recon_cli import __version__, machine, signals
from recon_cli.commands import console, usage
from recon_cli.commands.console import Failure, Log
from recon_cli.commands.options import Call, complete, used_variables
from recon_cli.errors import (
    IN_USE,
    WITHOUT_WORKSPACE,
    ExitCode,
    ReconError,
    WorkspaceError,
    use_workspace,
)
from recon_cli.workspace import disk
from recon_cli.workspace.paths import is_address

MAX_WIDTH = 100  # columns of a help text on a wide terminal

# Each verb: where its command lives in recon_cli.commands, and the first line of its docstring.
VERBS = {
    "ingest": ("stages.ingest", "Choose frames from videos, photos or a capture with poses."),
    "denoise": ("stages.denoise", "Filter noisy frames and pass the others through."),
    "sfm": ("stages.sfm", "Estimate cameras and a sparse point cloud."),
    "train": ("stages.train", "Fit Gaussians; denoise and sfm run first where needed."),
    "import": ("stages.import_scene", "Import a splat file instead of training."),
    "prune": ("stages.prune", "Remove the least important Gaussians and fine-tune the rest."),
    "eval": ("stages.evaluate", "Score every model on the held-out views."),
    "export": ("stages.export", "Write a .ply and other formats that viewers open; verify each."),
    "render": ("render.render", "Render the trained model along a path, or at given views."),
    "view": ("view.view", "View the trained scene in the browser."),
    "report": ("workspace.report", "Write an HTML report: capture, scores, views, settings."),
    "convert": (
        "convert.convert", "Convert, merge and reduce splat files, without a workspace."),
    "info": ("convert.info", "Describe splat files: what they hold, and what is wrong with them."),
    "run": ("stages.run", "Run every stage from INPUT to a page that shows the scene."),
    "batch": ("batch.batch", "Reconstruct many captures, each in a workspace of its own."),
    "demo": ("stages.demo", "Run every stage on the bundled room video."),
    "status": ("workspace.status", "Show which stages are fresh, stale and why, or missing."),
    "clean": ("workspace.clean", "Free disk space."),
    "setup": ("setup.setup", "Get the learned features that match photos taken far apart."),
    "doctor": ("doctor.doctor", "Show versions, rasterizers, memory and disk."),
    "bench": ("bench.bench", "Measure the rasterizers: speed and error."),
    "study": ("bench.study", "Repeat the paper's experiment: 3DGS against ours."),
}

# Verbs that load no library of numbers, so that they work in whatever memory there is
_LIGHT = ("status", "clean")
# Verbs that recon types itself
HIDDEN = {"map-segment": "workers.map_segment", "train-block": "workers.train_block"}

logger = logging.getLogger("recon")


class _PastClick(Exception):  # noqa: N818  # never seen by anybody
    """Carries past click an error that it would handle."""


class _LazyCommands(UserDict[str, Any]):
    """The commands by verb; a module is imported when its verb is looked up."""

    def __getitem__(self, verb: str) -> click.Command:
        module, _, name = (HIDDEN.get(verb) or VERBS[verb][0]).partition(".")
        command: click.Command = getattr(
            importlib.import_module(f"recon_cli.commands.{module}"), name)
        return command if verb in HIDDEN else complete(command, verb)


class _LazyGroup(click.Group):
    """Lists the verbs in the order of the work, and imports only the one that was typed."""

    def invoke(self, ctx: click.Context) -> Any:
        """Runs the verb; click itself would print an empty line, or end the process."""
        try:
            return super().invoke(ctx)
        except (KeyboardInterrupt, OSError) as error:
            raise _PastClick from error

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Returns the verb that was typed; where it is a capture, the error says what to type.

        WorkspaceError without a current folder, ReconstructionError without memory for libraries.
        """
        if not ctx.resilient_parsing and not {"-h", "--help", "--help-all"}.intersection(args):
            _refuse_lost_folder()
            if args[0] not in _LIGHT:
                machine.refuse_low_limit()
        try:
            return super().resolve_command(ctx, args)
        except click.UsageError as error:
            if not (Path(args[0]).suffix or os.path.lexists(args[0]) or is_address(args[0])):
                raise
            raise usage.HintedUsageError(
                f"{args[0]} is not a command.", hint=usage.suggest_command("", args)) from error

    def list_commands(self, _ctx: click.Context) -> list[str]:
        """Returns the verbs."""
        return list(VERBS)

    def format_commands(self, _ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Writes the verbs with their short help."""
        with formatter.section("Commands"):
            formatter.write_dl([(verb, text) for verb, (_, text) in VERBS.items()])


@click.group(
    cls=_LazyGroup, commands=_LazyCommands(dict.fromkeys((*VERBS, *HIDDEN))),
    context_settings={
        "max_content_width": MAX_WIDTH, "help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="recon")
def cli() -> None:
    """Turn a video or photos of a room into a 3D Gaussian Splatting scene."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command line and returns its exit code."""
    words, begin = list(sys.argv[1:] if arguments is None else arguments), time.monotonic()
    call = Call()
    if _verb(words):  # a command that recon types itself inherits what was typed
        use_workspace(_verb(words), None)
    with console.show_log(call) as log:
        failure, code, ended = None, int(ExitCode.DONE), None
        error: BaseException | None = None
        try:
            with signals.raising():
                ended = cli.main(words, prog_name="recon", standalone_mode=False, obj=call)
                code = ended if isinstance(ended, int) else code
        except (Exception, KeyboardInterrupt) as raised:
            error = (raised.__cause__ if isinstance(raised, _PastClick) else None) or raised
            code = _exit_code(error)
            with suppress(OSError):  # of a stderr that nobody reads, or on the disk that is full
                failure = _tell(error, log, _verb(words))
        # click returns the code 0 of --help, and nothing from a verb
        if (call.as_object and ended is None) or (failure and _asks_for_object(error, words)):
            known = call.as_object and _verb(words) not in ("", *WITHOUT_WORKSPACE)
            code = _print_object(console.result_object(
                _verb(words), str(call.workspace.absolute()) if known else None, log, call.output,
                time.monotonic() - begin, failure), code)
        console.drop_output()
        os.environ.pop(IN_USE, None)
        return code


def _verb(words: Sequence[str]) -> str:
    """Returns the verb that was typed; empty where none was."""
    return next((word for word in words if word in VERBS), "")


def _asks_for_object(error: BaseException | None, words: Sequence[str]) -> bool:
    """Returns whether a command line that could not be parsed asks for --json's object."""
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    return ctx is not None and "--json" in words and any(
        option.name == "as_object" for option in ctx.command.params)


def _print_object(text: str, code: int) -> int:
    """Prints the object of --json and returns the exit code."""
    try:
        click.echo(text)
    except BrokenPipeError:
        return ExitCode.BROKEN_PIPE
    except WorkspaceError as error:
        click.echo(Failure(error.message, error.hint, code).text(), err=True)
        return code or error.exit_code
    return code


def _tell(error: BaseException, log: Log, verb: str) -> Failure | None:
    """Prints why a command failed and returns it; None where nobody reads."""
    code = _exit_code(error)
    if isinstance(error, click.exceptions.NoArgsIsHelpError):
        error.show()
        return None
    if isinstance(error, BrokenPipeError):
        return None
    if isinstance(error, (click.Abort, KeyboardInterrupt)):
        failure = Failure(signals.describe_end(_signalled(error)), "", code)
        log.fail(failure, prefix="")
        return failure
    if isinstance(error, click.ClickException):
        message, hint = error.format_message(), usage.usage_hint(error)
    else:
        logger.debug("failed", exc_info=error)
        known = _known(error)
        message, hint = (known.message, known.hint) if known else (
            f"{type(error).__name__}: {error}",
            "This is a bug in recon. Run the command again with -v and report its output.")
    if code == ExitCode.USAGE:
        hint = f"{hint} {_name_variables(error, verb)}".strip()
    failure = Failure(message, hint, code)
    log.fail(failure)
    return failure


def _name_variables(error: BaseException, verb: str) -> str:
    """Returns a sentence with the environment variables that a wrong value may be of."""
    option = error.param if isinstance(error, click.BadParameter) else None
    names = used_variables(cli.commands[verb]) if verb else []
    if option is not None:
        names = [name for name in names if name == option.envvar]
    return f"Set in the environment: {', '.join(names)}." if names else ""


def _exit_code(error: BaseException) -> int:
    if isinstance(error, (click.Abort, KeyboardInterrupt)):
        return signals.exit_code(_signalled(error))
    if isinstance(error, click.ClickException):
        return error.exit_code
    if isinstance(error, BrokenPipeError):  # `recon status | head -1`
        return ExitCode.BROKEN_PIPE
    known = _known(error)
    return ExitCode.BUG if known is None else known.exit_code


def _known(error: BaseException) -> ReconError | None:
    """Returns an error that a user can act on; None for a bug."""
    if isinstance(error, ReconError):
        return error
    try:
        here = Path.cwd()
    except FileNotFoundError:  # it went away while the command ran
        here = Path(os.sep)
    return (machine.explain_memory(error) or disk.explain(error, here, "writing")
            or disk.explain_outside(error))


def _refuse_lost_folder() -> None:
    """Raises WorkspaceError where the current folder was deleted, or its disk taken out."""
    try:
        os.getcwd()
    except OSError as error:
        raise WorkspaceError(
            f"The current folder is gone: {error.strerror}.",
            hint="Go to a folder that exists, for example by `cd`, and type the command again."
        ) from error


def _signalled(error: BaseException) -> BaseException | None:
    """Returns the exception that interrupted a command; click passes it on as an Abort."""
    return error.__cause__ if isinstance(error, click.Abort) else error
