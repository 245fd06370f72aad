"""Commands that messages name: they fit where the user works, and recon understands them."""

import ast
import re
import shlex
from pathlib import Path

import click
import pytest

import recon_cli
from recon_cli.cli import VERBS, cli, main
from recon_cli.commands.options import Call
from recon_cli.errors import (
    IN_USE,
    WITHOUT_WORKSPACE,
    FormatError,
    Hint,
    command_line,
    name_command,
    use_workspace,
)
from recon_cli.processes import forget_options

PACKAGE = Path(recon_cli.__file__).parent
PLACEHOLDERS = {"N": "4", "A": "a.png", "B": "b.png", "METRES": "1", "FILE": "a.ply",
                "NAME": "loo", "X": "0.5"}
COMMAND = re.compile(r"`recon ([a-z-]+)((?: [^`]*)?)`", re.DOTALL)


@pytest.fixture(autouse=True)
def nothing_typed(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RECON_WORKSPACE", raising=False)
    monkeypatch.setenv(IN_USE, "")


@pytest.mark.parametrize(("words", "line"), [
    ("sfm --again", "recon sfm --again -w 'my room'"),
    ("ingest", "recon ingest -w 'my room'"),
    ("info a.ply", "recon info a.ply")])
def test_a_command_names_the_workspace_in_use_where_its_verb_takes_one(words, line) -> None:
    use_workspace("train", Path("my room"))
    assert command_line(words) == line
    assert name_command(words) == f"`{line}`"


def test_the_workspace_that_is_taken_without_w_is_not_named(tmp_path: Path, monkeypatch) -> None:
    for workspace in (None, Path("workspace"), tmp_path / "workspace"):
        use_workspace("train", workspace)
        assert command_line("sfm") == "recon sfm"
    monkeypatch.setenv("RECON_WORKSPACE", "demo")
    use_workspace("train", Path("demo"))
    assert command_line("sfm") == "recon sfm"


def test_a_constant_hint_is_completed_when_the_error_is_raised() -> None:
    hint = Hint("sfm", "--part 2", again=True)
    use_workspace("train", Path("room"))
    assert "`recon sfm --part 2 --again -w room`" in FormatError("broken", hint=hint).hint


def test_who_runs_is_told_to_run_another_input_but_not_an_option_of_ingest() -> None:
    use_workspace("run", None)
    assert command_line("ingest a.mp4") == "recon run a.mp4"
    assert command_line("ingest --again") == "recon ingest --again"
    assert command_line("ingest") == "recon ingest"
    use_workspace("ingest", None)
    assert command_line("ingest a.mp4") == "recon ingest a.mp4"


def test_processes_that_recon_starts_name_the_same_workspace(monkeypatch) -> None:
    use_workspace("train", Path("room"))
    monkeypatch.setenv("RECON_TRAIN_ITERATIONS", "5")
    forget_options()
    assert command_line("sfm") == "recon sfm -w room"


@pytest.mark.parametrize("verb", VERBS)
def test_it_is_known_which_verbs_take_a_workspace(verb: str) -> None:
    has_workspace = any(option.name == "workspace" for option in cli.commands[verb].params)
    assert has_workspace is (verb not in WITHOUT_WORKSPACE)


def test_a_hint_names_the_workspace_that_was_typed(tmp_path: Path, capsys, monkeypatch) -> None:
    assert main(["eval", "-w", str(tmp_path / "room")]) == 4
    hint = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("hint:"))
    assert f"-w {tmp_path / 'room'}`" in hint
    assert command_line("sfm") == "recon sfm"  # the next one of this process has none in use
    monkeypatch.setenv("RECON_WORKSPACE", str(tmp_path / "room"))
    assert main(["eval"]) == 4
    assert "-w" not in capsys.readouterr().err  # what is typed next finds it as well


def named_commands(tree: ast.AST) -> list[tuple[int, str]]:
    """Returns line and words of every command that is made by `Hint` and its functions."""
    found = []
    for node in ast.walk(tree):
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            continue
        if node.func.id in ("Hint", "name_command", "command_line"):
            texts = [arg.value if isinstance(arg, ast.Constant) else "{}" for arg in node.args]
            again = any(word.arg == "again" for word in node.keywords)
            found.append((node.lineno, " ".join([*texts, *["--again"] * again])))
    return found


@pytest.mark.integration
def test_every_command_that_is_named_is_one_that_recon_understands() -> None:
    wrong, count = [], 0
    for path in sorted(PACKAGE.rglob("*.py")):
        for line, words in named_commands(ast.parse(path.read_text(encoding="utf-8"))):
            if "{}" in words:  # made from the options themselves, or of paths
                continue
            verb, *typed = [PLACEHOLDERS.get(word, word) for word in shlex.split(words)]
            count += 1
            try:
                cli.commands[verb].make_context(verb, typed, obj=Call())
            except click.MissingParameter:
                continue  # a verb that is only mentioned
            except (click.ClickException, KeyError) as error:
                wrong.append(f"{path.relative_to(PACKAGE)}:{line}: {words}: {error}")
    assert count > 60
    assert not wrong, "\n".join(wrong)


@pytest.mark.integration
def test_no_hint_is_text_with_a_command_that_needs_the_workspace() -> None:
    wrong = []
    for path in sorted(PACKAGE.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        texts = [inner for node in ast.walk(tree)
                 if isinstance(node, ast.keyword) and node.arg == "hint"
                 for inner in ast.walk(node.value) if isinstance(inner, ast.Constant)]
        wrong += [f"{path.relative_to(PACKAGE)}:{text.lineno}: {match[0]}" for text in texts
                  for match in COMMAND.finditer(str(text.value))
                  if match[1] not in WITHOUT_WORKSPACE and " FILE" not in match[2]]
    assert not wrong, "\n".join(wrong)
