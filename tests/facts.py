"""Checks the facts of a message, whatever its wording: numbers, names, the command in a hint."""

from __future__ import annotations

import re


def assert_facts(text: str, *facts: object) -> None:
    """Fails unless one line of the text holds every fact, each as a whole word or number."""
    patterns = [re.compile(rf"(?<![\w.-]){re.escape(str(fact))}(?!\w|\.\d)") for fact in facts]
    lines = text.splitlines()
    if not any(all(pattern.search(line) for pattern in patterns) for line in lines):
        missing = [fact for fact, pattern in zip(facts, patterns, strict=True)
                   if not pattern.search(text)]
        raise AssertionError(f"no line holds all of {facts} (missing: {missing}) in:\n{text}")
