"""The table of a batch, and its page: one HTML file that links to the scenes beside it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

from recon_cli.evaluation.scores import Table, or_dash
from recon_cli.pipeline.batch import CaptureResult
from recon_cli.progress import format_duration
from recon_cli.report.build import render_template
from recon_cli.report.gallery import read_picture
from recon_cli.workspace import atomic
from recon_cli.workspace.layout import disk_errors

FILE = "batch.html"
_HEADINGS = ("capture", "exit code", "frames", "registered", "PSNR, dB", "SSIM", "Gaussians", "MB",
             "time")


def batch_text(results: Sequence[CaptureResult]) -> str:
    """Returns a line for each capture below the headings, with the reason where it failed."""
    lines = Table(_HEADINGS, [_cells(result) for result in results]).text().splitlines()
    reasons = ["", *(result.reason for result in results)]
    return "\n".join(
        f"{line}  {reason}".rstrip() for line, reason in zip(lines, reasons, strict=True))


def _cells(result: CaptureResult) -> tuple[str, ...]:
    return (
        result.capture, or_dash(result.exit_code, "d"), or_dash(result.frames, ",d"),
        or_dash(result.registered, ",d"), or_dash(result.psnr_db, ".2f"),
        or_dash(result.ssim, ".4f"), or_dash(result.gaussians, ",d"),
        "-" if result.bytes is None else f"{result.bytes / 1e6:.1f}",
        format_duration(result.seconds or 0.0))


def write_batch_page(results: Sequence[CaptureResult], out: Path) -> Path:
    """Writes batch.html into the folder of a batch and returns its path.

    Raises:
        WorkspaceError: it cannot be written.
    """
    page = render_template(
        "batch.html.j2", name=out.absolute().name,
        date=datetime.now().strftime("%Y-%m-%d %H:%M"), headings=_HEADINGS,
        done=sum(result.succeeded for result in results),
        rows=[(result, _cells(result), quote(result.capture), _picture(out / result.capture))
              for result in results])
    path = out / FILE
    with disk_errors(out, "writing the page"):
        atomic.write_text(path, page)
    return path


def _picture(workspace: Path) -> str:
    """Returns a held-out view as the scene shows it, as a data URI; empty where there is none."""
    renders = sorted(workspace.glob("evaluate/renders/*/*.png"))
    return read_picture(renders[0]) if renders else ""
