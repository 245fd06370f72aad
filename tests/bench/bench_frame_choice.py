"""Makes a hard video of a rendered room and counts the blurred frames among those chosen.

`python tests/bench/bench_frame_choice.py ROOM OUT [--frames 40] [--seed 0]`, with ROOM a folder in
the Replica layout of NICE-SLAM (results/, traj.txt). OUT/video.mp4 gets 880 frames: the path is
walked forwards and backwards at a changing pace, with spells where the camera rests, and 269 frames
are smeared along a line. OUT/ws is then a workspace that `recon sfm -w OUT/ws` goes on from.
Printed are the blurred frames among the chosen ones, for every 22nd frame and for ours, and how
evenly the chosen frames lie along the true path.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import av
import click
import cv2
import numpy as np
from numpy.typing import NDArray

from recon_cli.cli import main as recon

FRAMES, BLURRED = 880, 269
RATE = 30  # frames per second
# A second of shake blurs a run of frames, a jerk a single one.
LONGEST_RUN = 6
# Pixels at 600x340. 4 halve the sharpness of the plainest views; below that a frame is as good as
# its neighbours.
BLUR_LENGTHS = (9, 21)
QUALITY = {"crf": "20", "preset": "veryfast"}
# Pace over a lap of the video, in frames of the path for each of the video: fast, slow, at rest.
PACES = ((0.9, 60), (0.0, 45), (0.25, 120), (0.5, 80), (0.0, 30), (0.15, 105))
# Of the scene: how far a turn of one radian counts as way, so that turning on the spot is some.
METRES_PER_RADIAN = 1.0


@dataclass(frozen=True)
class Plan:
    """What is filmed.

    Attributes:
        places: [FRAMES] index of the room's frame that is shown.
        blurred: [FRAMES] bool.
    """

    places: NDArray[np.int64]
    blurred: NDArray[np.bool_]


def planned(count: int, random: np.random.Generator) -> Plan:
    """Returns a walk over `count` frames of a path, there and back, and what is blurred of it."""
    pace = np.concatenate([np.full(length, speed) for speed, length in PACES])
    steps = np.resize(pace, FRAMES)
    lap = 2 * (count - 1)
    along = np.cumsum(steps) % lap
    places = np.round(np.minimum(along, lap - along)).astype(np.int64)
    blurred = np.zeros(FRAMES, np.bool_)
    while blurred.sum() < BLURRED:
        first = int(random.integers(FRAMES))
        run = min(int(random.integers(1, LONGEST_RUN + 1)), BLURRED - int(blurred.sum()))
        blurred[first:first + run] = True
    return Plan(places, blurred)


def motion_blurred(rgb: NDArray[np.uint8], length: int, angle: float) -> NDArray[np.uint8]:
    """Returns a frame smeared along a line of `length` pixels at `angle` in radians."""
    kernel = np.zeros((length, length), np.float32)
    middle, half = (length - 1) / 2, length / 2
    ends = np.array([[-1, -1], [1, 1]]) * half * [np.cos(angle), np.sin(angle)] + middle
    cv2.line(kernel, *(tuple(map(int, np.round(end))) for end in ends), 1.0)
    return cv2.filter2D(rgb, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)


def film(path: Path, images: list[Path], plan: Plan, random: np.random.Generator) -> None:
    """Writes the video as H.264."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=RATE, options=QUALITY)
        stream.pix_fmt = "yuv420p"
        stream.height, stream.width = cv2.imread(str(images[0])).shape[:2]
        for place, blur in zip(plan.places, plan.blurred, strict=True):
            rgb = cv2.cvtColor(cv2.imread(str(images[place])), cv2.COLOR_BGR2RGB)
            if blur:
                length = int(random.integers(*BLUR_LENGTHS)) | 1
                # Hands turn a phone sideways more than up and down.
                rgb = motion_blurred(rgb, length, float(random.normal(0, 0.3)))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, "rgb24")))
        container.mux(stream.encode())


def true_way(poses: NDArray[np.float64], places: NDArray[np.int64]) -> NDArray[np.float64]:
    """Returns the way of the camera up to each frame of the video, turns counted as metres."""
    shown = poses[places]
    moved = np.linalg.norm(np.diff(shown[:, :3, 3], axis=0), axis=1)
    turns = np.einsum("fij,fij->f", shown[1:, :3, :3], shown[:-1, :3, :3])  # trace of R1 R0^T
    angles = np.arccos(np.clip((turns - 1) / 2, -1, 1))
    return np.concatenate([[0.0], np.cumsum(moved + METRES_PER_RADIAN * angles)])


def told(label: str, chosen: NDArray[np.int64], plan: Plan, way: NDArray[np.float64]) -> str:
    """Returns a line about a choice."""
    steps = np.diff(way[chosen])
    repeated = int((np.diff(plan.places[chosen]) == 0).sum())
    return (
        f"{label:<8} {len(chosen)} frames, {int(plan.blurred[chosen].sum()):>2} blurred, "
        f"{repeated:>2} the same view as the one before, "
        f"step {steps.mean():.3f} +- {steps.std():.3f}, largest {steps.max():.3f}")


@click.command()
@click.argument("room", type=click.Path(exists=True, path_type=Path))
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--frames", default=40, show_default=True, help="How many to choose.")
@click.option("--seed", default=0, show_default=True, help="Of what is blurred, and how.")
def main(room: Path, out: Path, frames: int, seed: int) -> None:
    """Films ROOM into OUT and compares the choice of frames."""
    random = np.random.default_rng(seed)
    images = sorted((room / "results").glob("frame*.jpg"))
    plan = planned(len(images), random)
    out.mkdir(parents=True, exist_ok=True)
    video, workspace = out / "video.mp4", out / "ws"
    film(video, images, plan, random)
    np.savetxt(out / "places.txt", plan.places, fmt="%d")
    resting = int((np.diff(plan.places) == 0).sum())
    click.echo(
        f"{FRAMES} frames, {int(plan.blurred.sum())} of them blurred, {resting} like the one "
        "before")
    code = recon(["ingest", str(video), "-w", str(workspace), "--frames", str(frames)])
    if code:
        raise SystemExit(code)
    listed = json.loads((workspace / "ingest" / "frames.json").read_text(encoding="utf-8"))
    ours = np.array([int(Path(frame["name"]).stem) for frame in listed["frames"]])
    way = true_way(np.loadtxt(room / "traj.txt").reshape(-1, 4, 4), plan.places)
    even = np.round(np.linspace(0, FRAMES - 1, frames)).astype(np.int64)
    click.echo(told("uniform", even, plan, way))
    click.echo(told("ours", ours, plan, way))


if __name__ == "__main__":
    main()
