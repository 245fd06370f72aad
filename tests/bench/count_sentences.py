"""Counts what tests assert about wording: `match=`, and literals of two words or more in asserts.

    python tests/bench/count_sentences.py [-v]

Not counted, as they are facts: commands (`recon ...`, --option), markup, keys of tables, and
arguments of calls other than those of strings. Some of what is counted is no message of recon:
texts that a test made itself, headings of tables, file names with spaces.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

WORDS = re.compile(r"[A-Za-z]{2,}[,:;]?(?: \S+)*? [a-z]{2,}")
FACT = re.compile(r"^[\s`]*(?:recon [a-z]|--|<|/)|=\"")
OF_TEXT = ("startswith", "endswith", "count", "assert_facts", "raises", "search", "match", "any",
           "all", "sum", "set", "bool")


def is_prose(node: ast.expr) -> bool:
    if isinstance(node, ast.JoinedStr):
        text = "".join(str(part.value) if isinstance(part, ast.Constant) else "X"
                       for part in node.values)
    elif isinstance(node, ast.Constant) and isinstance(node.value, str):
        text = node.value
    else:
        return False
    return bool(WORDS.search(text)) and not FACT.search(text)


def literals(node: ast.AST) -> Iterator[ast.expr]:
    """Yields what is compared, at any depth, but no keys."""
    if isinstance(node, (ast.Constant, ast.JoinedStr)):
        yield node
    elif isinstance(node, ast.Dict):
        for value in node.values:
            yield from literals(value)
    elif isinstance(node, ast.Call):
        if getattr(node.func, "attr", getattr(node.func, "id", "")) in OF_TEXT:
            for argument in node.args:
                yield from literals(argument)
    elif not isinstance(node, (ast.Subscript, ast.Attribute)):
        for child in ast.iter_child_nodes(node):
            yield from literals(child)


def kind_of(node: ast.AST) -> str:
    if isinstance(node, ast.Assert):
        return "assert" if any(map(is_prose, literals(node.test))) else ""
    if isinstance(node, ast.Call):
        if any(keyword.arg == "match" for keyword in node.keywords):
            return "match"
        name = getattr(node.func, "id", "")
        return "facts" if name in ("assert_facts", "raises") and any(
            map(is_prose, node.args)) else ""
    return ""


def main() -> None:
    found: Counter[str] = Counter()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        if path.parent == Path(__file__).parent:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if kind := kind_of(node):
                found[kind] += 1
                if "-v" in sys.argv:
                    sys.stdout.write(
                        f"{path}:{node.lineno}: {kind}: {ast.unparse(node)[:200]}\n")
    sys.stdout.write(f"{dict(found)} {found.total()}\n")


if __name__ == "__main__":
    main()
