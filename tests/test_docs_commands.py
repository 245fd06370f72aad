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
PLACEHOLDER = re.compile(r"\.\.\.|…")


def commands(page: Path) -> list[str]:
    """Returns the recon commands in code blocks and between backticks, each on one line."""
    text = page.read_text(encoding="utf-8")
    lines = [line for block in BLOCK.findall(text) for line in block.splitlines()]
    typed = [part.strip() for line in lines for part in re.split(r"&&|\|\||\|", line)]
    inline = [" ".join(found.split()) for found in INLINE.findall(BLOCK.sub("", text))]
    return [re.sub(r"^(?:\S+=\S+ )+", "", each) for each in typed + inline
            if re.match(r"(?:\S+=\S+ )*recon ", each)]


def find_fault(line: str) -> str:
    """Returns what `recon` would refuse in a line, before it looks at any file; else nothing."""
    words = shlex.split(line.split(" \\|")[0].replace("\\", ""), comments=True)[1:]
    command: click.Command = cli
    while words and isinstance(command, click.Group) and not words[0].startswith("-"):
        found = command.get_command(click.Context(command), words[0])
        if found is None:
            return "" if command is not cli or PLACEHOLDER.match(words[0]) else f"no {words[0]}"
        command, words = found, words[1:]
    known = {"--help", "--help-all", "--version"}
    for param in command.params:
        known |= {*param.opts, *param.secondary_opts}
    for word in words:
        name = word.split("=")[0]
        if re.match(r"--?[a-z]", word) and name not in known:
            return f"no {name}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_page_types_commands_and_options_that_exist(page):
    faults = {line: fault for line in commands(page) if (fault := find_fault(line))}
    assert not faults


@pytest.mark.parametrize(("line", "fault"), [
    ("recon ingest room.mp4 --frames 40", ""), ("recon bench train --seeds 2", ""),
    ("recon ingset room.mp4", "no ingset"), ("recon train --fast", "no --fast")])
def test_a_command_that_does_not_exist_is_found(line, fault):
    assert find_fault(line) == fault


def test_settings_in_the_manual_are_options_of_a_stage():
    fields = {row.name: set(row.config.__dataclass_fields__) for row in STAGES}
    for page in PAGES:
        for section, name in re.findall(r"--set (\w+)\.(\w+)=", page.read_text(encoding="utf-8")):
            assert name in fields[section], f"{page.name}: {section}.{name}"
