"""Inputs of sfm, made on the spot, and frames that defeat it."""

import io
from collections.abc import Iterator
from contextlib import contextmanager

import av
import cv2
import numpy as np
import pytest

from recon_cli.config.stages import SfmConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.io.images import write_png
from recon_cli.sfm.job import Reporter
from recon_cli.sfm.mapping import process, worker
from recon_cli.sfm.views import undistort
from recon_cli.stages import place, sfm
from recon_cli.workspace.records import Frame, FrameList, Group


def every_nth(video, step, count):
    """The first `count` frames of each `step` of a video, RGB by name."""
    return {
        f"{index:06d}.png": frame.to_ndarray(format="rgb24")
        for index, frame in enumerate(av.open(str(video)).decode(video=0))
        if index % step == 0 and index < step * count
    }


def write_inputs(base, images, *, filtered=(), held_out=(), fps=None):
    """Writes the finished folders of ingest and denoise; `images` maps names to RGB pixels.

    With `fps` the names are numbers of frames in a video.
    """
    for stage in ("ingest", "denoise"):
        (base / stage / "frames").mkdir(parents=True)
    for name, rgb in images.items():
        write_png(base / "ingest" / "frames" / name, rgb)
        twin = cv2.GaussianBlur(rgb, (0, 0), 2) if name in filtered else rgb
        write_png(base / "denoise" / "frames" / name, np.asarray(twin))
    height, width = next(iter(images.values())).shape[:2]
    FrameList("video", (Group("room.mp4", width, height),), tuple(
        Frame(name, int(name[:6]) / fps if fps else None, "room.mp4", None, name in held_out)
        for name in sorted(images)
    )).write(base / "ingest")
    return base


def run(base, out, *, ctx=None, **options):
    out.mkdir(exist_ok=True)
    """Maps the frames and places a part of them, in one folder; returns the summary of place."""
    ctx, config = ctx or StageContext(threads=2), SfmConfig(**options)
    found = sfm.run(config, StageInputs({"ingest": base / "ingest"}), out, ctx)
    return run_place(base, out, found, out, ctx=ctx, **options)


def run_place(base, mapped, found, out, *, ctx=None, **options):
    """Places a part of what was found into `out`."""
    out.mkdir(exist_ok=True)
    inputs = StageInputs(
        {"ingest": base / "ingest", "denoise": base / "denoise", "sfm": mapped},
        summaries={"sfm": found.to_json()})
    return place.run(SfmConfig(**options), inputs, out, ctx or StageContext(threads=2))


@contextmanager
def mapping_here() -> Iterator[None]:
    """Maps in this process: to start another one takes longer than a small capture does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(process, "run_job", lambda job, **_: worker.work(job, Reporter(io.BytesIO())))
        patch.setattr(process, "_run", lambda job, *_: undistort.place(job, Reporter(io.BytesIO())))
        yield


def run_here(base, out, *, ctx=None, **options):
    """Does as `run` in this process; nothing is told while the capture is mapped."""
    with mapping_here():
        return run(base, out, ctx=ctx, **options)


def texture(height, width, seed):
    """Noise on five scales, full of keypoints, [H, W, 3]."""
    noise = np.random.default_rng(seed)
    total = sum(
        scale**0.5 * cv2.resize(
            noise.normal(size=(height // scale, width // scale, 3)), (width, height),
            interpolation=cv2.INTER_CUBIC)
        for scale in (2, 4, 8, 16, 32))
    return np.asarray(255 * (total - total.min()) / np.ptp(total), np.uint8)


def turning(count):
    """Frames of a camera that turns on the spot: one textured picture through homographies."""
    sky = texture(600, 1200, 0)
    inner = np.array([[250, 0, 120], [0, 250, 90], [0, 0, 1.0]])
    outer = np.array([[250, 0, 600], [0, 250, 300], [0, 0, 1.0]])
    frames = {}
    for index, angle in enumerate(np.linspace(-0.5, 0.5, count)):
        turn, _ = cv2.Rodrigues(np.array([0.1 * np.sin(index), angle, 0]))
        frames[f"{index:06d}.png"] = np.asarray(cv2.warpPerspective(
            sky, outer @ turn @ np.linalg.inv(inner), (240, 180),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP))
    return frames
