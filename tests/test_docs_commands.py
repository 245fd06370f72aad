"""Every command that the manual types exists and takes the options that it is given."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import click
import pytest

from recon_cli.cli import cli
from recon_cli.stages import STAGES

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *(page for page in sorted((ROOT / "docs").glob("*.md"))
                               if page.name != "cli.md")]
BLOCK = re.compile(r"^```(?:text|bash)?\n(.*?)^```", re.M | re.S)
INLINE = re.compile(r"(?<!`)`(recon [^`]+)`(?!`)", re.S)
VARIABLES = r"(?:\S+=\S+ )*"  # before a command


def typed_in_blocks(page: Path) -> list[str]:
    """Returns the recon commands in code blocks, those after && and || too."""
    blocks = BLOCK.findall(page.read_text(encoding="utf-8"))
    parts = [part.strip() for block in blocks for line in block.splitlines()
             for part in re.split(r"&&|\|\||\|", line)]
    return [re.sub(f"^{VARIABLES}", "", part) for part in parts
            if re.match(f"{VARIABLES}recon ", part)]


def named_inline(page: Path) -> list[str]:
    """Returns the recon commands between backticks, some of which have placeholders."""
    text = BLOCK.sub("", page.read_text(encoding="utf-8"))
    return [" ".join(found.split()) for found in INLINE.findall(text)]


def resolve(line: str) -> tuple[click.Command | None, list[str]]:
    """Returns the command that a line calls and the words after it; None if it does not exist."""
    words = shlex.split(line.split(" \\|")[0], comments=True)[1:]
    command: click.Command = cli
    while words and isinstance(command, click.Group) and not words[0].startswith("-"):
        found = command.get_command(click.Context(command), words[0])
        if found is None:
            return (None if command is cli and words[0] != "..." else command), words
        command, words = found, words[1:]
    return command, words


def find_fault(line: str) -> str:
    """Returns the command or option of a line that does not exist; else nothing."""
    command, words = resolve(line)
    if command is None:
        return f"no {words[0]}"
    known = {"--help", "--help-all", "--version"}
    for param in command.params:
        known |= {*param.opts, *param.secondary_opts}
    options = [word.split("=")[0] for word in words if re.match(r"--?[a-z]", word)]
    return next((f"no {name}" for name in options if name not in known), "")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_page_names_commands_and_options_that_exist(page):
    lines = typed_in_blocks(page) + named_inline(page)
    assert not {line: fault for line in lines if (fault := find_fault(line))}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_in_a_code_block_is_accepted_as_it_is_typed(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line in typed_in_blocks(page):
        command, words = resolve(line)
        assert command is not None, line
        command.make_context("recon", words)  # raises UsageError


@pytest.mark.parametrize(("line", "fault"), [
    ("recon ingest room.mp4 --frames 40", ""), ("recon bench --quick", ""),
    ("recon ingset room.mp4", "no ingset"), ("recon train --fast", "no --fast")])
def test_a_command_that_does_not_exist_is_found(line, fault):
    assert find_fault(line) == fault


def test_settings_in_the_manual_are_options_of_a_stage():
    fields = {row.name: set(row.config.__dataclass_fields__) for row in STAGES}
    for page in PAGES:
        for section, name in re.findall(r"--set\s+(\w+)\.(\w+)=", page.read_text(encoding="utf-8")):
            assert name in fields[section], f"{page.name}: {section}.{name}"
