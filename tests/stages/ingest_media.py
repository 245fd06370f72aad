"""Small videos and photos, and how the tests of ingest run the stage on them."""

import json

import av
import cv2
import numpy as np
from PIL import Image

from recon_cli.config.stages import IngestConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.stages import ingest


def take(source, out, *, config=None, threads=2, record=None):
    out.mkdir(parents=True, exist_ok=True)
    ctx = StageContext(threads=threads, **({"record": record} if record else {}))
    sources = source if isinstance(source, tuple) else (source,)
    return ingest.run(config or IngestConfig(), StageInputs(sources=sources), out, ctx)


def listed(out):
    return json.loads((out / "frames.json").read_text())


def files(out):
    """Every file of a folder with its bytes."""
    return {
        str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}


def blocks(height, width, seed=0):
    colours = np.random.default_rng(seed).integers(30, 226, (height // 4, width // 4, 3))
    return np.kron(colours, np.ones((4, 4, 1), int)).astype(np.uint8)


def write_video(path, frames, *, options=None):
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.codec_context.options = {"qp": "10", **(options or {})}
        images = (av.VideoFrame.from_ndarray(np.ascontiguousarray(f), "rgb24") for f in frames)
        for image in [*images, None]:
            for packet in stream.encode(image):
                container.mux(packet)
    return path


def walk(frames, step=4, height=96, width=128):
    wide = blocks(height, width + frames * step)
    return [wide[:, i * step:i * step + width] for i in range(frames)]


def write_photos(folder, count, *, size=(64, 48), suffix=".jpg"):
    folder.mkdir(exist_ok=True)
    for index in range(count):
        rgb = blocks(size[1], size[0], seed=index)
        Image.fromarray(rgb).save(folder / f"IMG_{index:04d}{suffix}")
    return folder


def write_sequence(folder, count):
    """Writes every frame of a camera that moves sideways past a smooth wall, 2 of 256 pixels."""
    folder.mkdir()
    colours = np.random.default_rng(0).integers(30, 226, (4, 6 + 2 * count // 48, 3), np.uint8)
    wide = cv2.GaussianBlur(np.kron(colours, np.ones((48, 48, 1), np.uint8)), None, 2.0)
    for index in range(count):
        Image.fromarray(wide[:, 2 * index:2 * index + 256]).save(
            folder / f"frame_{index:04d}.jpg", quality=95)
    return folder
