"""Walks of several lengths through sfm: `python tests/bench/bench_segments.py APARTMENT OUT N...`.

APARTMENT is a folder that make_apartment.py wrote; a walk of N frames is the first N of it. Printed
is a row for each: frames with a camera, how far the cameras are from the true ones, and what sfm
took, with the exponent of its CPU seconds over the frames from the row before. `--set` passes
options to sfm. Walks that are finished in OUT are not run again.
"""

from __future__ import annotations

import json
import math
from dataclasses import astuple
from pathlib import Path

import click
import cv2
import numpy as np
from pose_errors import compare, model_poses, reference_poses
from workbench import FOLDER, print_head, print_row, read_json, run_recon

from recon_cli.flythrough.output import VideoEncoding, encode_video

HEADINGS = (
    "frames", "registered", "segments", "centre RMSE", "largest", "rotation", "sfm CPU s", "wall s",
    "CPU s a frame", "exponent", "MB", "parts: CPU s", "ended with")
FPS = 10.0


def prepare(apartment: Path, count: int, workspace: Path) -> None:
    """Makes the video of the first frames, and runs the stages before sfm."""
    pictures = sorted((apartment / "results").glob("frame*.jpg"))[:count]
    if len(pictures) < count:
        raise click.ClickException(f"{apartment} has {len(pictures)} frames, not {count}.")
    height, width = cv2.imread(str(pictures[0])).shape[:2]
    video = workspace.parent / f"{count}.mp4"
    encode_video(pictures, video, VideoEncoding("h264", 18, width, height, FPS), threads=2,
                 on_frame=lambda: None)
    # every frame of it: the walk has no blurred ones
    for verb, options in (("ingest", (str(video), "--frames", str(count), "--sharpness", "0")),
                          ("denoise", ("--off",))):
        done = run_recon(workspace, verb, *options)
        if done.code:
            raise click.ClickException(done.error)
        click.echo(f"{verb} of {count} frames: {done.cpu_seconds:.0f} s of CPU, "
                   f"{done.seconds:.0f} s", err=True)


def row(apartment: Path, count: int, workspace: Path, options: tuple[str, ...]) -> dict[str, str]:
    """Returns the cells of a walk, and its CPU seconds under "cpu"."""
    measured = workspace.parent / f"{count}.json"
    if not (workspace / "ingest" / "manifest.json").exists():
        prepare(apartment, count, workspace)
    if not measured.exists():
        done = astuple(run_recon(workspace, "sfm", *options))
        measured.write_text(json.dumps(done), encoding="utf-8")
    code, error, cpu, wall = read_json(measured)
    cells = {"frames": str(count), "sfm CPU s": f"{cpu:.0f}", "wall s": f"{wall:.0f}",
             "CPU s a frame": f"{cpu / count:.2f}", "cpu": str(cpu)}
    if code:
        return {**cells, "ended with": f"exit {code}: {error}"}
    manifest = read_json(workspace / "sfm" / "manifest.json")
    summary = read_json(workspace / "place" / "manifest.json")["summary"]
    errors = compare(model_poses(workspace / "place" / "sparse"),
                     reference_poses(apartment / "traj.txt"))
    truth = np.array([pose[:3, 3] for pose in reference_poses(apartment / "traj.txt").values()])
    extent = float(np.linalg.norm(np.ptp(truth[:count], axis=0)))
    segments = summary.get("segments")
    return {
        **cells, "registered": f"{summary['registered']} ({summary['registered'] / count:.1%})",
        "segments": "" if segments is None else str(segments),
        "centre RMSE": f"{errors.rmse / extent:.3%} ({100 * errors.rmse:.1f} cm)",
        "largest": f"{errors.max_share:.2%}",
        "rotation": f"{errors.own_rotation_deg:.2f} / {errors.own_rotation_max_deg:.2f} deg",
        "MB": f"{manifest['peak_memory_bytes'] / 1e6:.0f}",
        "parts: CPU s": ", ".join(
            f"{name} {seconds:.0f}"
            for name, seconds in (summary.get("cpu_seconds") or summary["seconds"]).items()),
        "ended with": "trusted" if summary["verdict"]["trusted"] else "untrusted"}


@click.command()
@click.argument("apartment", type=FOLDER)
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.argument("counts", nargs=-1, type=int)
@click.option("--sfm", "options", multiple=True, help="An option of sfm, word by word.")
def main(apartment: Path, out: Path, counts: tuple[int, ...], options: tuple[str, ...]) -> None:
    """Prints a Markdown table, a row as soon as it is known."""
    print_head(*HEADINGS)
    before: tuple[int, float] | None = None
    for count in counts or (300, 600, 1200):
        workspace = out.resolve() / str(count)
        workspace.parent.mkdir(parents=True, exist_ok=True)
        cells = row(apartment, count, workspace, options)
        cpu = float(cells.pop("cpu"))
        if before is not None:
            cells["exponent"] = f"{math.log(cpu / before[1]) / math.log(count / before[0]):.2f}"
        before = count, cpu
        print_row(*(cells.get(name, "") for name in HEADINGS))


if __name__ == "__main__":
    main()
