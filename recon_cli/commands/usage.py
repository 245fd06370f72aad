"""Hints for a wrong command line: what to type instead."""

from __future__ import annotations

import dataclasses
import os
import shlex
from collections.abc import Sequence
from pathlib import Path

import click

from recon_cli.config.settings import GONE, SECTIONS, SUCCESSORS
from recon_cli.errors import name_command
from recon_cli.workspace.export_formats import READABLE
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.paths import is_address

_NAMED = 3  # words of a command line that are repeated


class HintedUsageError(click.UsageError):
    """A wrong command line, with what to type instead."""

    def __init__(self, message: str, *, hint: str, ctx: click.Context | None = None) -> None:
        super().__init__(message, ctx)
        self.hint = hint


def usage_hint(error: click.ClickException) -> str:
    """Returns what to type instead, or which --help explains the verb; empty where none was."""
    if isinstance(error, HintedUsageError):
        return error.hint
    if isinstance(error, click.NoSuchOption):
        found = _gone(error) or _setting(error)
        if found:
            return found
    ctx = error.ctx if isinstance(error, click.UsageError) else None
    return f"See `{ctx.command_path} --help`." if ctx else ""


def _gone(error: click.NoSuchOption) -> str:
    """Returns what to do about an option that earlier versions had; empty for any other."""
    name = error.option_name.lstrip("-").replace("-", "_")
    section = next((each for each, fields in GONE.items() if name in fields), None)
    if section is None:
        return ""
    instead = SUCCESSORS.get((section, name), "Leave it out.")
    return f"recon no longer has {error.option_name}. {instead}"


def _setting(error: click.NoSuchOption) -> str:
    """Returns how an option of a stage is set in a verb that runs many; empty where it has none."""
    if error.ctx is None or not any(
            parameter.name == "assigned" for parameter in error.ctx.command.params):
        return ""
    name = error.option_name.lstrip("-").replace("-", "_")
    sections = [section for section, config in SECTIONS.items()
                if name in {item.name for item in dataclasses.fields(config)}]
    if not sections:
        return ""
    ways = " or ".join(f"--set {section}.{name}=VALUE" for section in sections)
    return f"{error.ctx.command_path} sets it by {ways}."


def suggest_command(command: str, words: Sequence[str]) -> str:
    """Returns what to type for words that a command does not take, such as a video.

    `command` is `recon VERB`, or empty where the first of the words stands in place of the verb.
    """
    first = Path(words[0])
    typed = shlex.join(words) if len(words) <= _NAMED else shlex.quote(str(first.parent))
    if Workspace(first).holds_results:
        return f"Type `{command or 'recon view'} -w {typed}`."
    again = name_command(command.removeprefix("recon "))
    if is_address(words[0]):
        return f"Download it, then type {name_command(f'run {shlex.quote(first.name)}')}."
    if any(row.fits_name(first.name) for row in READABLE):
        after = f", then {again}" if command else ""
        return (f"Type {name_command(f'import {typed}')}{after}; `recon view {typed}` shows it "
                "without a workspace.")
    if first.suffix or os.path.lexists(first):
        steps = f", or {name_command(f'ingest {typed}')} and then {again}" if command else ""
        return f"To reconstruct it, type {name_command(f'run {typed}')}{steps}."
    return f"See `{command} --help`."
