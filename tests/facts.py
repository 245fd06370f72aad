"""Checks the facts of a message, whatever its wording: numbers, names, the command in a hint."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

import pytest

from recon_cli.errors import ReconError

Kind = TypeVar("Kind", bound=Exception)


def assert_facts(text: str, *facts: object) -> None:
    """Fails unless one line of the text holds every fact, each as a whole word or number."""
    patterns = [re.compile(rf"(?<![\w.-]){re.escape(str(fact))}(?!\w|\.\d)") for fact in facts]
    lines = text.splitlines()
    if not any(all(pattern.search(line) for pattern in patterns) for line in lines):
        missing = [fact for fact, pattern in zip(facts, patterns, strict=True)
                   if not pattern.search(text)]
        raise AssertionError(f"no line holds all of {facts} (missing: {missing}) in:\n{text}")


@contextmanager
def raises(
    kind: type[Kind] | tuple[type[Kind], ...], *facts: object
) -> Iterator[pytest.ExceptionInfo[Kind]]:
    """Expects an error whose message names every fact; a ReconError says what to type next, too."""
    with pytest.raises(kind) as caught:
        yield caught
    if isinstance(caught.value, ReconError):
        assert caught.value.hint
    assert_facts(str(caught.value), *facts)
