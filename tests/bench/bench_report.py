"""Size of the report and time to open it: `python tests/bench/bench_report.py WORKSPACE...`.

Printed per workspace: seconds to write the page, its size, and the time until headless Chromium has
fired the load event of the file, as the median and range of several openings. Chromium is started
before; its caches know nothing of the file's content.

With --views N also what becomes of a large capture: N held-out views of two models as large as the
frames of the first workspace, some of which are taken for the truth and, blurred, for the renders.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from pathlib import Path

import click
import cv2

from recon_cli.evaluation.metrics import CONVENTIONS
from recon_cli.evaluation.scores import Metrics, ModelMetrics, Table, ViewScore
from recon_cli.io.images import read_png, write_png
from recon_cli.pipeline.execute import Job
from recon_cli.report.build import write_report
from recon_cli.report.gallery import MAX_FILE_BYTES, build_gallery
from recon_cli.report.records import MODELS
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.records import FOLDER

sys.path.append(str(Path(__file__).resolve().parents[1]))
from browser import launch_browser, watch_page

DISTINCT = 10  # frames that the views of a large capture are made of
RESERVED = 500_000  # bytes for the rest of the page
_LOAD = "() => { const t = performance.getEntriesByType('navigation')[0]; return t.loadEventEnd; }"


@click.command()
@click.argument("workspaces", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--times", default=7, show_default=True, help="Openings of each page.")
@click.option("--views", default=0, help="Held-out views of a large capture.  [default: none]")
def main(workspaces: tuple[Path, ...], times: int, views: int) -> None:
    """Writes the report of each workspace to a temporary folder and opens it."""
    rows = []
    with tempfile.TemporaryDirectory() as folder, launch_browser() as started:
        for workspace in workspaces:
            path = Path(folder) / "report.html"
            begin = time.perf_counter()
            write_report(Job(Workspace(workspace)), path)
            wrote, opened = time.perf_counter() - begin, []
            for _ in range(times):
                with watch_page(started) as page:
                    page.page.goto(path.as_uri(), wait_until="load")
                    page.page.wait_for_timeout(50)  # the event is over when its end is noted
                    opened.append(page.page.evaluate(_LOAD))
                    page.assert_silent()
            rows.append((workspace.name, f"{wrote:.1f}", f"{path.stat().st_size / 1e6:.2f}",
                         f"{statistics.median(opened):.0f}",
                         f"{min(opened):.0f} to {max(opened):.0f}"))
    click.echo(Table(
        ("workspace", "write s", "MB", "load ms", "range"), tuple(rows)).text(rule=True))
    if views:
        click.echo(large(workspaces[0], views))


def large(workspace: Path, views: int) -> str:
    """Returns in words how many views are shown, how large, and the CPU seconds that it took."""
    frames = sorted((workspace / "ingest" / FOLDER).iterdir())[:DISTINCT]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for place in ("truth", *(f"renders/{model}" for model in MODELS)):
            (root / place).mkdir(parents=True)
            for index, path in enumerate(frames):
                image = read_png(path)
                write_png(root / place / f"{index}.png",
                          image if place == "truth" else cv2.GaussianBlur(image, (0, 0), 2))
            for index in range(len(frames), views):
                (root / place / f"{index}.png").symlink_to(
                    root / place / f"{index % len(frames)}.png")
        model = ModelMetrics.from_views(
            tuple(ViewScore(f"{i}.png", i, i, 1.0, 1.0) for i in range(views)), gaussians=1,
            bytes=1, render_ms=1.0)
        metrics = Metrics(
            models=dict.fromkeys(MODELS, model), truth_digest="", lpips_convention="", width=1,
            height=1, test_views=views, unregistered_test=(), **CONVENTIONS)
        begin = time.process_time()
        gallery = build_gallery(root, metrics, MAX_FILE_BYTES - RESERVED)
        seconds = time.process_time() - begin
    size = sum(view.size for view in gallery.views) / 1e6
    width, height = gallery.full
    return (f"{len(gallery.views)} of {views} views of {width}x{height}: {gallery.encoding}, "
            f"{size:.1f} MB, {seconds / views:.2f} CPU s a view")


if __name__ == "__main__":
    main()
