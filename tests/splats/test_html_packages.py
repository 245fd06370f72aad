"""What ships of other people's scripts: whole, as published, named and licensed."""

import hashlib
import re
from pathlib import Path

import pytest

from recon_cli.splats import html
from recon_cli.splats.html import LICENCES, MODULES

WEB = Path(html.__file__).parent / "web"
OURS = {"README.md", "harmonics.js", "page.html", "viewer.js"}
TABLE = {row[0]: row[1:] for row in re.findall(
    r"^\| (\S+) \| (@?[\w/]+ [\d.]+) \| (\S+) \| ([0-9a-f]{64}) \|$",
    (WEB / "README.md").read_text(encoding="utf-8"), re.MULTILINE)}


def test_every_file_is_ours_or_in_the_table():
    assert {path.name for path in WEB.iterdir()} == OURS | TABLE.keys()


@pytest.mark.parametrize("name", TABLE)
def test_a_file_is_the_one_that_was_published(name):
    assert hashlib.sha256((WEB / name).read_bytes()).hexdigest() == TABLE[name][2]


def test_every_package_comes_with_its_licence():
    packages = {package for package, _, _ in TABLE.values()}
    licensed = {TABLE[name][0] for name in LICENCES}
    assert packages == licensed
    for name in LICENCES:
        text = (WEB / name).read_text(encoding="utf-8")
        assert "MIT License" in text
        assert "Copyright" in text


def test_the_version_of_three_is_the_one_that_the_table_names():
    revision = re.search(r'const \w+="(\d+)"', (WEB / "three.core.min.js").read_text("utf-8"))[1]
    assert TABLE["three.core.min.js"][0] == f"three 0.{revision}.0"


def test_every_module_that_another_one_asks_for_is_there():
    asked = set()
    for file in MODULES.values():
        text = re.sub(r"/\*.*?\*/", "", (WEB / file).read_text(encoding="utf-8"), flags=re.DOTALL)
        asked |= {name.replace("./", "recon:") for name in re.findall(
            r"""(?:^|[\s;}])from\s*["']([^"']+)["']""", text)}
    assert asked == MODULES.keys() - {"viewer"}
