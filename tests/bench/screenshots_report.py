"""The picture of the report in the docs: `python tests/bench/screenshots_report.py WORKSPACE`.

Writes docs/images/report.webp: the held-out views in light, the training in dark, side by side.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

import click
from PIL import Image
from workbench import workspace_argument

from recon_cli.pipeline.execute import Job
from recon_cli.report.build import write_report
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.layout import Workspace

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tests"))
from browser import launch_browser, watch_page  # noqa: E402

PICTURE = ROOT / "docs" / "images" / "report.webp"
MOST_BYTES = 300_000
WIDTH, HEIGHT, GAP = 1060, 960, 24


@click.command()
@workspace_argument
def main(workspace: Path) -> None:
    """Writes the picture and says how large it is."""
    with tempfile.TemporaryDirectory() as folder, launch_browser() as started:
        path = Path(folder) / "report.html"
        write_report(Job(Workspace(workspace)), path)
        shots = []
        for section, scheme in (("views", "light"), ("training", "dark")):
            with watch_page(started, width=WIDTH, height=HEIGHT) as page:
                page.page.emulate_media(color_scheme=scheme)
                page.page.goto(path.as_uri())
                page.page.click(f"#tab-{section}")
                page.page.wait_for_timeout(300)  # pictures are decoded after the load event
                shots.append(Image.open(io.BytesIO(page.page.screenshot())).convert("RGB"))
                page.assert_silent()
    picture = Image.new("RGB", (2 * WIDTH + GAP, HEIGHT), (128, 128, 128))
    for index, shot in enumerate(shots):
        picture.paste(shot, (index * (WIDTH + GAP), 0))
    for quality in range(90, 30, -10):
        data = io.BytesIO()
        picture.save(data, "WEBP", quality=quality, method=6)
        if data.tell() <= MOST_BYTES:
            break
    write_bytes(PICTURE, data.getvalue())
    click.echo(f"{PICTURE}: {data.tell() / 1e3:.0f} kB at quality {quality}")


if __name__ == "__main__":
    main()
