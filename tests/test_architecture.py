"""Who may import whom, read off the syntax trees: nothing imports upward."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from recon_cli.stages import STAGES

PACKAGE = Path(__file__).resolve().parents[1] / "recon_cli"
FILES = sorted(PACKAGE.rglob("*.py"))
MAX_LINES = 320  # a file that outgrows 300 lines holds two ideas

# Each part of the package (a module or folder at its top) and the parts that it may import.
BOTTOM = {"errors", "atomic"}
OPTIONS = {"errors", "fields", "config"}
RECORDS = {"digests", "manifest", "workspace"}
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    "progress": {"errors"},
    "tables": set(),
    "metrics": {"errors", "tables"},
    "machine": {"errors"},
    "console": {"errors"},
    "fields": {"errors"},
    "atomic": {"errors"},
    "measure_option": {"errors"},
    "holdout_option": {"errors"},
    "transform_option": BOTTOM,
    "export_config": {"errors", "fields", "measure_option", "transform_option"},
    "config": {"errors", "fields", "measure_option", "holdout_option", "export_config"},
    "settings": OPTIONS,
    "digests": BOTTOM,
    "manifest": BOTTOM | {"digests"},
    "lock": BOTTOM,
    "workspace": BOTTOM | {"digests", "manifest", "lock"},
    "scene": set(),
    "render": {"errors", "scene"},
    "io": BOTTOM | {"scene"},
    "capture": BOTTOM | OPTIONS | {"progress", "io", "scene"},
    "mapping": BOTTOM | OPTIONS | {"progress", "io", "scene"},
    "train": BOTTOM | OPTIONS | {"progress", "scene", "render"},
    "watching": {"scene"},
    "stages": BOTTOM | OPTIONS | {
        "watching", "digests", "holdout_option", "progress", "metrics", "machine", "capture",
        "mapping", "scene", "io", "train", "render"},
    "launch": {"errors", "train"},
    "freshness": OPTIONS | RECORDS | {"settings", "stages"},
    "execute": OPTIONS | RECORDS | {
        "watching",
        "settings", "stages", "freshness", "machine", "progress", "render", "train"},
    "pipeline": OPTIONS | RECORDS | {"settings", "stages", "freshness", "execute"},
    "cleaning": RECORDS | {"errors", "execute"},
    "comparing": OPTIONS | BOTTOM | {"tables", "capture", "execute", "pipeline", "workspace"},
    "sweep": OPTIONS | BOTTOM | {
        "metrics", "tables", "scene", "render", "train", "stages", "execute", "pipeline",
        "workspace", "progress"},
    "doctor": {"errors", "machine", "render"},
    "report": {"doctor", "pipeline"},
    "options": OPTIONS | {"settings", "train"},
    "bench": BOTTOM | OPTIONS | {
        "settings", "options", "machine", "progress", "metrics", "tables", "scene", "render",
        "train", "io",
        "stages", "digests", "workspace", "execute", "pipeline"},
    "scoreboard": BOTTOM | OPTIONS | {
        "settings", "metrics", "tables", "scene", "io", "train", "stages", "workspace", "execute",
        "pipeline"},
    "study": BOTTOM | OPTIONS | {
        "settings", "options", "progress", "metrics", "lock", "digests", "workspace", "stages",
        "execute", "bench"},
    "verbs": OPTIONS | {
        "watching",
        "settings", "options", "pipeline", "report", "progress", "stages", "workspace"},
    "shots": BOTTOM | {
        "config", "settings", "options", "machine", "progress", "digests", "manifest", "lock",
        "workspace", "scene", "render", "io", "stages", "freshness", "execute", "pipeline"},
    "page": BOTTOM | OPTIONS | {
        "settings", "options", "machine", "progress", "tables", "digests", "manifest", "workspace",
        "scene", "capture", "io", "stages", "freshness", "execute", "pipeline", "report"},
    "importing": OPTIONS | {
        "settings", "options", "pipeline", "progress", "stages", "verbs", "workspace"},
    "viewer": BOTTOM | {
        "config", "settings", "options", "progress", "watching", "workspace", "metrics", "scene",
        "render", "io", "stages", "execute", "pipeline", "shots"},
    "cli": OPTIONS | {
        "verbs", "scoreboard", "page", "importing", "viewer", "launch",
        "settings", "options", "pipeline", "cleaning", "comparing", "report", "doctor", "console",
        "progress", "stages", "workspace", "bench", "study", "sweep", "shots"},
    "__main__": {"cli"},
}
AT_HOME = {  # packages that only some parts may import
    "click": {"cli", "verbs", "options", "bench", "study", "shots", "page", "console",
              "importing", "viewer"},
    "zstandard": {"io"},
    "jinja2": {"page"},
    "markupsafe": {"page"},
    "viser": {"viewer"},
    "matplotlib": {"bench", "study", "sweep"},
    "numba": {"render"},
    "llvmlite": {"render"},
    "tqdm": {"progress"},
    "triton": {"render"},
    "pycolmap": {"mapping", "io"},
}


def part(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(path: Path) -> Iterator[str]:
    """Yields the dotted name of every import of a file, wherever in the file it stands."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            assert node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def inside(path: Path) -> Iterator[tuple[str, ...]]:
    """Yields every import from the package itself, as names below it."""
    for name in imports(path):
        first, *rest = name.split(".")
        if first == "recon_cli" and rest and rest[0] != "__version__":
            yield tuple(rest)


