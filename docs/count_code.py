"""Counts the code of the package: `python docs/count_code.py [FOLDER]`, a row a folder.

A line of code holds a token that is no comment and no docstring; lines are all of the file. A named
numeric constant is a number, a sum of numbers or a tuple of them under an upper-case name at the
top level of a module. Of functions the lines are all from `def` to the end. The last line is the
longest path of imports that loading a module takes: late ones, those for type checkers alone and
the `__init__.py` of folders on the way do not count.
"""

from __future__ import annotations

import ast
import io
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "recon_cli"
COLUMNS = ("files", "lines", "code", "constants", "functions", "mean", "over 50")
LONG = 50  # lines of a function
_LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
           tokenize.ENCODING, tokenize.ENDMARKER}


def count_code_lines(text: str) -> int:
    """Returns the lines of a module that are not blank, a comment or a docstring."""
    lines = {line for token in tokenize.generate_tokens(io.StringIO(text).readline)
             if token.type not in _LAYOUT for line in range(token.start[0], token.end[0] + 1)}
    return len(lines - set(_docstring_lines(ast.parse(text))))


def _docstring_lines(tree: ast.Module) -> Iterator[int]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if node.body else None
            if (isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
                    and isinstance(first.value.value, str)):
                yield from range(first.lineno, (first.end_lineno or first.lineno) + 1)


def count_constants(tree: ast.Module) -> int:
    """Returns how many names of a module hold a number."""
    return sum(
        len(names) for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign)
        and node.value is not None and (names := _upper_names(node)) and _is_numeric(node.value))


def _upper_names(node: ast.Assign | ast.AnnAssign) -> list[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return [name.id for target in targets for name in ast.walk(target)
            if isinstance(name, ast.Name) and name.id.strip("_").isupper()]


def _is_numeric(node: ast.expr) -> bool:
    """Returns whether an expression is a number, of numbers, or a sequence of nothing else."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return _is_numeric(node.operand)
    if isinstance(node, ast.BinOp):
        return _is_numeric(node.left) and _is_numeric(node.right)
    return isinstance(node, ast.Tuple | ast.List) and bool(node.elts) and all(
        map(_is_numeric, node.elts))


def count_file(path: Path) -> Counter[str]:
    """Returns the counts of a module; `mean` is a sum until a row is printed."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text)
    lengths = [(node.end_lineno or 0) - node.lineno + 1 for node in ast.walk(tree)
               if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    return Counter({
        "files": 1, "lines": len(text.splitlines()), "code": count_code_lines(text),
        "constants": count_constants(tree), "functions": len(lengths), "mean": sum(lengths),
        "over 50": sum(length > LONG for length in lengths)})


def _loaded_imports(body: list[ast.stmt]) -> Iterator[str]:
    """Yields the dotted names that a module imports as it is loaded."""
    for node in body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            yield from _loaded_imports(node.orelse)
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            inner = (getattr(node, name, []) for name in ("body", "orelse", "finalbody"))
            yield from _loaded_imports([each for part in inner for each in part])
            yield from _loaded_imports([
                each for handler in getattr(node, "handlers", []) for each in handler.body])


def longest_import_path(root: Path) -> list[str]:
    """Returns the modules of the longest path of imports; RecursionError for a circle."""
    names = {".".join((root.name, *path.relative_to(root).with_suffix("").parts)).removesuffix(
        ".__init__"): path for path in root.rglob("*.py")}

    def find_module(name: str) -> str:
        while name and name not in names:
            name = name.rpartition(".")[0]
        return name

    @cache
    def longest_from(module: str) -> list[str]:
        tree = ast.parse(names[module].read_text(encoding="utf-8"))
        below = {find_module(name) for name in _loaded_imports(tree.body)} - {"", module}
        return [module, *max(map(longest_from, sorted(below)), key=len, default=[])]

    return max(map(longest_from, sorted(names)), key=len)


def _row(name: str, counts: Counter[str]) -> str:
    mean = counts["mean"] / max(1, counts["functions"])
    values = [f"{mean:.1f}" if key == "mean" else f"{counts[key]:,}" for key in COLUMNS]
    return f"{name:<16}" + "".join(f"{value:>11}" for value in values)


def main() -> None:
    """Prints the counts of the folders of the package, or of another tree."""
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else PACKAGE
    folders: dict[str, Counter[str]] = {}
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).parts
        folders.setdefault(parts[0] if len(parts) > 1 else ".", Counter()).update(count_file(path))
    rows = [f"{'':<16}" + "".join(f"{key:>11}" for key in COLUMNS)]
    rows += [_row(name, counts) for name, counts in folders.items()]
    rows.append(_row("all", sum(folders.values(), Counter())))
    longest = [name.partition(".")[2] for name in longest_import_path(root)]
    rows.append(f"longest import path: {len(longest)} modules, {' > '.join(longest)}")
    sys.stdout.write("\n".join(rows) + "\n")


if __name__ == "__main__":
    main()
