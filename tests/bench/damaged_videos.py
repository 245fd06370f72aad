"""Videos to end in a right model, a trusted part, or exit 5: cut, mirrored, black, turning.

`bench_captures` has them as captures. What is made from a room keeps the place of each frame in
places.txt, -1 where the room's poses do not hold, so that the cameras can be checked.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Frames = Sequence[tuple[int, Image]]  # place in the video they come from, and pixels, RGB
Source = Callable[[Path, Path], Path]
OTHER = "rooms/living/video.mp4"


def read(path: Path) -> list[Image]:
    """The frames of a video."""
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def write(path: Path, frames: Iterable[Image]) -> None:
    """Writes frames as H.264."""
    with av.open(str(path), "w") as container:
        stream = None
        for rgb in frames:
            if stream is None:
                stream = container.add_stream("libx264", rate=10, options={"crf": "12"})
                stream.pix_fmt = "yuv420p"
                stream.height, stream.width = rgb.shape[0] // 2 * 2, rgb.shape[1] // 2 * 2
            kept = np.ascontiguousarray(rgb[:stream.height, :stream.width])
            container.mux(stream.encode(av.VideoFrame.from_ndarray(kept, "rgb24")))
        assert stream is not None
        container.mux(stream.encode())


def damaged(path: str, change: Callable[[Frames, Path, np.random.Generator], Frames]) -> Source:
    """A video of the data after a change."""
    def make(data: Path, out: Path) -> Path:
        frames = change(
            list(enumerate(read(data / path))), data, np.random.default_rng(0))
        np.savetxt(out / "places.txt", [place for place, _ in frames], fmt="%d")
        write(out / "video.mp4", (rgb for _, rgb in frames))
        return out / "video.mp4"
    return make


def cut(frames: Frames, data: Path, _: np.random.Generator) -> Frames:
    """A second scene, half as long, follows without a word."""
    other = read(data / OTHER)[:len(frames) // 2]
    size = frames[0][1].shape[1::-1]
    return [*frames, *((-1, cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)) for rgb in other)]


def dropped(frames: Frames, _: Path, draws: np.random.Generator) -> Frames:
    """30% of the frames are lost."""
    return [frame for frame in frames if draws.uniform() > 0.3]


def repeated(frames: Frames, _: Path, draws: np.random.Generator) -> Frames:
    """Each frame is shown once to four times."""
    return [frame for frame in frames for _ in range(draws.integers(1, 5))]


def mirrored(frames: Frames, _: Path, __: np.random.Generator) -> Frames:
    """A fifth in the middle is mirrored."""
    first, last = 2 * len(frames) // 5, 3 * len(frames) // 5
    return [(-1, rgb[:, ::-1]) if first <= index < last else (place, rgb)
            for index, (place, rgb) in enumerate(frames)]


def blacked(frames: Frames, _: Path, draws: np.random.Generator) -> Frames:
    """10% of the frames are black."""
    return [(-1, np.zeros_like(rgb)) if draws.uniform() < 0.1 else (place, rgb)
            for place, rgb in frames]


def still(frames: Frames, _: Path, draws: np.random.Generator) -> Frames:
    """A tripod: the first frame again and again, with the noise of a sensor."""
    first = frames[0][1].astype(np.float64)
    return [(-1, np.clip(first + draws.normal(0, 2, first.shape), 0, 255).astype(np.uint8))
            for _ in frames]


def labelled(frames: Frames, _: Path, __: np.random.Generator) -> Frames:
    """A text and a logo lie over every frame."""
    return [(place, label(rgb)) for place, rgb in frames]


def bare(frames: Frames, _: Path, draws: np.random.Generator) -> Frames:
    """A bare wall under a text: of the room only large shades are left."""
    return [(-1, label(np.clip(
        cv2.GaussianBlur(rgb, (0, 0), 12.0) // 2 + 60 + draws.normal(0, 2, rgb.shape), 0, 255,
    ).astype(np.uint8))) for _, rgb in frames]


def soiled(frames: Frames, _: Path, draws: np.random.Generator) -> Frames:
    """Dirt on the lens: dark, soft spots, more of them towards the edge."""
    height, width = frames[0][1].shape[:2]
    shade = np.ones((height, width, 1), np.float32)
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    for _ in range(25):
        angle, reach = draws.uniform(0, 2 * np.pi), np.sqrt(draws.uniform(0.3, 1))
        u, v = width / 2 * (1 + reach * np.cos(angle)), height / 2 * (1 + reach * np.sin(angle))
        size = draws.uniform(0.01, 0.03) * width
        spot = 1 - 0.7 / (1 + np.exp((np.hypot(x - u, y - v) - size) / 1.5))
        shade *= spot[:, :, None].astype(np.float32)
    return [(place, (rgb * shade).astype(np.uint8)) for place, rgb in frames]


def label(rgb: Image) -> Image:
    """Puts a text and a logo on a frame."""
    image = rgb.copy()
    for line, text in enumerate(("CAM 04  LIVE 1080p", "Main St. entrance #27")):
        cv2.putText(image, text, (20, 40 + 30 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.9,
                    (255, 255, 255), 2)
    height, width = image.shape[:2]
    cv2.circle(image, (width - 50, height - 50), 30, (220, 40, 40), -1)
    cv2.circle(image, (width - 50, height - 50), 18, (255, 255, 255), 4)
    return image


def turn_before(picture: Image, count: int, pace: float) -> Iterator[Image]:
    """Yields noisy frames of a camera that turns before a picture and tilts at a pace."""
    height, width = picture.shape[:2]
    draws = np.random.default_rng(0)
    wide = np.array([[0.6 * width, 0, width / 2], [0, 0.6 * width, height / 2], [0, 0, 1]])
    narrow = np.array([[500.0, 0, 240], [0, 500.0, 180], [0, 0, 1]])
    for step in np.linspace(0, 1, count):
        turn = cv2.Rodrigues(np.array([
            np.radians(5 * np.sin(pace * step)), np.radians(50 * step - 25),
            0.02 * np.cos(13 * step)]))[0]
        image = cv2.warpPerspective(
            picture, narrow @ turn @ np.linalg.inv(wide), (480, 360), flags=cv2.INTER_AREA)
        yield np.clip(image + draws.normal(0, 2, image.shape), 0, 255).astype(np.uint8)


def turning(data: Path, out: Path) -> Path:
    """A camera that turns on the spot before a far picture."""
    picture = cv2.cvtColor(cv2.imread(str(
        sorted((data / "desk_monitors" / "images").iterdir())[0])), cv2.COLOR_BGR2RGB)
    write(out / "video.mp4", turn_before(picture, 100, 10.0))
    return out / "video.mp4"


CHANGES = {
    "cut to another room": cut, "30% dropped": dropped, "frames repeated": repeated,
    "a stretch mirrored": mirrored, "10% black": blacked, "text over it": labelled,
    "dirt on the lens": soiled, "tripod": still, "bare wall with text": bare}
