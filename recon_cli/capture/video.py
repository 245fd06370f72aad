"""Video files through PyAV: whether a file is a video, its declared length, its frames in order.

A packet that cannot be decoded is skipped and reported as a `LostPacket`. Of several videos in one
file the first is used. `codec_name` and `lacks_index` read the container themselves, for messages
about files that FFmpeg cannot open.
"""

from __future__ import annotations

import mmap
import re
import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import av
import numpy as np
from av.container import InputContainer
from av.stream import Disposition
from av.video.stream import VideoStream
from numpy.typing import NDArray

from recon_cli.capture.decoded_picture import (
    UNSUPPORTED_MATRICES,
    DecodedPicture,
    LostPacket,
    Orientation,
    Packing,
    Tags,
    deinterlace,
    read_tags,
)
from recon_cli.capture.video_colour import BT2020
from recon_cli.errors import InputError

# FFmpeg renders text and text art as video; no capture is that.
TEXT_CODECS = frozenset({"ansi", "bintext", "xbin", "idf"})
# A demuxer that fails this often in one file no longer makes progress.
MAX_DEMUX_ERRORS = 100
# How containers mark video: MP4 and MOV in a sample entry, Matroska by V_, AVI in a stream header.
MARKS = (
    re.compile(rb"hdlr.{8}vide.*?stsd.{12}([\x20-\x7e]{4})", re.DOTALL),
    re.compile(rb"(V_[A-Z0-9_/]{3,30})"),
    re.compile(rb"strh.{4}vids([\x20-\x7e]{4})", re.DOTALL))
SIGNATURES = (rb"....ftyp|....moov|....mdat|....wide", rb"\x1aE\xdf\xa3", rb"RIFF....AVI ")
# Codecs that a build may lack: HEVC for patents, AV1 and VVC for age.
NAMES = {
    "av01": "AV1", "V_AV1": "AV1", "AV01": "AV1",
    "hvc1": "HEVC", "hev1": "HEVC", "dvh1": "HEVC", "dvhe": "HEVC", "V_MPEGH/ISO/HEVC": "HEVC",
    "vvc1": "VVC", "vvi1": "VVC", "evc1": "EVC"}


@contextmanager
def open_video(path: Path) -> Iterator[tuple[InputContainer, VideoStream]]:
    """Yields the container and the video stream of a file with any suffix.

    InputError if the file is missing, not readable, no video, or a single picture.
    """
    try:
        # "file:" keeps a colon from naming a protocol; the whitelist keeps playlists from fetching.
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
        return _truncated(path)
    return InputError(
        f"{path} cannot be read as a video: {reason}.",
        hint="Give a video, or a folder of photos; if a player shows it, try a fresh copy.")


def _truncated(path: Path) -> InputError:
    return InputError(
        f"{path} is truncated: its index (the moov box) is incomplete.",
        hint="Copy it from the camera again, or record once more.")


def _video_stream(path: Path, container: InputContainer) -> VideoStream:
    """Returns the first video stream that is not a cover."""
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
        raise _truncated(path)
    types = sorted({"a still picture or text" if stream.type == "video" else stream.type
                    for stream in container.streams})
    only = f", only {', '.join(types)}" if types else ": it is empty"
    raise InputError(
        f"{path} holds no video that can be decoded{only}.",
        hint="Give a video or a folder of photos.")


def moving_pictures(container: InputContainer) -> list[VideoStream]:
    """Returns the video streams without covers and text."""
    return [
        stream for stream in container.streams.video
        if not stream.disposition & Disposition.attached_pic
        and (stream.codec_context is None or stream.codec_context.name not in TEXT_CODECS)]


def convert_hint(path: Path) -> str:
    """Returns the command that converts a file to a codec that every build decodes."""
    return (
        "Convert it where a player can play it, for example with "
        f'ffmpeg -i "{path}" -c:v libx264 -crf 16 "{path.stem}-h264.mp4"')


