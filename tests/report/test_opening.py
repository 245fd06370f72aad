"""What the page opens with: a render, the word, a title, links that lead to the files."""

import re
import shutil
from pathlib import Path
from urllib.parse import unquote

import pytest
from facts import assert_facts
from report_workspace import give_title, page_of, report, section


def links(page, folder):
    """The files that a page in a folder links to, by their text."""
    return {text: (folder / unquote(href)).resolve()
            for href, text in re.findall(r'<a href="([^"]+)">([^<]+)</a>', page)}


def top(page):
    return page[page.index("<header"):page.index("</header>")]


def test_it_opens_with_a_render_the_word_and_the_name_of_the_capture(workspace):
    page = page_of(workspace)
    assert "<h1>Room</h1>" in page
    assert "<title>Room - recon report</title>" in page
    assert '<figure class="room"><img src="data:image/webp' in top(page)
    assert re.search(r'class="quality (good|fair|poor)"', top(page))
    assert_facts(top(page), "surface", "seen")


@pytest.mark.integration
def test_a_title_that_was_given_to_the_export_is_that_of_the_report(workspace):
    give_title(workspace, "Anna's kitchen")
    assert "<h1>Anna&#39;s kitchen</h1>" in page_of(workspace)


@pytest.mark.integration
def test_files_are_links_from_wherever_the_page_lies(workspace, tmp_path):
    files = {name: workspace / "export" / name for name in ("splats.ply", "splats.spz")}
    page = page_of(workspace)
    assert links(top(page), workspace) == files
    assert links(section(page, "exports"), workspace) == files
    assert "export/splats.ply" in page
    out = tmp_path / "a b" / "page.html"
    assert report(workspace, "-o", out) == 0
    assert links(out.read_text(encoding="utf-8"), out.parent) == files


@pytest.mark.integration
def test_a_file_that_is_gone_is_no_link(workspace):
    Path(workspace / "export" / "splats.spz").unlink()
    page = page_of(workspace)
    assert "splats.spz" not in links(page, workspace)
    assert "splats.spz (gone)" in section(page, "exports")


@pytest.mark.integration
def test_without_renders_a_frame_of_the_capture_is_shown(workspace):
    shutil.rmtree(workspace / "evaluate")
    page = page_of(workspace)
    assert_facts(top(page), "frame", "capture")
    assert_facts(top(page), "no held-out")
