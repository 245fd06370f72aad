"""The page of a scene in headless Chromium: `PYTHONPATH=tests python tests/bench/bench_html.py`.

Each FOLDER is that of an export with `splats.html`: the page is opened at its cameras and held
against recon's own renderer at the same size, of the page's `splats.ply`. With --made N a made room
of N Gaussians is opened, too. Chromium draws on the CPU (SwiftShader), so that frames a second are
those of the worst machine, not of a graphics card. CPU seconds are those of all threads of
Chromium; they change little where other programs run.
"""

from __future__ import annotations

import io
import json
import re
import tempfile
import time
from pathlib import Path
from typing import Any

import click
import numpy as np
import psutil
import torch
from archive_splats import room
from browser import WatchedPage, launch_browser, watch_page
from numpy.typing import NDArray
from PIL import Image

from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.splats.html import write_html
from recon_cli.splats.ply import read_ply, write_ply

SIDE = 600  # pixels of the longer side
WALK_FRAMES, WALK_SECONDS = 20, 40  # whichever is reached first


def told(page: Path) -> dict[str, Any]:
    """Returns what a page tells its viewer."""
    found = re.search(
        r'<script id="views" type="application/json">(.*?)</script>', page.read_text("utf-8"))
    assert found
    value: dict[str, Any] = json.loads(found[1])
    return value


def in_window(view: dict[str, Any], lens: dict[str, Any], width: int, height: int) -> Camera:
    """Returns the camera of a view in a window, by the rule of the viewer."""
    fit = (lens["width"] / width * lens["height"] / height) ** 0.5
    viewmat = np.eye(4)
    pose = np.array(view["pose"]).reshape(3, 4)
    viewmat[:3, :3] = pose[:, :3].T
    viewmat[:3, 3] = -pose[:, :3].T @ pose[:, 3]
    return Camera(
        width, height, lens["fx"] / fit, lens["fy"] / fit,
        (lens["cx"] - lens["width"] / 2) / fit + width / 2,
        (lens["cy"] - lens["height"] / 2) / fit + height / 2, viewmat)


def opened(page: WatchedPage, path: Path) -> float:
    """Opens a page and returns the seconds until it shows the scene."""
    begin = time.perf_counter()
    page.page.goto(path.absolute().as_uri())
    page.page.wait_for_selector("#message:empty", state="attached", timeout=300_000)
    return time.perf_counter() - begin


def picture(page: WatchedPage, number: int) -> NDArray[np.float64]:
    """Returns what the page shows of a view, [H, W, 3] in [0, 1]."""
    page.page.evaluate(f"recon.show({number})")
    page.page.evaluate("recon.settled()")
    png = Image.open(io.BytesIO(page.page.screenshot(timeout=120_000))).convert("RGB")
    return np.asarray(png).astype(np.float64) / 255


def cpu_seconds() -> float:
    """Returns what the processes that this one started have used."""
    times = [child.cpu_times() for child in psutil.Process().children(recursive=True)]
    return float(sum(one.user + one.system for one in times))


def walked(page: WatchedPage) -> str:
    """Returns frames a second and CPU seconds a frame while somebody walks."""
    page.page.keyboard.down("w")
    page.page.wait_for_timeout(500)
    begin, used, first = time.perf_counter(), cpu_seconds(), page.page.evaluate("recon.drawn()")
    drawn, seconds = 0.0, 0.0
    while drawn < WALK_FRAMES and seconds < WALK_SECONDS:
        page.page.wait_for_timeout(500)
        drawn = page.page.evaluate("recon.drawn()") - first
        seconds = time.perf_counter() - begin
    used = cpu_seconds() - used
    page.page.keyboard.up("w")
    return f"{drawn / seconds:.1f} | {used / max(drawn, 1):.2f}"


def measured(folder: Path, views: int, keep: Path | None) -> str:
    """Returns the row of one exported scene."""
    path, splats = folder / "splats.html", read_ply(folder / "splats.ply")
    value = told(path)
    lens = value["lenses"][value["views"][0]["lens"]]
    reduced = SIDE / max(lens["width"], lens["height"])
    width, height = (round(lens[name] * reduced) for name in ("width", "height"))
    scores = []
    with launch_browser() as started, watch_page(started, width=width, height=height) as page:
        seconds = opened(page, path)
        page.page.add_style_tag(content="footer { visibility: hidden }")
        count = len(value["views"])
        for number in sorted({1 + count * i // views for i in range(views)}):
            view = value["views"][number - 1]
            camera = in_window(view, value["lenses"][view["lens"]], width, height)
            with torch.no_grad():
                rgb = render(splats, camera, splats.background, splats.sh_degree).rgb
            seen, want = picture(page, number), rgb.clamp(0, 1).double().numpy()
            scores.append(-10 * np.log10(((seen - want) ** 2).mean()))
            if keep:
                both = np.hstack([seen, want, np.clip(8 * abs(seen - want), 0, 1)])
                Image.fromarray((both * 255).astype(np.uint8)).save(
                    keep / f"{folder.parent.name}-{number}.png")
        speed = walked(page)
        page.assert_silent()
        page.assert_offline()
    return (f"| {folder.parent.name} | {len(splats):,} | {splats.sh_degree} | {width}x{height} | "
            f"{path.stat().st_size / 1e6:.1f} | {seconds:.1f} | {np.mean(scores):.1f} "
            f"({min(scores):.1f}) | {speed} |")


@click.command()
@click.argument("folders", nargs=-1, type=click.Path(
    exists=True, file_okay=False, path_type=Path))
@click.option("--made", multiple=True, type=int, help="Gaussians of a made room to open, too.")
@click.option("--views", default=6, show_default=True, help="Cameras that are held against recon.")
@click.option("--keep", type=click.Path(file_okay=False, path_type=Path),
              help="Folder for the pictures side by side, and their difference times 8.")
def main(folders: tuple[Path, ...], made: tuple[int, ...], views: int, keep: Path | None) -> None:
    """Print how well pages agree with recon's renderer, and how fast they are."""
    if keep:
        keep.mkdir(parents=True, exist_ok=True)
    click.echo("| scene | Gaussians | degree | pixels | MB | s to open | dB, mean (least) "
               "| frames/s | CPU s a frame |\n|---|---:|---:|---|---:|---:|---:|---:|---:|")
    for folder in folders:
        click.echo(measured(folder, views, keep))
    for count in made:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary) / f"made {count}" / "export"
            folder.mkdir(parents=True)
            splats = room(count)
            splats.log_scales -= np.log(count / 3000) / 2  # as much of them a pixel
            camera = Camera(SIDE, 450, 500.0, 500.0, SIDE / 2, 225.0, np.eye(4))
            write_ply(folder / "splats.ply", splats)
            write_html(folder / "splats.html", splats, up=np.array([0.0, -1, 0]),
                       views=[("", camera)])
            click.echo(measured(folder, views, keep))


if __name__ == "__main__":
    main()