@dataclass(frozen=True)
class DeclaredLength:
    """The length of a video by its container."""

    frames: int  # that it shows; 0 where it has no count
    seconds: float  # 0 where unknown
    rate: float  # frames per second; a rough guess where the rate varies

    def count(self, rate: float) -> int:
        """Returns the number of frames that the header declares, or the duration implies."""
        return self.frames or round(self.seconds * rate)


def read_declared_length(path: Path) -> DeclaredLength:
    """Returns the length of a video by its container."""
    with open_video(path) as (container, stream):
        if stream.duration is not None and stream.time_base is not None:
            seconds = float(stream.duration * stream.time_base)
        else:
            seconds = (container.duration or 0) / av.time_base
        return DeclaredLength(
            _count_frames(container, stream), seconds, float(stream.average_rate or 0))


def _count_frames(container: InputContainer, stream: VideoStream) -> int:
    """Returns how many frames a container says that it shows, 0 where it has no count."""
    index = list(stream.index_entries)
    if not stream.frames or not index:
        return stream.frames
    if "mov" in container.format.name:
        # Edit lists, by which phones trim clips, leave out what the file still holds.
        return sum(not entry.is_discard for entry in index)
    if container.format.name == "avi":
        # A place that only repeats the frame before counts, but has no entry.
        return stream.frames - (index[-1].timestamp - index[0].timestamp + 1 - len(index))
    return stream.frames


def decode(
    path: Path, *, threads: int, size: tuple[int, int] | None = None
) -> Iterator[DecodedPicture | LostPacket]:
    """Yields every frame of a video in presentation order, and a `LostPacket` for each lost packet.

    The frames of an undamaged video do not depend on `threads`. Frames of several sizes are scaled
    to `size` (as stored, width and height), else to that of the first; those of another shape are
    gaps.
    """
    with open_video(path) as (container, stream):
        stream.thread_type = "AUTO"
        stream.codec_context.thread_count = threads
        tags: Tags | None = None
        for item in deinterlace(_decode_frames(container, stream)):
            if isinstance(item, LostPacket):
                yield item
                continue
            # Not before the first frame: some cameras signal HLG only within the stream.
            frame = item[0]
            tags = tags or replace(
                _read_tags(path, stream, frame), size=size or (frame.width, frame.height))
            picture = DecodedPicture(frame, tags, item[1])
            yield picture if picture.fits else LostPacket(frame.pts, (frame.width, frame.height))


def _read_tags(path: Path, stream: VideoStream, first: av.VideoFrame) -> Tags:
    """Returns the tags of a video; InputError if its colours cannot be converted."""
    name = UNSUPPORTED_MATRICES.get(first.colorspace)
    if name is not None:
        matrix = "2020_ncl" if stream.codec_context.color_primaries == BT2020 else "709"
        raise InputError(
            f"{path} stores its colours as {name}, which cannot be converted here.",
            hint="Convert it first, for example with "
            f'ffmpeg -i "{path}" -vf zscale=matrix={matrix} -crf 16 "{path.stem}-{matrix}.mp4"')
    tags = read_tags(stream, first)
    if tags.packing not in (None, Packing.SIDE_BY_SIDE, Packing.TOP_AND_BOTTOM):
        raise InputError(
            f"{path} is 3D video whose frames weave the views of both eyes together "
            f"({tags.packing.words}).",
            hint="Export the view of one eye with the program that it comes from.")
    return tags


def sample_frames(path: Path, count: int) -> list[DecodedPicture]:
    """Returns up to `count` key frames, spread over the video as far as its index allows."""
    pictures: list[DecodedPicture] = []
    with open_video(path) as (container, stream):
        stream.codec_context.skip_frame = "NONKEY"
        for place in range(count):
            with suppress(av.error.FFmpegError, StopIteration):
                if container.duration:
                    container.seek(round((place + 0.5) / count * container.duration))
                frame = next(container.decode(stream))
                pictures.append(DecodedPicture(frame, _read_tags(path, stream, frame)))
    return pictures


