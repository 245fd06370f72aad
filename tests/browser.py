"""Headless Chromium for tests of what people look at: pages, and the console that must stay silent.

`RECON_CHROMIUM` names the program where it has another name. Where there is none the tests are
skipped with that reason; in CI they fail, for a page that nobody opened is not tested.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ConsoleMessage, Page

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
ARGUMENTS = [
    "--no-sandbox",  # root may not start it otherwise
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",  # WebGL without a GPU
    "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip
# What a software WebGL says about its own speed, which the page cannot help.
HARMLESS = ("GPU stall due to ReadPixels", "Automatic fallback to software WebGL")


@dataclass
class WatchedPage:
    """A page, with every complaint on its console and every address that it asked for."""

    page: Page
    complaints: list[str] = field(default_factory=list)
    addresses: list[str] = field(default_factory=list)

    def record_message(self, message: ConsoleMessage) -> None:
        """Records an error or warning."""
        if message.type in {"error", "warning"} and not any(
            text in message.text for text in HARMLESS
        ):
            self.complaints.append(message.text)

    def assert_silent(self) -> None:
        """Fails where the page complained."""
        assert not self.complaints, self.complaints

    def assert_offline(self) -> None:
        """Fails where the page asked for anything that is not in its own file or in memory."""
        outside = [a for a in self.addresses if not a.startswith(("file:", "data:", "blob:"))]
        assert not outside, outside


def find_chromium() -> str:
    """Returns the program, or skips the test; in CI its absence is a failure."""
    program = os.environ.get("RECON_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        message = "no Chromium on PATH (set RECON_CHROMIUM to its path)"
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    return program


@contextmanager
def launch_browser() -> Iterator[Browser]:
    """Yields a headless Chromium, closed at the end."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=find_chromium(), args=ARGUMENTS)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def watch_page(browser: Browser, *, width: int = 1280, height: int = 800) -> Iterator[WatchedPage]:
    """Yields a fresh page of `width x height` CSS pixels, closed at the end."""
    page = browser.new_page(viewport={"width": width, "height": height})
    watched_page = WatchedPage(page)
    page.on("console", watched_page.record_message)
    page.on("pageerror", lambda error: watched_page.complaints.append(str(error)))
    page.on("request", lambda request: watched_page.addresses.append(request.url))
    try:
        yield watched_page
    finally:
        page.close()
