"""What the files of the package hold, read off their syntax trees; a process parses each once."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import TypeVar

PACKAGE = Path(__file__).resolve().parents[1] / "recon_cli"
FILES = sorted(PACKAGE.rglob("*.py"))

_KINDS = (ast.Import, ast.ImportFrom, ast.Attribute, ast.Call, ast.Raise)
_Node = TypeVar("_Node", ast.Import, ast.ImportFrom, ast.Attribute, ast.Call, ast.Raise)


@cache
def _nodes(path: Path) -> dict[type[ast.AST], list[ast.AST]]:
    found: dict[type[ast.AST], list[ast.AST]] = {kind: [] for kind in _KINDS}
    left: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    for node in left:  # which grows; `ast.walk` takes three times as long
        if type(node) in found:
            found[type(node)].append(node)
        for name in node._fields:
            value = getattr(node, name, None)
            if isinstance(value, ast.AST):
                left.append(value)
            elif isinstance(value, list):
                left += [each for each in value if isinstance(each, ast.AST)]
    return found


def nodes(path: Path, kind: type[_Node]) -> Iterator[_Node]:
    """Yields all nodes of a kind in a file."""
    for node in _nodes(path)[kind]:
        assert isinstance(node, kind)
        yield node


def dotted(node: ast.expr) -> str:
    """Returns an expression as text; far faster than `ast.unparse` where it is a dotted name."""
    names: list[str] = []
    at = node
    while isinstance(at, ast.Attribute):
        names.append(at.attr)
        at = at.value
    return ".".join([at.id, *reversed(names)]) if isinstance(at, ast.Name) else ast.unparse(node)
