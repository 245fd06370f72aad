"""Size of the report and time to open it: `python tests/bench/bench_report.py WORKSPACE...`.

Printed per workspace: seconds to write the page, its size, and the time until headless Chromium has
fired the load event of the file, as the median and range of several openings. Chromium is started
before; its caches know nothing of the file's content.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from pathlib import Path

import click

from recon_cli.execute import Job
from recon_cli.page.write import write
from recon_cli.tables import Table
from recon_cli.workspace import Workspace

sys.path.append(str(Path(__file__).resolve().parents[1]))
from browser import browser, watched

_LOAD = "() => { const t = performance.getEntriesByType('navigation')[0]; return t.loadEventEnd; }"


@click.command()
@click.argument("workspaces", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option("--times", default=7, show_default=True, help="Openings of each page.")
def main(workspaces: tuple[Path, ...], times: int) -> None:
    """Writes the report of each workspace to a temporary folder and opens it."""
    rows = []
    with tempfile.TemporaryDirectory() as folder, browser() as started:
        for workspace in workspaces:
            path = Path(folder) / "report.html"
            begin = time.perf_counter()
            write(Job(Workspace(workspace)), path)
            wrote, opened = time.perf_counter() - begin, []
            for _ in range(times):
                with watched(started) as page:
                    page.page.goto(path.as_uri(), wait_until="load")
                    page.page.wait_for_timeout(50)  # the event is over when its end is noted
                    opened.append(page.page.evaluate(_LOAD))
                    page.assert_silent()
            rows.append((workspace.name, f"{wrote:.1f}", f"{path.stat().st_size / 1e6:.2f}",
                         f"{statistics.median(opened):.0f}",
                         f"{min(opened):.0f} to {max(opened):.0f}"))
    click.echo(Table(
        ("workspace", "write s", "MB", "load ms", "range"), tuple(rows)).text(rule=True))


if __name__ == "__main__":
    main()
