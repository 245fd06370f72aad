"""A viewer in this process, and how to wait for what becomes of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from browser import WatchedPage

from recon_cli.pipeline.plan import Job
from recon_cli.viewer.content import PhotoPairs, ViewerContent, load_workspace
from recon_cli.viewer.server import HOST, Server, serve_scene
from recon_cli.viewer.trust_tint import TrustTint
from recon_cli.workspace.layout import Workspace

T = TypeVar("T")
# A warning of the page's own libraries about themselves.
FOREIGN = ("THREE.Clock: This module has been deprecated",)
PATIENCE = 60  # seconds; a browser without a GPU on a busy machine is slow


@dataclass
class Shown:
    """A running viewer."""

    server: Server
    address: str
    content: ViewerContent

    def client(self) -> Any:
        """Returns the only browser."""
        (client,) = self.server.get_clients().values()
        return client


@contextmanager
def view(workspace: Path) -> Iterator[Shown]:
    job = Job(Workspace(workspace))
    content = load_workspace(job, "auto")
    photos = PhotoPairs(job, content.max_size)
    with serve_scene(content, photos, HOST, None, TrustTint(job)) as (server, address):
        yield Shown(server, address, content)


def until(page: WatchedPage, ask: Callable[[], T]) -> T:
    """Returns what `ask` gives as soon as that is true, and fails where it never is."""
    end = time.monotonic() + PATIENCE
    while not (found := ask()):
        assert time.monotonic() < end, f"never true: {ask}, {page.page.inner_text('body')}"
        page.page.wait_for_timeout(50)
    return found


def opened(page: WatchedPage, shown: Shown) -> Any:
    """Opens the viewer and returns its client once the panel is there."""
    page.page.set_viewport_size({"width": 640, "height": 480})
    page.page.goto(shown.address)
    page.page.get_by_text("Gaussians (").wait_for(timeout=1000 * PATIENCE)
    return shown.client()


def nodes(page: WatchedPage, kind: str) -> dict[str, Any]:
    """Returns the visible scene nodes of a kind in the browser, by name."""
    found: dict[str, Any] = page.page.evaluate(
        """kind => Object.fromEntries(Object.entries(window.__viserSceneTree.getState())
            .filter(([_, node]) => node && node.message.type === kind
                    && (node.effectiveVisibility ?? true))
            .map(([name, _]) => [name, true]))""", kind)
    return found


def complaints(page: WatchedPage) -> list[str]:
    return [text for text in page.complaints if not any(known in text for known in FOREIGN)]
