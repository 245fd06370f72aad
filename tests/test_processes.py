"""Processes of Python that recon starts run its own code alone."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from recon_cli import processes
from recon_cli.processes import child_environment, protect_children, start_module

PACKAGE = Path(processes.__file__).parent
# What starts programs, by module; "" stands for the whole module.
STARTERS = {
    "subprocess": {"Popen", "run", "call", "check_call", "check_output", "getoutput"},
    "os": {"system", "popen", "fork", "forkpty", "posix_spawn", "posix_spawnp", "startfile",
           *(name for name in dir(os) if name.startswith(("exec", "spawn")))},
    "multiprocessing": {""}, "pty": {""}, "runpy": {""},
    "concurrent.futures": {"ProcessPoolExecutor"}, "asyncio": {
        "create_subprocess_exec", "create_subprocess_shell"},
    "torch.multiprocessing": {""}, "joblib": {""},
}
# A lock, which starts nothing by itself; what it has started elsewhere inherits PYTHONSAFEPATH.
KNOWN = {("pipeline/execute.py", "multiprocessing.synchronize")}


def starts(path):
    """Yields the dotted name of everything in a file that can start a program."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    types = {inside for node in ast.walk(tree) for name in ("annotation", "returns")
             if isinstance(getattr(node, name, None), ast.AST)
             for inside in ast.walk(getattr(node, name))}
    for node in set(ast.walk(tree)) - types:
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Attribute):
            names = [ast.unparse(node)]
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "import_module":
            names = [str(getattr(node.args[0], "value", "?"))]
        for name in names:
            for module, members in STARTERS.items():
                rest = name.removeprefix(f"{module}.")
                below = rest != name
                if (below and rest in members) or ("" in members and (below or name == module)):
                    yield name


@pytest.mark.integration
def test_only_one_module_starts_programs():
    found = {(path.relative_to(PACKAGE).as_posix(), name)
             for path in PACKAGE.rglob("*.py") for name in starts(path)}
    assert {where for where, _ in found - KNOWN} == {"processes.py"}
    assert found >= KNOWN  # the list names only files that need it


def test_every_program_that_is_started_is_python_with_a_safe_path():
    tree = ast.parse((PACKAGE / "processes.py").read_text(encoding="utf-8"))
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)
             and ast.unparse(node.func).startswith("subprocess.")]
    assert len(calls) == 1
    for call in calls:
        assert ast.unparse(call.args[0]).startswith("python_command(")
        given = {word.arg: ast.unparse(word.value) for word in call.keywords}
        assert given["env"].startswith("child_environment(")


@pytest.mark.integration
def test_a_module_beside_the_data_is_not_run(tmp_path):
    for name in ("numpy.py", "recon_cli.py", "random.py", "sitecustomize.py"):
        (tmp_path / name).write_text("open('run', 'w')", encoding="utf-8")
    with start_module("recon_cli", "--version", folder=tmp_path, out=subprocess.PIPE,
                      errors=subprocess.PIPE) as child:
        said, _ = child.communicate()
    assert said.startswith(b"recon")
    assert not (tmp_path / "run").exists()


@pytest.mark.integration
def test_nor_is_one_run_that_an_empty_or_relative_entry_of_pythonpath_names(
    tmp_path, monkeypatch
):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "random.py").write_text("open('run', 'w')", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", "lib", "."]))
    assert child_environment()["PYTHONPATH"] == os.pathsep.join(
        [str(tmp_path / "lib"), str(tmp_path)])
    monkeypatch.setenv("PYTHONPATH", os.pathsep)
    assert "PYTHONPATH" not in child_environment()
    with start_module("recon_cli", "--version", folder=tmp_path / "data", out=subprocess.PIPE,
                      errors=subprocess.PIPE) as child:
        assert child.communicate()[0].startswith(b"recon")
    assert not (tmp_path / "data" / "run").exists()


@pytest.mark.integration
def test_processes_that_libraries_start_are_protected_as_well(tmp_path, monkeypatch):
    (tmp_path / "random.py").write_text("open('run', 'w')", encoding="utf-8")
    monkeypatch.setenv("PYTHONSAFEPATH", "")
    protect_children()
    subprocess.run([sys.executable, "-c", "import random"], cwd=tmp_path, check=True)
    assert not (tmp_path / "run").exists()
