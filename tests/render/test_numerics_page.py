"""docs/numerics names the tests that hold its bounds, and leaves no hard case out."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "numerics.md").read_text(encoding="utf-8")


def functions_in(pattern: str) -> set[str]:
    folders = (ROOT / "tests" / "render", ROOT / "tests" / "train")
    return {name for folder in folders for file in folder.glob(pattern)
            for name in re.findall(r"^def (test_\w+)", file.read_text(encoding="utf-8"), re.M)}


def test_every_test_that_the_page_names_exists():
    assert set(re.findall(r"`(test_\w+)`", PAGE)) <= functions_in("test_*.py")


def test_the_page_names_every_hard_case():
    assert functions_in("test_hard_*.py") <= set(re.findall(r"`(test_\w+)`", PAGE))
