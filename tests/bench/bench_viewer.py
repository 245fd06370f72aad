"""How close `recon view` is to recon's renders: `python tests/bench/bench_viewer.py WORKSPACE`.

Prints, for every held-out view, the PSNR of the picture in headless Chromium against recon's own of
the same camera and size, without harmonics, over black. The pixels come from the page's canvas by
viser's get_render, which leaves the panel out.

`--picture FILE` takes a picture of the page for the documentation and nothing else.
"""

from __future__ import annotations

import dataclasses
import io
import statistics
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click
import numpy as np
import torch
import viser.transforms
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from browser import launch_browser, watch_page
from workbench import workspace_argument

from recon_cli.evaluation.metrics import psnr
from recon_cli.io.images import fit_camera, to_uint8
from recon_cli.pipeline.execute import render_context
from recon_cli.pipeline.plan import Job
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.viewer.content import (
    HELD_OUT,
    PhotoPairs,
    ViewerContent,
    browser_camera,
    load_workspace,
    move_browser,
)
from recon_cli.viewer.server import HOST, serve_scene
from recon_cli.workspace.layout import Workspace

DRAWN = """() => Object.values(window.__viserSceneTree?.getState() ?? {}).some(
    node => node?.message.type === 'GaussianSplatsMessage')"""
WIDTH, HEIGHT = 1280, 720


def truth(chromium: Browser, workspace: Path) -> Iterator[str]:
    """Yields a line for each held-out view, and one for their mean."""
    job = Job(Workspace(workspace))
    content = load_workspace(job, "auto")
    name, shown = next(iter(content.models.items()))
    splats = shown.splats.with_degree(0)
    flat = dataclasses.replace(content, models={name: dataclasses.replace(shown, splats=splats)})
    ctx = render_context(job.compute, job.progress)
    found = []
    with (serve_scene(flat, None, HOST, None) as (server, address),
          watch_page(chromium, width=WIDTH, height=HEIGHT) as page,
          ThreadPoolExecutor(1) as elsewhere):
        page.page.goto(address)
        page.page.wait_for_function(DRAWN)
        page.page.wait_for_timeout(3000)
        (client,) = server.get_clients().values()
        for one in content.views:
            if one.part == HELD_OUT:
                camera = fit_camera(one.view.camera, content.max_size)
                with torch.no_grad():
                    ours = render(splats, camera, splats.background, 0, backend=ctx.backend).rgb
                page.page.set_viewport_size({"width": camera.width, "height": camera.height})
                asked = elsewhere.submit(drawn, client, content, camera)
                while not asked.done():
                    page.page.wait_for_timeout(20)
                found.append(psnr(asked.result(), to_uint8(ours.numpy())))
                yield (f"{one.view.name} {camera.width}x{camera.height}: {found[-1]:.2f} dB "
                       "between the browser and recon")
    yield f"least {min(found):.2f} dB, mean {statistics.fmean(found):.2f} dB"


def drawn(
    client: viser.ClientHandle, content: ViewerContent, camera: Camera
) -> NDArray[np.float32]:
    """Returns the browser's picture of a camera of the size of its page, over black."""
    target = browser_camera(camera, content.distance, content.start.far)
    move_browser(client, target, content.up, camera)
    # get_render projects with the lens of the picture before
    while (client.camera.image_width, client.camera.image_height) != (camera.width, camera.height):
        time.sleep(0.05)
    client.get_render(camera.height, camera.width)
    rgba = client.get_render(camera.height, camera.width, transport_format="png").astype(np.float32)
    return rgba[..., :3] * rgba[..., 3:] / 255**2


def photographed(chromium: Browser, workspace: Path, path: Path) -> None:
    """Takes a picture of the page, with a held-out view beside its photo."""
    job = Job(Workspace(workspace))
    content = load_workspace(job, "auto")
    with (serve_scene(content, PhotoPairs(job, content.max_size), HOST, None) as (_, address),
          watch_page(chromium, width=WIDTH, height=HEIGHT) as page):
        page.page.goto(address)
        page.page.wait_for_function(DRAWN)
        # viser warns of a browser without a GPU
        page.page.locator(".mantine-Notification-closeButton").first.click()
        page.page.get_by_text("next", exact=True).click()
        page.page.get_by_text("PSNR").wait_for()
        page.page.get_by_label("Cameras").locator("visible=true").click()
        page.page.mouse.move(WIDTH / 3, HEIGHT / 2)
        page.page.mouse.wheel(0, 500)
        page.page.wait_for_timeout(8000)
        taken = page.page.screenshot()
    with Image.open(io.BytesIO(taken)) as image:
        image.save(path, quality=85)


@click.command()
@workspace_argument
@click.option("--picture", type=click.Path(path_type=Path))
def main(workspace: Path, picture: Path | None) -> None:
    """Prints the figures of a workspace."""
    with launch_browser() as chromium:
        if picture is not None:
            photographed(chromium, workspace, picture)
            return
        for line in truth(chromium, workspace):
            click.echo(line)


if __name__ == "__main__":
    main()
