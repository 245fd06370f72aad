"""The documentation says what is true: links, the generated CLI page, the batch example."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from recon_cli.errors import ExitCode, ReconError

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_to_a_file_leads_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if "://" not in target:
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_the_index_lists_every_page():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        if page.name != "index.md":
            assert f"({page.name})" in index


@pytest.mark.integration
@pytest.mark.parametrize("generator", ["generate_cli.py", "generate_api.py"])
def test_a_generated_page_is_up_to_date(generator):
    command = [sys.executable, str(ROOT / "docs" / generator), "--check"]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == 0


def _family(kind: type[ReconError]) -> set[int]:
    return {kind.exit_code}.union(*(_family(sub) for sub in kind.__subclasses__()))


def test_every_exit_code_is_documented():
    page = (ROOT / "docs" / "scripts.md").read_text(encoding="utf-8")
    for code in _family(ReconError) | set(ExitCode) - {ExitCode.SIGNAL, ExitCode.KILLED}:
        assert f"\n| {code} |" in page


def test_the_design_names_every_module_of_the_package():
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    for path in (ROOT / "recon_cli").glob("*.py"):
        if not path.name.startswith("__"):
            assert path.name in page, f"docs/design.md does not mention {path.name}"


@pytest.mark.parametrize("name", ["design.md", "tour.md"])
def test_every_path_that_the_page_names_exists(name):
    page = (ROOT / "docs" / name).read_text(encoding="utf-8")
    for path in re.findall(r"`((?:[\w.]+/)*[\w.]+(?:/|\.py|\.j2|\.md))`", page):
        assert path.startswith((".partial", "build")) or any(
            (root / path).exists() for root in (ROOT, ROOT / "recon_cli", ROOT / "tests")), path


@pytest.mark.parametrize("page", [page for page in PAGES if page.name != "CONTRIBUTING.md"],
                         ids=lambda page: page.name)
def test_every_script_that_a_page_types_exists(page):
    for path in re.findall(r"\b(tests/[\w/]+\.py)", page.read_text(encoding="utf-8")):
        assert (ROOT / path).is_file(), f"{page.name} types {path}"


BY_HAND = [page for page in sorted((ROOT / "docs").glob("*.md"))
           if page.name not in ("api.md", "cli.md")]


def test_the_pages_by_hand_are_read_in_about_an_hour():
    words = {page.name: len(page.read_text(encoding="utf-8").split()) for page in BY_HAND}
    assert sum(words.values()) <= 17_000, words


@pytest.mark.parametrize("page", BY_HAND, ids=lambda page: page.name)
def test_no_cell_of_a_table_has_more_than_30_words(page):
    for line in page.read_text(encoding="utf-8").splitlines():
        for cell in re.split(r"(?<!\\)\|", line) if line.startswith("|") else ():
            assert len(cell.split()) <= 30, cell


@pytest.mark.integration
def test_the_manual_builds_as_a_site_without_a_link_that_leads_nowhere(tmp_path):
    pytest.importorskip("mkdocs", reason="mkdocs comes with the extra `dev`")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "filming.html").is_file()


@pytest.mark.integration
def test_the_batch_example_continues_after_a_failure_and_says_so(tmp_path, sample_video):
    videos, results = tmp_path / "videos", tmp_path / "results"
    videos.mkdir()
    (videos / "a_broken.mp4").write_text("this is not a video")
    (videos / "b_room.mp4").write_bytes(sample_video.read_bytes())
    environment = {
        **os.environ, "OMP_NUM_THREADS": "1",
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    small = {"ingest.frames": 16, "ingest.max_size": 320, "sfm.max_features": 1500,
             "train.iterations": 10, "train.max_size": 80}
    options = [word for key, value in small.items() for word in ("--set", f"{key}={value}")]
    done = subprocess.run(
        [str(ROOT / "docs" / "examples" / "batch.sh"), str(videos), str(results), *options],
        env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 1, done.stderr
    summary = (results / "summary.txt").read_text(encoding="utf-8").splitlines()
    assert summary[0].startswith("a_broken: failed with exit code 3: error:")
    assert summary[1] == "b_room: done"
    assert (results / "b_room.ply").stat().st_size > 10_000
