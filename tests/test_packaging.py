"""What is published says the same everywhere, and its links lead somewhere outside a clone, too."""

from __future__ import annotations

import importlib.util
import re
import tomllib
from pathlib import Path

import pytest

from recon_cli.cli import VERBS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
HOME = "https://github.com/recon-cli/recon"


def test_links_and_pictures_of_the_readme_are_urls_on_pypi():
    spec = importlib.util.spec_from_file_location("recon_setup", ROOT / "setup.py")
    setup = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(setup)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    text = setup.absolute(readme)
    before, after = (re.findall(r"\]\(([^)]+)\)", each) for each in (readme, text))
    assert all(link.startswith(("https://", "#")) for link in after)
    assert len(before) == len(after)
    for old, new in zip(before, after, strict=True):
        assert new == old or (new.endswith(f"/main/{old}") and (ROOT / old.split("#")[0]).exists())
    assert setup.absolute("![a](b.png) [c\nd](e.md#f) [g](https://h) [i](#j)") == (
        "![a](https://raw.githubusercontent.com/recon-cli/recon/main/b.png) "
        f"[c\nd]({HOME}/blob/main/e.md#f) [g](https://h) [i](#j)")


def test_version_and_address_are_the_same_in_all_files():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {PROJECT['version']}\n" in citation
    assert PROJECT["urls"]["Homepage"] == HOME
    for name in ("CITATION.cff", "SECURITY.md", "setup.py"):
        assert "recon-cli/recon" in (ROOT / name).read_text(encoding="utf-8")


def test_an_image_gets_all_that_the_build_needs_and_nothing_else():
    taken = {line[1:] for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines()
             if line.startswith("!")}
    assert taken == {"recon_cli", "constraints.txt", "LICENSE", "pyproject.toml", "README.md",
                     "setup.py"}
    assert all((ROOT / name).exists() for name in taken)


README = (ROOT / "README.md").read_text(encoding="utf-8")


def first_block() -> list[str]:
    """The commands of the README's first code block, without their comments."""
    block = re.search(r"^```\n(.*?)^```", README, re.M | re.S)[1]
    return [line.partition(" #")[0].strip() for line in block.splitlines()]


def test_the_readme_begins_with_commands_that_a_fresh_clone_has():
    demo, test, recon = first_block()
    assert (demo, test) == ("make demo", "make test")
    assert recon.startswith(".venv/bin/recon run ")
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.M))
    assert set(re.findall(r"(?:^|`)make ([a-z-]+)", README, re.M)) <= targets
    assert set(re.findall(r"\.venv/bin/recon (\w+)", README)) <= set(VERBS)


def test_every_change_is_checked_by_the_command_that_the_readme_names():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert re.search(r"^ *part test$", script, re.M)


@pytest.mark.parametrize("page", [
    *ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("docs/**/*.ipynb"),
    *ROOT.glob(".github/**/*.yml"), *ROOT.glob("recon_cli/**/*.py"), ROOT / "constraints.txt",
    ROOT / "Dockerfile"], ids=lambda page: page.name)
def test_nothing_installs_the_project_by_a_name_of_pypi(page: Path):
    """It is not published, and `recon-cli` there is another project."""
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"install[^\n`]*\brecon-(cli|gs)\b", text)
    assert not re.search(r"\brecon-cli\[", text)
