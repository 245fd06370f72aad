"""Commands that messages tell to type: they name the workspace, and recon understands them."""

import ast
import re
import shlex
from pathlib import Path

import click
import pytest

import recon_cli
from recon_cli.cli import HIDDEN, cli, main
from recon_cli.commands import hints
from recon_cli.commands.hints import name_workspace
from recon_cli.commands.options import Call

PACKAGE = Path(recon_cli.__file__).parent
PLACEHOLDERS = {"N": "4", "A": "a.png", "B": "b.png", "METRES": "1", "FILE": "a.ply"}
COMMAND = re.compile(r"`recon ([a-z-]+)((?: [^`]*)?)`", re.DOTALL)


def default_of(verb: str) -> str | None:
    return {"demo": "demo", "bench": None}.get(verb, "workspace")


@pytest.mark.parametrize(("text", "completed"), [
    ("Run `recon sfm --again`.", "Run `recon sfm --again -w 'my room'`."),
    ("Run `recon ingest` and then `recon sfm`.",
     "Run `recon ingest -w 'my room'` and then `recon sfm -w 'my room'`."),
    ("Run `recon train -w other`.", "Run `recon train -w other`."),
    ("Run `recon train --workspace=other`.", "Run `recon train --workspace=other`."),
    ("Run `recon bench`.", "Run `recon bench`."),
    ("Run `ls`, not recon.", "Run `ls`, not recon.")])
def test_commands_in_a_message_name_the_workspace(text: str, completed: str) -> None:
    assert name_workspace(text, Path("my room"), default_of) == completed


def test_the_default_workspace_is_not_named(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for workspace in (Path("workspace"), tmp_path / "workspace"):
        assert name_workspace("`recon sfm`", workspace, default_of) == "`recon sfm`"
    assert name_workspace("`recon demo`", Path("demo"), default_of) == "`recon demo`"
    assert name_workspace("`recon sfm`", Path("demo"), default_of) == "`recon sfm -w demo`"


def test_a_hint_names_the_workspace_that_was_typed(
    tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.delenv("RECON_WORKSPACE", raising=False)
    assert main(["eval", "-w", str(tmp_path / "room")]) == 4
    hint = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("hint:"))
    assert f"-w {tmp_path / 'room'}`" in hint
    monkeypatch.setenv("RECON_WORKSPACE", str(tmp_path / "room"))
    assert main(["eval"]) == 4
    assert "-w" not in capsys.readouterr().err  # what is typed next finds it as well


def commands_in_messages() -> list[tuple[str, bool, str, str]]:
    """Returns (place, is in a hint, verb, words) of every command in backticks in the package."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "recon " not in text:
            continue
        nodes = [*ast.walk(ast.parse(text))]
        hints = {id(inner) for node in nodes if isinstance(node, ast.keyword)
                 and node.arg == "hint" for inner in ast.walk(node.value)}
        for node in nodes:
            found += [(f"{path.relative_to(PACKAGE)}:{node.lineno}", id(node) in hints,
                       *match.groups()) for match in COMMAND.finditer(_text(node))]
    return found


def _text(node: ast.AST) -> str:
    """Returns the text of a string; what an f-string fills in becomes a placeholder."""
    if isinstance(node, ast.JoinedStr):
        return "".join(
            str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def test_every_command_in_a_message_is_one_that_recon_understands() -> None:
    commands = commands_in_messages()
    assert sum(in_hint for _, in_hint, _, _ in commands) > 30
    wrong = []
    for place, in_hint, verb, words in commands:
        if "{}" in verb + words or verb in HIDDEN:
            continue  # made from the options themselves, by `plan.command`
        typed = [PLACEHOLDERS.get(word, word) for word in shlex.split(words)]
        try:
            cli.commands[verb].make_context(verb, typed, obj=Call())
        except (click.exceptions.Exit, click.MissingParameter):
            continue  # --help; a verb that is only mentioned
        except (click.ClickException, KeyError) as error:
            # Outside of a hint an option may be mentioned without its value.
            if in_hint or not isinstance(error, click.BadOptionUsage | click.BadParameter):
                wrong.append(f"{place}: `recon {verb}{words}`: {error}")
    assert not wrong, "\n".join(wrong)


def test_who_runs_is_told_to_run_another_input_but_not_an_option_of_ingest():
    text = "Type `recon ingest a.mp4` or recon ingest b; `recon ingest --again`, `recon ingest`."
    assert hints.name_verb(text, "run") == (
        "Type `recon run a.mp4` or recon run b; `recon ingest --again`, `recon ingest`.")
    assert hints.name_verb(text, "ingest") == text
