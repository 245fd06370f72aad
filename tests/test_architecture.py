"""Who may import whom, read off the syntax trees: nothing imports upward. docs/design.md."""

import ast
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from syntax import FILES, PACKAGE, dotted, nodes

from recon_cli.stages import STAGES

MAX_LINES = 500

# Each part of the package (a module or folder at its top) and the parts that it may import.
BASE = {"deadline", "errors", "plugins", "progress", "machine", "processes", "signals",
        "time_estimate"}
RECORDS = BASE | {"workspace", "config", "scene"}
READ = RECORDS | {"io"}
DRAW = READ | {"context", "kernels", "render", "evaluation", "stereo", "splats"}
MAKE = DRAW | {"capture", "datasets", "jobs", "room", "sfm", "train", "export", "trust", "stages"}
RUN = MAKE | {"pipeline"}
ALLOWED: dict[str, set[str]] = {
    "deadline": set(),
    "errors": set(),
    "plugins": set(),
    "processes": set(),
    "signals": {"errors"},
    "time_estimate": set(),
    "progress": {"errors"},
    "cgroups": set(),
    "machine": {"cgroups", "errors"},
    "scene": {"errors"},
    "workspace": {"errors", "plugins", "scene"},
    "config": {"errors", "workspace"},
    "context": {"config", "deadline", "progress", "scene"},
    "kernels": {"machine", "scene"},
    "render": {"errors", "kernels", "machine", "scene"},
    "io": {"errors", "signals", "workspace", "scene"},
    "splats": {"errors", "io", "machine", "scene", "workspace"},
    "jobs": BASE | {"workspace"},
    "capture": READ,
    "datasets": READ | {"capture", "splats"},
    "stereo": {"kernels", "render", "scene"},
    "evaluation": READ | {"context", "render", "splats"},
    "room": DRAW,
    "sfm": READ | {"jobs", "room"},
    "train": DRAW | {"jobs"},
    "export": DRAW | {"datasets", "room", "train"},
    "trust": DRAW,
    "stages": MAKE,
    "pipeline": READ | {"context", "jobs", "render", "stages"},
    "experiments": RUN,
    "flythrough": RUN,
    "report": RUN,
    "viewer": RUN | {"flythrough"},
    "api": RUN | {"flythrough", "report"},
    "commands": RUN | {"api", "experiments", "flythrough", "report", "viewer"},
    "cli": RUN | {"commands"},
    "__main__": {"cli", "errors", "processes", "signals"},
}
# Packages that only some parts may import.
HOMES = {
    "click": {"cli", "commands"},
    "zstandard": {"splats"},
    "jinja2": {"report"},
    "markupsafe": {"io", "report", "room"},
    "viser": {"viewer"},
    "websockets": {"viewer"},
    "matplotlib": {"experiments"},
    "numba": {"kernels", "render"},
    "llvmlite": {"kernels", "render"},
    "tqdm": {"progress"},
    "triton": {"render"},
    "ray": {"jobs"},
    "pycolmap": {"io"},
    "trimesh": {"io"},
    "OpenEXR": {"io"},
    "lzfse": {"datasets"},
    "xatlas": {"room"},
}


def part(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


@cache
def imports(path: Path) -> tuple[str, ...]:
    """Returns the dotted name of every import of a file, late ones as well."""
    names: list[str] = []
    for node in nodes(path, ast.Import):
        names += [alias.name for alias in node.names]
    for late in nodes(path, ast.ImportFrom):
        assert late.level == 0, f"{path} imports relatively"
        assert late.module
        names += [f"{late.module}.{alias.name}" for alias in late.names]
    return tuple(names)


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


def test_a_file_imports_only_what_lies_below_it() -> None:
    wrong = {
        f"{path.relative_to(PACKAGE)} imports {name}"
        for path in FILES if path != PACKAGE / "__init__.py"
        for name, *_ in inside(path) if name not in ALLOWED[part(path)] | {part(path)}}
    assert not wrong
    # what type checkers see of the public names; at run time they are loaded by name
    assert {name for name, *_ in inside(PACKAGE / "__init__.py")} <= {"api", "render"}


def test_a_package_that_has_a_home_is_imported_nowhere_else() -> None:
    wrong = {
        f"{path.relative_to(PACKAGE)} imports {package}, whose home is {HOMES[package]}"
        for path in FILES for package in outside(path) & HOMES.keys()
        if part(path) not in HOMES[package]}
    wrong |= {
        f"{path.relative_to(PACKAGE)} imports {package}" for path in FILES if part(path) == "scene"
        for package in outside(path) - {"torch", "numpy", "scipy"}}
    assert not wrong


def test_stages_are_loaded_by_name_and_never_import_each_other() -> None:
    modules = {tuple(row.module.split(".")[1:]) for row in STAGES}
    wrong = [str(path) for path in FILES if {names[:2] for names in inside(path)} & modules]
    assert not wrong


def test_a_file_is_not_longer_than_a_reader_can_hold() -> None:
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in FILES}
    assert {path: count for path, count in lengths.items() if count > MAX_LINES} == {}