def frames_at(
    path: Path, indices: Collection[int], *, threads: int, size: tuple[int, int] | None = None
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Yields (index, RGB [H, W, 3]) in ascending order; InputError if the file lacks an index.

    `size` is that of `decode`.
    """
    missing = set(indices)
    if not missing:
        return
    pictures = (item for item in decode(path, threads=threads, size=size)
                if isinstance(item, DecodedPicture))
    for index, picture in enumerate(pictures):
        if index in missing:
            yield index, picture.rgb()
            missing.remove(index)
        if not missing:
            return
    raise InputError(
        f"{path} ended before frame {min(missing)}, which the first pass had read.",
        hint="Do not change the file while it is read, then run the same command again.")


def stored_frames(
    path: Path, numbers: Collection[int], *, threads: int
) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
    """Yields (number, RGB [H, W, 3] as stored, not turned) in ascending order; None where lost.

    Numbers are places in the order of presentation, counted by the packets, so that a frame that
    cannot be decoded does not move those after it.
    """
    wanted = sorted(set(numbers))
    places = {pts: at for at, pts in enumerate(_presentation_times(path))}
    at, waiting = -1, iter(wanted)
    number = next(waiting, None)
    for item in decode(path, threads=threads):
        if number is None:
            return
        if isinstance(item, LostPacket):
            at += not places
            continue
        at = places.get(item.frame.pts, at + 1) if item.frame.pts is not None else at + 1
        while number is not None and number < at:
            yield number, None
            number = next(waiting, None)
        if number == at:
            yield at, replace(item, tags=replace(item.tags, orientation=Orientation())).rgb()
            number = next(waiting, None)
    while number is not None:
        yield number, None
        number = next(waiting, None)


def _presentation_times(path: Path) -> list[int]:
    """Returns the times of all packets that are shown, in order; empty if they have none."""
    with open_video(path) as (container, stream):
        try:
            times = [packet.pts for packet in container.demux(stream)
                     if packet.size and not packet.is_discard]
        except av.error.FFmpegError:
            return []
    if None in times or len(set(times)) < len(times):
        return []
    return sorted(time for time in times if time is not None)


def _decode_frames(
    container: InputContainer, stream: VideoStream
) -> Iterator[av.VideoFrame | LostPacket]:
    """Yields frames and gaps; continues after errors of demuxer and decoder."""
    for _ in range(MAX_DEMUX_ERRORS):
        try:
            for packet in container.demux(stream):
                try:
                    yield from packet.decode()
                except av.error.FFmpegError:
                    yield LostPacket(packet.pts)
            return
        except av.error.FFmpegError:
            yield LostPacket(None)


def codec_name(path: Path) -> str:
    """Returns the name of the codec of a file's first video, "" where it is not found."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for signature, mark in zip(SIGNATURES, MARKS, strict=True):
            if re.match(signature, data, re.DOTALL) and (match := mark.search(data)):
                name = match[1].decode("ascii").strip()
                return NAMES.get(name, name)
    return ""


def lacks_index(path: Path) -> bool:
    """Returns whether a file is an MP4 or MOV whose index, the moov box, is incomplete."""
    size, at, boxes = path.stat().st_size, 0, set()
    with path.open("rb") as file:
        while len(head := file.read(16)) >= 8:
            length, name = struct.unpack_from(">I4s", head)
            if length == 1 and len(head) == 16:  # a length of 64 bits follows
                length = struct.unpack_from(">Q", head, 8)[0]
            end = at + length if length else size  # 0: to the end of the file
            if at == 0 and name not in {b"ftyp", b"mdat", b"wide", b"moov"}:
                return False
            if length and length < 8:
                break
            boxes.add(name if end <= size else b"")
            at = end
            file.seek(at)
    return bool(boxes) and b"moov" not in boxes
