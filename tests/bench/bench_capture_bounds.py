"""What the bounds on repeated pictures and panoramas rest on: `bench_capture_bounds.py DATA`.

DATA is the folder of test data. The first table has a row for a video and codec: PICTURES of its
pictures are written twice each at a usual rate, and of the shifts that `capture.repeats` measures
between frames that repeat a picture the largest is shown, and of those between two pictures the
smallest and the middle one, in pixels of the tracker's size. The second has a row for a folder: how
many of its pictures pass for panoramas, of photos once they are cut to 2:1.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import islice
from pathlib import Path

import av
import click
import cv2
import numpy as np
from numpy.typing import NDArray
from workbench import FOLDER

from recon_cli.capture.limits import TRACK_SIZE
from recon_cli.capture.panoramas import wraps_around
from recon_cli.capture.repeats import SAME_PICTURE, measure_shift
from recon_cli.capture.tracker import Tracker
from recon_cli.io.tracks import Tracks

PICTURES = 30
# Options of each encoder at a usual rate.
CODECS = {"libx264": {"crf": "23"}, "libx265": {"crf": "28", "x265-params": "log-level=error"},
          "mpeg4": {"qscale": "4"}, "libvpx-vp9": {"crf": "32", "b": "0"}, "mjpeg": {}}
VIDEOS = (
    "rooms/office/video.mp4", "rooms/living/video_noisy.mp4", "video_bedroom/room.mp4",
    "video_house_entry/video.mp4", "walks/trident_desk/video.mp4",
    "walks/living_room_loop/video.mp4", "walks/hololens_walk/video.mp4",
    "walks/tum_fr1_rpy/video.mp4", "walks/forward_walks/kitchen_walk.mp4",
    "walks/forward_walks/lobby_walk.mp4", "walks/forward_walks/study_walk.mp4")
PANORAMAS = ("house_360/images", "rooms360/living/images", "rooms360/office/images")
PHOTOS = ("fox/images", "desk_monitors/images", "snowmiku_photos", "walks/bonsai/images",
          "walks/club_room_lockers/images", "walks/tello_lab/images", "rooms/living/results",
          "rooms/office/results", "walks/office_corridor_plants/images")
MOST = 60  # pictures of a folder, evenly spread


def read_pictures(path: Path) -> list[NDArray[np.uint8]]:
    """The first pictures of a video, of even size."""
    with av.open(str(path)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in islice(
            container.decode(video=0), PICTURES)]
    height, width = (size // 2 * 2 for size in frames[0].shape[:2])
    return [np.ascontiguousarray(frame[:height, :width]) for frame in frames]


def write_twice(pictures: Sequence[NDArray[np.uint8]], codec: str, path: Path) -> None:
    """Writes each picture twice."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(30), options=CODECS[codec])
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for picture in pictures:
            for _ in range(2):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def track(path: Path) -> tuple[Tracks, NDArray[np.float64]]:
    """The tracks of a video, and its width and height over the longer side."""
    tracker = Tracker()
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            gray = frame.to_ndarray(format="gray")
            tracker.advance(gray)
    return tracker.tracks(), np.array(gray.shape[::-1]) / max(gray.shape)


def shifts(tracks: Tracks, sides: NDArray[np.float64]) -> NDArray[np.float64]:
    """The shift from each frame to the next, in pixels of the tracker's size."""
    found = []
    for image in range(len(tracks.names) - 1):
        before, after = tracks.matches(image, image + 1)
        found.append(TRACK_SIZE * measure_shift(tracks.xy[before] * sides, tracks.xy[after] * sides)
                     if len(before) else np.nan)
    return np.array(found)


def repeat_rows(data: Path) -> Iterator[str]:
    """The first table."""
    yield "| video | codec | largest of repeats | smallest of others | middle of others |"
    yield "|---|---|---:|---:|---:|"
    with tempfile.TemporaryDirectory() as folder:
        for name in VIDEOS:
            pictures = read_pictures(data / name)
            for codec in CODECS:
                path = Path(folder) / "twice.mkv"
                write_twice(pictures, codec, path)
                moved = shifts(*track(path))
                yield (f"| {name} | {codec} | {np.nanmax(moved[::2]):.2f} | "
                       f"{np.nanmin(moved[1::2]):.2f} | {np.nanmedian(moved[1::2]):.2f} |")
    yield f"the bound: {SAME_PICTURE * TRACK_SIZE:.2f}"


def panorama_rows(data: Path) -> Iterator[str]:
    """The second table."""
    yield "| folder | pictures | pass for panoramas |"
    yield "|---|---:|---:|"
    for name in (*PANORAMAS, *PHOTOS):
        files = sorted(path for path in (data / name).rglob("*")
                       if path.suffix.lower() in (".jpg", ".jpeg", ".png")
                       and not path.name.startswith(("depth", "mask")))
        some = files[::max(1, len(files) // MOST)]
        pictures = [picture for path in some if (picture := cv2.imread(str(path))) is not None]
        passed = sum(wraps_around(cut(picture)) for picture in pictures)
        yield f"| {name} | {len(pictures)} | {passed} |"


def cut(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The middle of a picture, twice as wide as high."""
    height, width = picture.shape[:2]
    high, wide = min(height, width // 2), min(width, 2 * height)
    top, left = (height - high) // 2, (width - wide) // 2
    return picture[top:top + high, left:left + wide]


@click.command()
@click.argument("data", type=FOLDER)
def main(data: Path) -> None:
    """Prints both tables."""
    for rows in (repeat_rows(data), panorama_rows(data)):
        for row in rows:
            click.echo(row)


if __name__ == "__main__":
    main()
