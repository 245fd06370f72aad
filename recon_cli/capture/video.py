"""Video files through PyAV: what is a video, and its frames in order.

A packet that cannot be decoded is passed over and reported as a `Gap`. Of several videos in one
file the first is taken; sound and covers are passed over.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.stream import VideoStream
from numpy.typing import NDArray

from recon_cli.capture.container_probe import codec_name, lacks_index
from recon_cli.capture.decoded_picture import Gap, Picture, Tags, tags_of
from recon_cli.capture.deinterlace import progressive
from recon_cli.errors import InputError

# FFmpeg renders text and text art as video; nobody means that by a capture.
TEXT_CODECS = frozenset({"ansi", "bintext", "xbin", "idf"})
# A demuxer that fails this often in one file makes no progress any more.
MAX_DEMUX_ERRORS = 100


@contextmanager
def open_video(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Yields the container and the video stream of a file, whatever its name ends in.

    Raises:
        InputError: the file is missing, not readable, no video, or a single picture.
    """
    try:
        # "file:" keeps a colon in the name from being read as a protocol, and the whitelist keeps
        # a playlist from fetching anything.
        container = av.open(
            f"file:{path}", options={"protocol_whitelist": "file"}, metadata_errors="replace")
    except av.error.FFmpegError as error:
        raise _unreadable(path, error.strerror or str(error)) from error
    with container:
        if container.format.name.endswith("_pipe") or container.format.name == "image2":
            raise InputError(
                f"{path} is a single picture, but one view holds no depth.",
                hint="Give a video, or a folder with at least 3 photos of the room.")
        yield container, _video_stream(path, container)


def _unreadable(path: Path, reason: str) -> InputError:
    if not path.exists():
        return InputError(f"{path} does not exist.", hint="Check the path.")
    if path.is_file() and path.stat().st_size == 0:
        return InputError(f"{path} is empty (0 bytes).", hint="Copy it from the camera again.")
    if path.is_file() and lacks_index(path):
        return _cut_off(path)
    return InputError(
        f"{path} cannot be read as a video: {reason}.",
        hint="Give a video, or a folder of photos; if a player shows it, try a fresh copy.")


def _cut_off(path: Path) -> InputError:
    return InputError(
        f"{path} is cut off: its index (the moov box) is not there in full.",
        hint="Copy it from the camera again; if it is no longer there, record once more.")


def _video_stream(path: Path, container: InputContainer) -> VideoStream:
    """Returns the first moving picture; the cover of a song is none."""
    moving = moving_pictures(container)
    for stream in moving:
        if stream.codec_context is not None:
            return stream
    if moving:
        raise InputError(
            f"{path} holds video in {codec_name(path) or 'an unknown codec'}, which cannot be "
            "decoded here.",
            hint=convert_hint(path))
    if lacks_index(path):
        raise _cut_off(path)
    kinds = {"video": "a still picture or text"}
    found = sorted({kinds.get(stream.type, stream.type) for stream in container.streams})
    only = f", only {', '.join(found)}" if found else ": it is empty"
    raise InputError(
        f"{path} holds no video that can be decoded{only}.",
        hint="Give a video or a folder of photos.")


def moving_pictures(container: InputContainer) -> list[VideoStream]:
    """Returns the video streams without covers and text."""
    return [
        stream for stream in container.streams.video
        if not stream.disposition & Disposition.attached_pic
        and (stream.codec_context is None or stream.codec_context.name not in TEXT_CODECS)
    ]


def convert_hint(path: Path) -> str:
    """Returns what to type to make a file of a codec that every build decodes."""
    return (
        "Convert it where a player shows it, such as by "
        f'ffmpeg -i "{path}" -c:v libx264 -crf 16 "{path.stem}-h264.mp4"')


@dataclass(frozen=True)
class Claim:
    """What a file says about its length, before anything is decoded.

    Attributes:
        frames: the container's count, 0 where it keeps none.
        seconds: duration, 0 where it is not known.
        rate: frames per second; little more than a guess where the rate varies.
    """

    frames: int
    seconds: float
    rate: float

    def count(self, rate: float) -> int:
        """Returns how many frames there should be, by the duration where none are counted."""
        return self.frames or round(self.seconds * rate)


def claimed_length(path: Path) -> Claim:
    """Returns what a video's container says about its length.

    Raises:
        InputError: as `open_video`.
    """
    with open_video(path) as (container, stream):
        if stream.duration is not None and stream.time_base is not None:
            seconds = float(stream.duration * stream.time_base)
        else:
            seconds = (container.duration or 0) / av.time_base
        return Claim(stream.frames, seconds, float(stream.average_rate or 0))


def decode(path: Path, *, threads: int) -> Iterator[Picture | Gap]:
    """Yields every frame of a video in the order of showing, and a `Gap` for each lost packet.

    The frames of an undamaged video do not depend on `threads`; around damage they do. A frame of
    another size than the first counts as lost. Interlaced frames come out deinterlaced.

    Raises:
        InputError: as `open_video`.
    """
    with open_video(path) as (container, stream):
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        tags: Tags | None = None
        for item in progressive(_of_one_size(_frames(container, stream))):
            if isinstance(item, Gap):
                yield item
                continue
            # Not before the first frame: some cameras say that it is HLG within the stream alone.
            tags = tags or tags_of(stream)
            yield Picture(item[0], tags, item[1])


def frames_at(
    path: Path, indices: Collection[int], *, threads: int
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yields (index, RGB [H, W, 3]) of the frames at these indices, in ascending order.

    Raises:
        InputError: as `open_video`, or the file does not hold the frames that it held before.
    """
    missing = set(indices)
    if not missing:
        return
    pictures = (item for item in decode(path, threads=threads) if isinstance(item, Picture))
    for index, picture in enumerate(pictures):
        if index in missing:
            yield index, picture.rgb()
            missing.remove(index)
        if not missing:
            return
    raise InputError(
        f"{path} ended before frame {min(missing)}, which was there on the first reading.",
        hint="Leave the file alone while it is read, then run the same command again.")


def _of_one_size(items: Iterable[av.VideoFrame | Gap]) -> Iterator[av.VideoFrame | Gap]:
    size: tuple[int, int] | None = None
    for item in items:
        if isinstance(item, av.VideoFrame):
            size = size or (item.width, item.height)
            if (item.width, item.height) != size:
                yield Gap(item.pts)
                continue
        yield item


def _frames(container: InputContainer, stream: VideoStream) -> Iterator[av.VideoFrame | Gap]:
    for packet in _packets(container, stream):
        if isinstance(packet, Gap):
            yield packet
            continue
        try:
            yield from packet.decode()
        except av.error.FFmpegError:
            yield Gap(packet.pts)


def _packets(
    container: InputContainer, stream: VideoStream
) -> Iterator[av.Packet[VideoStream] | Gap]:
    """Yields the packets of a stream; goes on behind what the demuxer stumbles over."""
    for _ in range(MAX_DEMUX_ERRORS):
        try:
            yield from container.demux(stream)
            return
        except av.error.FFmpegError:
            yield Gap(None)
