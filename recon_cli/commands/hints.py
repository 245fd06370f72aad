"""Commands in messages: completed, so that they act where the user works, or suggested."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from recon_cli.workspace.export_formats import READABLE
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.paths import is_address

_COMMAND = re.compile(r"`recon ([a-z-]+)([^`]*)`")
_WORKSPACE = re.compile(r"\s(-w|--workspace)(\s|=)")
_INPUT = re.compile(r"\brecon ingest (?=[^-`\s])")
_NAMED = 3  # words of a command line that are repeated


def name_workspace(
    text: str, workspace: Path, default_of: Callable[[str], str | None]
) -> str:
    """Returns a message whose commands in backticks name the workspace where they need to.

    `default_of` returns the workspace that a verb takes where none is typed, None for a verb that
    has none. A command that names a workspace stays as it is.
    """
    def complete(match: re.Match[str]) -> str:
        verb, words = match.groups()
        default = None if _WORKSPACE.search(words + " ") else default_of(verb)
        if default is None or _is_same(Path(default), workspace):
            return match[0]
        return f"`recon {verb}{words} -w {shlex.quote(str(workspace))}`"

    return _COMMAND.sub(complete, text)


def name_verb(text: str, verb: str) -> str:
    """Returns a message in which who types `recon run` is told to run, not to ingest, an input."""
    return _INPUT.sub("recon run ", text) if verb == "run" else text


def suggest_command(command: str, words: Sequence[str]) -> str:
    """Returns what to type for words that a command does not take, such as a video.

    `command` is `recon VERB`, or empty where the first of the words stands in place of the verb.
    """
    first = Path(words[0])
    typed = shlex.join(words) if len(words) <= _NAMED else shlex.quote(str(first.parent))
    if Workspace(first).holds_results:
        return f"Type `{command or 'recon view'} -w {typed}`."
    if is_address(words[0]):
        return f"Download it, then type `recon run {shlex.quote(first.name)}`."
    if any(row.fits_name(first.name) for row in READABLE):
        after = f", then `{command}`" if command else ""
        return (f"Type `recon import {typed}`{after}; `recon view {typed}` shows it without a "
                "workspace.")
    if first.suffix or os.path.lexists(first):
        steps = f", or `recon ingest {typed}` and then `{command}`" if command else ""
        return f"To reconstruct it, type `recon run {typed}`{steps}."
    return f"See `{command} --help`."


def _is_same(one: Path, other: Path) -> bool:
    return os.path.abspath(one) == os.path.abspath(other)