def outside(path: Path) -> set[str]:
    """Returns the third-party packages that a file imports."""
    first = {name.split(".")[0] for name in imports(path)}
    return first - {"recon_cli"} - set(sys.stdlib_module_names)


def ids(path: Path) -> str:
    return str(path.relative_to(PACKAGE))


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_a_file_imports_only_what_lies_below_it(path: Path) -> None:
    if path == PACKAGE / "__init__.py":
        assert list(inside(path)) == []
        return
    own = part(path)
    assert {names[0] for names in inside(path)} - {own} <= ALLOWED[own]


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_a_package_that_has_a_home_is_imported_nowhere_else(path: Path) -> None:
    for package in outside(path) & AT_HOME.keys():
        assert part(path) in AT_HOME[package], f"{package} belongs to {AT_HOME[package]}"


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_one_module_knows_how_processes_are_connected(path: Path) -> None:
    if path != PACKAGE / "train" / "processes.py":
        assert not [name for name in imports(path) if name.startswith("torch.distributed")]


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_stages_are_loaded_by_name_and_never_import_each_other(path: Path) -> None:
    modules = {tuple(row.module.split(".")[1:]) for row in STAGES}
    assert not {names[:2] for names in inside(path)} & modules


@pytest.mark.parametrize("path", sorted((PACKAGE / "scene").rglob("*.py")), ids=ids)
def test_the_scene_knows_nothing_but_torch_and_numpy(path: Path) -> None:
    assert outside(path) <= {"torch", "numpy"}


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_a_file_holds_one_idea(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MAX_LINES


@pytest.mark.parametrize("path", FILES, ids=ids)
def test_nothing_below_the_command_line_prints_or_exits(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in {"print", "exit", "quit", "sys.exit", "os.system"}
            assert not any(word.arg == "shell" for word in node.keywords), "a shell string"
        if isinstance(node, ast.Raise) and node.exc and path.name != "__main__.py":
            assert "SystemExit" not in ast.unparse(node.exc)


def test_no_part_is_forgotten_and_no_rule_is_circular() -> None:
    assert {part(path) for path in FILES} - {"__init__"} <= ALLOWED.keys()
    left = {name: set(below) for name, below in ALLOWED.items()}
    while left:
        free = {name for name, below in left.items() if not below & left.keys()}
        assert free, f"circular among {sorted(left)}"
        left = {name: below for name, below in left.items() if name not in free}
