"""tests/bench/notes/numerics.md names tests that exist."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_every_test_that_the_page_names_exists():
    page = (ROOT / "tests" / "bench" / "notes" / "numerics.md").read_text(encoding="utf-8")
    tests = {name for folder in ("render", "train")
             for file in (ROOT / "tests" / folder).glob("test_*.py")
             for name in re.findall(r"^def (test_\w+)", file.read_text(encoding="utf-8"), re.M)}
    named = set(re.findall(r"`(test_\w+)`", page))
    assert named
    assert named <= tests
