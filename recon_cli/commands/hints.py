"""Commands in messages, completed by the workspace, so that they act where the user works."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable
from pathlib import Path

_COMMAND = re.compile(r"`recon ([a-z-]+)([^`]*)`")
_WORKSPACE = re.compile(r"\s(-w|--workspace)(\s|=)")


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


def _is_same(one: Path, other: Path) -> bool:
    return os.path.abspath(one) == os.path.abspath(other)
