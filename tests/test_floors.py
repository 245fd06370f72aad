"""The lowest versions that pyproject.toml allows, which `make test-floors` installs and tests."""

from __future__ import annotations

import ast
import importlib.metadata
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest
from facts import raises
from floors import floors, lowest, read_requirements

import recon_cli

pytestmark = pytest.mark.floors

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = ROOT / "pyproject.toml"
# Of packages that do not belong to the project, the names that its code imports.
INSIDE = {"llvmlite": "numba"}


def plain(name: str) -> str:
    """The name of a package as pip compares it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def versions(lines: list[str]) -> dict[str, tuple[int, ...]]:
    """The packages of lines `name==version`."""
    found = {}
    for line in lines:
        name, _, version = line.partition(";")[0].strip().partition("==")
        found[plain(name)] = tuple(map(int, version.split(".")))
    return found


def constraints() -> dict[str, tuple[int, ...]]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    return versions([line for line in lines if line and not line.startswith("#")])


@pytest.mark.parametrize(("requirement", "floor"), [
    ("av>=18.0", "av==18.0"),
    ("triton>=3.7.1; platform_system == 'Linux'", "triton==3.7.1; platform_system == 'Linux'"),
])
def test_a_lower_bound_becomes_that_version(requirement, floor):
    assert lowest(requirement) == floor


@pytest.mark.parametrize("requirement", ["av", "av>18", "av>=18,!=18.1", "av==18", "av[x]>=18"])
def test_what_has_no_plain_lower_bound_is_refused(requirement):
    with raises(ValueError, requirement):
        lowest(requirement)


def test_every_dependency_has_one_floor_which_the_tested_versions_satisfy():
    found = floors(PYPROJECT)
    lowest_versions = versions(found)
    assert len(lowest_versions) == len(found), "two extras name different versions of a package"
    tested = constraints()
    for name, version in lowest_versions.items():
        if name not in {"lpips", "triton"}:  # in no environment, and left to torch
            assert tested[name] >= version, name


@pytest.mark.integration
def test_every_package_that_the_code_imports_is_a_dependency():
    imported = {
        name.partition(".")[0] for path in (ROOT / "recon_cli").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_bytes()))
        for name in ([alias.name for alias in node.names] if isinstance(node, ast.Import)
                     else [node.module or ""] if isinstance(node, ast.ImportFrom) else [])}
    packages = importlib.metadata.packages_distributions()
    outside = imported - set(sys.stdlib_module_names) - {"recon_cli", "__future__", "", "lpips"}
    needed = {plain(packages.get(INSIDE.get(name, name), [name])[0]) for name in outside}
    assert needed <= set(versions(floors(PYPROJECT)))


@pytest.mark.integration
def test_every_module_of_the_package_can_be_imported():
    modules = [each.name for each in pkgutil.walk_packages(recon_cli.__path__, "recon_cli.")
               if not each.name.endswith("__main__")]
    if "triton" not in importlib.metadata.packages_distributions():
        modules = [name for name in modules if "render.triton." not in name]
    assert len(modules) > 200
    program = f"import importlib\nfor name in {modules}: importlib.import_module(name)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                          check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.integration
def test_the_script_prints_a_line_for_each_package():
    done = subprocess.run([sys.executable, ROOT / "tests" / "floors.py", PYPROJECT],
                          capture_output=True, text=True, check=True)
    named = {plain(re.split("[>=]", each)[0]) for each in read_requirements(PYPROJECT)}
    assert set(versions(done.stdout.splitlines())) == named