def test_nothing_below_the_command_line_prints_or_exits() -> None:
    for path in FILES:
        for call in nodes(path, ast.Call):
            called = dotted(call.func)
            assert called not in {"print", "exit", "quit", "sys.exit", "os.system"}, path
            assert not any(word.arg == "shell" for word in call.keywords), f"shell in {path}"
        for error in nodes(path, ast.Raise):
            if error.exc and path.name != "__main__.py":
                assert "SystemExit" not in ast.unparse(error.exc), path


def test_files_are_opened_by_python_and_not_by_opencv() -> None:
    # which crashes on a path that is not UTF-8, and says nothing where a file cannot be written
    refused = {f"cv2.{name}" for name in ("imread", "imreadmulti", "imwrite", "imwritemulti",
                                          "VideoCapture", "VideoWriter", "FileStorage")}
    for path in FILES:
        for node in nodes(path, ast.Attribute):
            assert dotted(node) not in refused, path


def test_only_what_a_table_names_is_imported_by_name() -> None:
    # elsewhere an import is a statement, which type checkers and readers see
    found = {path.relative_to(PACKAGE).as_posix() for path in FILES
             for call in nodes(path, ast.Call) if dotted(call.func).endswith("import_module")}
    # public names, commands, stages, and formats of Gaussians
    assert found == {"__init__.py", "api/__init__.py", "cli.py", "pipeline/execute.py",
                     "splats/registry.py"}


def test_the_library_of_colmap_is_imported_in_one_place() -> None:
    found = {path.name for path in FILES for name in imports(path) if name == "pycolmap"}
    assert found == {"colmap_library.py"}  # which gives back the signals that it takes


def test_no_part_is_forgotten_and_no_rule_is_circular() -> None:
    assert {part(path) for path in FILES} - {"__init__"} == ALLOWED.keys()
    left = {name: below - {name} for name, below in ALLOWED.items()}
    while left:
        free = {name for name, below in left.items() if not below & left.keys()}
        assert free, f"circular among {sorted(left)}"
        left = {name: below for name, below in left.items() if name not in free}


# Parts of training whose options are words of their own: what names the option, or imports the
# module, knows the part.
PARTS_OF_TRAINING = ("background", "stereo", "exposure", "vignette", "depth", "moving")
MAX_FILES_OF_A_PART = 4


def names_part(path: Path, name: str) -> bool:
    """Returns whether a file reads, sets or declares the option of a part, or imports its module.

    A part has the folder or module of its name below train/parts.
    """
    module = ("train", "parts", name)
    if any(names[:3] == module for names in inside(path)):
        return True
    reads = {dotted(node) for node in nodes(path, ast.Attribute)}
    if any(read.endswith((f"config.{name}", f"asked.{name}")) for read in reads):
        return True
    return any(word.arg == name for call in nodes(path, ast.Call) for word in call.keywords
               if dotted(call.func).rsplit(".", 1)[-1] in {"RunConfig", "TrainConfig", "Part"})


def test_few_files_know_a_part_of_training() -> None:
    for name in PARTS_OF_TRAINING:
        own = {path for path in FILES if path.stem.startswith(name) and path.parent.name == "parts"}
        others = {path for path in FILES if names_part(path, name)} - own
        assert own
        declares = PACKAGE / "config" / "stages.py"
        assert len(others | {declares}) + 1 <= MAX_FILES_OF_A_PART, (name, others)
