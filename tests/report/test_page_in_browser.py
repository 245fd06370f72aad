"""The page as people use it: tabs, slider, difference, order, hostile names, small screens."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import WatchedPage
from facts import assert_facts
from report_workspace import change, give_title, paint, report

from recon_cli.io.images import write_png

SECTIONS = ("views", "overview", "scores", "training", "pruning", "capture", "exports", "settings")


@pytest.fixture
def shown(workspace: Path, page: WatchedPage) -> WatchedPage:
    """The page of the finished workspace, opened from its file."""
    return opened(workspace, page)


def opened(workspace: Path, page: WatchedPage, *, at: str = "") -> WatchedPage:
    assert report(workspace) == 0
    page.page.goto((workspace / "report.html").as_uri() + at)
    return page


def fraction_dark(page: WatchedPage) -> float:
    """The share of the columns of the framed picture that are dark, by its pixels on the screen."""
    data = page.page.locator("#frame").screenshot()
    row = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return float((row[row.shape[0] // 4] < 128).mean())


def names(page: WatchedPage) -> list[str]:
    return page.page.locator(".shot-name").all_inner_texts()


def by_psnr(workspace: Path, model: str) -> list[str]:
    metrics = json.loads((workspace / "evaluate" / "metrics.json").read_text())
    views = metrics["models"][model]["views"]
    return [view["name"] for view in sorted(views, key=lambda view: view["psnr_db"])]


def test_every_tab_shows_its_section_alone_without_a_complaint_or_the_network(shown):
    for name in SECTIONS:
        shown.page.click(f"#tab-{name}")
        visible = [tab for tab in SECTIONS if shown.page.locator(f"#{tab}").is_visible()]
        assert visible == [name]
        assert shown.page.locator(f"#{name} h2").inner_text()
        assert shown.page.get_attribute(f"#tab-{name}", "aria-selected") == "true"
    shown.assert_silent()
    shown.assert_offline()


def test_tabs_are_reached_by_keys_and_by_address(workspace, page):
    opened(workspace, page, at="#training")
    assert page.page.locator("#training").is_visible()
    page.page.focus("#tab-training")
    for key, name in (("ArrowRight", "pruning"), ("ArrowLeft", "training"), ("End", "settings"),
                      ("ArrowRight", "views"), ("ArrowLeft", "settings"), ("Home", "views")):
        page.page.keyboard.press(key)
        assert page.page.locator(f"#{name}").is_visible()
        assert page.page.evaluate("document.activeElement.id") == f"tab-{name}"


def test_a_section_begins_at_its_top_wherever_the_last_one_was_left(shown):
    shown.page.click("#tab-settings")
    shown.page.evaluate("window.scrollTo(0, 5000)")
    shown.page.click("#tab-scores")
    box = shown.page.locator("#scores h2").bounding_box()
    assert 0 < box["y"] < 120


def test_without_a_script_every_section_is_shown(workspace, chromium):
    assert report(workspace) == 0
    context = chromium.new_context(java_script_enabled=False)
    plain = context.new_page()
    plain.goto((workspace / "report.html").as_uri())
    assert all(plain.locator(f"#{name}").is_visible() for name in SECTIONS)
    assert plain.get_by_text("The slider needs JavaScript").is_visible()
    context.close()


def test_the_slider_shows_as_much_of_the_truth_as_it_says(workspace, page):
    paint(workspace, truth=255, render=0)
    opened(workspace, page, at="#views")
    assert fraction_dark(page) == pytest.approx(0.5, abs=0.03)
    page.page.focus("#slide")
    for _ in range(20):
        page.page.keyboard.press("ArrowRight")
    assert fraction_dark(page) == pytest.approx(0.3, abs=0.03)
    page.page.keyboard.press("Home")
    assert fraction_dark(page) > 0.97
    box = page.page.locator("#frame").bounding_box()
    page.page.mouse.move(box["x"] + 0.1 * box["width"], box["y"] + 20)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 0.8 * box["width"], box["y"] + 25, steps=4)
    page.page.mouse.up()
    assert fraction_dark(page) == pytest.approx(0.2, abs=0.03)
    page.page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 25)  # the button is up
    assert fraction_dark(page) == pytest.approx(0.2, abs=0.03)
    page.assert_silent()


def test_the_difference_takes_the_place_of_the_render_and_has_a_legend(workspace, page):
    paint(workspace, truth=255, render=255)  # nothing differs, so that the difference is black
    opened(workspace, page, at="#views")
    assert fraction_dark(page) < 0.03  # the handle alone
    assert page.page.locator("#ramp").is_hidden()
    page.page.click("#difference")
    assert fraction_dark(page) == pytest.approx(0.5, abs=0.03)
    assert page.page.locator("#ramp").is_visible()
    assert_facts(page.page.locator("#ramp").inner_text(), 4)
    assert page.page.get_attribute("#difference", "aria-pressed") == "true"
    page.page.keyboard.press("d")
    assert fraction_dark(page) < 0.03


def test_views_are_worst_first_for_the_model_that_is_shown(workspace, page):
    def turn_over(value):
        for rank, view in enumerate(value["models"]["pruned"]["views"]):
            view["psnr_db"] = 30.0 - rank
        for rank, view in enumerate(value["models"]["base"]["views"]):
            view["psnr_db"] = 20.0 + rank

    change(workspace / "evaluate" / "metrics.json", turn_over)
    opened(workspace, page, at="#views")
    base, pruned = by_psnr(workspace, "base"), by_psnr(workspace, "pruned")
    assert base == pruned[::-1]
    assert names(page) == pruned  # that which is delivered comes first
    assert f"1 of 3: {pruned[0]}, PSNR 28.00 dB" in page.page.locator("#caption").inner_text()
    page.page.get_by_text("original", exact=True).locator("visible=true").first.click()
    assert names(page) == base
    assert "PSNR 22.00 dB" in page.page.locator("#caption").inner_text()  # the same view
    page.page.keyboard.press("m")
    assert names(page) == pruned


def test_models_have_renders_of_their_own(workspace, page):
    paint(workspace, truth=255, render=0)
    for path in (workspace / "evaluate" / "renders" / "base").iterdir():
        write_png(path, np.full((36, 48, 3), 255, np.uint8))
    opened(workspace, page, at="#views")
    assert fraction_dark(page) == pytest.approx(0.5, abs=0.03)
    page.page.keyboard.press("m")
    assert fraction_dark(page) < 0.03
    assert page.page.locator("#side").inner_text() == "render, original"


def test_views_are_turned_by_keys_buttons_and_clicks(shown, workspace):
    shown.page.click("#tab-views")
    order = by_psnr(workspace, "pruned")
    current = shown.page.locator(".shot[aria-current=true] .shot-name")
    assert current.inner_text() == order[0]
    shown.page.keyboard.press("n")
    assert current.inner_text() == order[1]
    shown.page.click("#next")
    shown.page.click("#next")  # the last one stays
    assert current.inner_text() == order[2]
    shown.page.keyboard.press("p")
    assert current.inner_text() == order[1]
    shown.page.locator(".shot").first.click()
    assert current.inner_text() == order[0]
    shown.page.keyboard.press("ArrowRight")
    assert current.inner_text() == order[1]
    assert shown.page.evaluate("document.activeElement.classList.contains('shot')")
    shown.assert_silent()


def test_a_contact_sheet_grows_to_its_full_size(workspace, page):
    write_png(workspace / "ingest" / "contact.png", np.full((900, 1900, 3), 9, np.uint8))
    opened(workspace, page, at="#capture")
    sheet = page.page.locator(".sheet img")
    assert sheet.bounding_box()["width"] < 1200
    page.page.click(".sheet")
    assert sheet.bounding_box()["width"] == 1900
    page.page.click(".sheet")
    assert sheet.bounding_box()["width"] < 1200


HARM = "<img src=x onerror=hacked=1>"
SCRIPT = "<script>hacked=1<!--"


def test_hostile_names_are_harmless(workspace, page):
    evaluate = workspace / "evaluate"
    for path in [*evaluate.rglob("000000.png"), *(workspace / "ingest").rglob("000000.png")]:
        path.rename(path.with_name(f"{SCRIPT}.png"))

    def rename(value):
        for model in value["models"].values():
            model["views"][0]["name"] = f"{SCRIPT}.png"
        value["psnr_convention"] = f"</dd>{HARM}"
        value["unregistered_test"] = [HARM, "</script><script>hacked=1</script>"]

    change(evaluate / "metrics.json", rename)
    change(workspace / "ingest" / "frames.json",
           lambda value: value["frames"][0].update(name=f"{SCRIPT}.png"))
    change(workspace / "train" / "plan.json", lambda value: value.update(
        needs=[{"name": HARM, "on": True, "reason": SCRIPT}]))
    change(workspace / "train" / "config.json", lambda value: value.update(images=HARM))
    give_title(workspace, HARM)
    hostile = workspace.rename(workspace.with_name(f"'\"&{HARM}"))
    opened(hostile, page)
    for name in SECTIONS:
        page.page.click(f"#tab-{name}")
    assert page.page.evaluate("typeof hacked") == "undefined"
    assert page.page.locator("img[src=x]").count() == 0
    assert page.page.locator("script").count() == 2  # the data and the page's own
    assert page.page.inner_text("h1") == HARM
    page.page.click("#tab-views")
    assert f"{SCRIPT}.png" in names(page)
    page.assert_silent()
    page.assert_offline()


def test_a_script_that_got_into_the_page_does_not_run(workspace, page):
    assert report(workspace) == 0
    path = workspace / "report.html"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("<main>", f"<main><script>hacked=1</script>{HARM}"),
                    encoding="utf-8")
    page.page.goto(path.as_uri())
    page.page.click("#tab-views")
    assert page.page.evaluate("typeof hacked") == "undefined"


@pytest.mark.parametrize("width", [360, 1280])
def test_nothing_sticks_out_of_the_window(shown, width):
    shown.page.set_viewport_size({"width": width, "height": 740})
    for name in SECTIONS:
        shown.page.click(f"#tab-{name}")
        assert shown.page.evaluate("document.documentElement.scrollWidth") <= width, name


def test_a_phone_cuts_no_table_and_begins_at_the_top(shown):
    shown.page.set_viewport_size({"width": 390, "height": 844})
    shown.page.reload()
    assert shown.page.evaluate("window.scrollY") == 0
    assert shown.page.locator(".room img").bounding_box()["width"] > 340
    for name in SECTIONS:
        shown.page.click(f"#tab-{name}")
        cut = shown.page.evaluate(
            "[...document.querySelectorAll('.scroll')].filter(box => "
            "box.scrollWidth > box.clientWidth + 1 && !box.querySelector('.sheet')).length")
        assert cut == 0, name


def test_it_follows_light_and_dark(shown):
    def paper():
        color = shown.page.evaluate("getComputedStyle(document.body).backgroundColor")
        return max(map(int, re.findall(r"\d+", color)[:3]))

    shown.page.emulate_media(color_scheme="light")
    assert paper() > 230
    shown.page.emulate_media(color_scheme="dark")
    assert paper() < 50


def test_paper_shows_every_section_and_no_controls(shown):
    shown.page.emulate_media(media="print")
    assert all(shown.page.locator(f"#{name}").is_visible() for name in SECTIONS)
    assert shown.page.locator(".tabs").is_hidden()
    assert shown.page.locator("#viewer").is_hidden()
    assert shown.page.locator(".shot").first.is_visible()
