"""One pass over all frames of a video: their measures, tracks, and which of them are intact."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from av.video.frame import PictureType
from numpy.typing import NDArray

from recon_cli.capture import video
from recon_cli.capture.decoded_picture import DecodedPicture, LostPacket
from recon_cli.capture.frame_measures import MotionMeter, measure_exposure, measure_sharpness
from recon_cli.capture.lens_border import BorderMeter
from recon_cli.capture.static_overlay import OverlayMeter
from recon_cli.capture.tracker import Tracker
from recon_cli.capture.video_colour import WIDE_GAMUTS
from recon_cli.errors import Hint, InputError
from recon_cli.io.tracks import Tracks
from recon_cli.workspace import atomic

# B-frames in a row: x264's presets write up to 8. HEVC encoders mark entire groups as B.
MAX_B_RUN = 8


@dataclass(frozen=True, eq=False)
class Scan:
    """The measures of F frames in presentation order, which gives a frame its index."""

    width: int  # of an upright frame in pixels
    height: int
    declared: int  # frames by the container's count or duration; 0 where unknown
    gaps: int  # packets that gave no frame
    sharpness: NDArray[np.float64]  # [F], `measure_sharpness`
    motion: NDArray[np.float64]  # [F], `MotionMeter.advance`
    exposure: NDArray[np.float64]  # [F, 3], rows of `measure_exposure`
    seconds: tuple[float | None, ...]  # presentation times, None where unknown
    # [F], False from a lost or damaged packet to the next key frame
    intact: NDArray[np.bool_]
    tracks: Tracks  # of corners through all frames
    # [h, w] at a reduced size, where something is fixed to the camera; None if nowhere
    overlay: NDArray[np.bool_] | None
    notices: tuple[str, ...]  # about conversions that the owner of the video may not expect
    # of most frames, as stored: the others are scaled to it; None for that of the first
    size: tuple[int, int] | None = None

    @property
    def expected(self) -> int:
        """How many frames there should be."""
        return max(self.declared, len(self.intact) + self.gaps)

    @property
    def lost(self) -> int:
        """How many frames are missing or broken."""
        return self.expected - int(self.intact.sum())

    def write(self, path: Path) -> None:
        """Writes the measures as JSON, NaN as null, and tracks and overlay beside them."""
        values = {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items() if name not in ("tracks", "overlay")}
        values["whole"] = values.pop("intact")  # the key in the file
        motion = [None if np.isnan(step) else step for step in values["motion"]]
        self.tracks.write(path.with_suffix(".safetensors"))
        if self.overlay is not None:
            _, data = cv2.imencode(".png", self.overlay * np.uint8(255))
            atomic.write_bytes(path.with_suffix(".png"), data.tobytes())
        atomic.write_json(
            path, {**values, "motion": motion, "overlay": self.overlay is not None})

    @classmethod
    def read(cls, path: Path) -> Scan:
        """Returns the scan that `write` wrote."""
        value: dict[str, Any] = atomic.read_json(path, dict)
        intact = np.array(value.pop("whole"), np.bool_)
        overlay = None
        if value["overlay"]:
            data = np.frombuffer(atomic.read_bytes(path.with_suffix(".png")), np.uint8)
            overlay = np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)) > 0
        return cls(**{
            **value, "overlay": overlay,
            "tracks": Tracks.read(path.with_suffix(".safetensors")),
            "sharpness": np.array(value["sharpness"], np.float64),
            "motion": np.array(value["motion"], np.float64),  # null becomes NaN
            "exposure": np.array(value["exposure"], np.float64).reshape(-1, 3),
            "seconds": tuple(value["seconds"]),
            "size": tuple(value["size"]) if value.get("size") else None,
            "intact": intact, "notices": tuple(value["notices"])})


@dataclass(frozen=True)
class _FrameMeasures:
    """The part of a scan that is about one frame."""

    sharpness: float
    motion: float
    exposure: tuple[float, float, float]
    seconds: float | None
    pts: int | None
    key: bool
    bidirectional: bool
    corrupt: bool
    interlaced: bool
    size: tuple[int, int]  # as stored


def scan_video(path: Path, *, threads: int, step: Callable[[], None]) -> Scan:
    """Returns the scan of a video, the same for any number of threads; calls `step` per frame.

    A damaged stream is scanned again by one thread, which alone is reproducible around the damage.
    InputError if the file is not a video, or none of its frames can be decoded.
    """
    scan = _scan_once(path, threads=threads, step=step)
    if scan.lost and threads > 1:
        scan = _scan_once(path, threads=1, step=step, size=scan.size)
    return scan


def measure_scene(
    path: Path, scan: Scan, *, threads: int, step: Callable[[], None]
) -> Scan:
    """Returns a scan whose sharpness and motion leave out its overlay, after another pass.

    An overlay is always sharp and never moves, which hides that the scene is blurred or moves.
    """
    meter = MotionMeter(scan.overlay)
    sharpness, motion = [], []
    for item in video.decode(
            path, threads=decode_threads(scan, threads), size=scan.size):
        if not isinstance(item, LostPacket):
            gray = item.gray()
            sharpness.append(measure_sharpness(gray, scan.overlay))
            motion.append(meter.advance(gray))
            step()
    if len(motion) != len(scan.motion):
        raise InputError(
            f"{path} has changed while it was read.", hint=Hint("ingest", then=" again"))
    return replace(scan, sharpness=np.array(sharpness), motion=np.array(motion))


def decode_threads(scan: Scan, threads: int) -> int:
    """Returns the number of threads with which a video gives the frames of its scan again."""
    return 1 if scan.lost else threads


def _scan_once(
    path: Path, *, threads: int, step: Callable[[], None], size: tuple[int, int] | None = None
) -> Scan:
    """Returns a scan of frames that are scaled to `size`, by default that of most of them."""
    measures: list[_FrameMeasures] = []
    gaps: list[tuple[int, int | None]] = []  # (frames before it, pts)
    misfits: list[tuple[int, int]] = []  # sizes of frames of another shape
    first: DecodedPicture | None = None
    meter, tracker, overlay, border = MotionMeter(), Tracker(), OverlayMeter(), BorderMeter()
    with ThreadPoolExecutor(1) as beside:  # the two halves take about as long
        for item in video.decode(path, threads=threads, size=size):
            if isinstance(item, LostPacket):
                if item.other_size is None:
                    gaps.append((len(measures), item.pts))
                else:
                    misfits.append(item.other_size)
                continue
            first = first or item
            gray = item.gray()
            measured = beside.submit(_measure, item, gray, meter)
            tracker.advance(gray)
            overlay.advance(gray, *tracker.corners)
            border.advance(gray)
            measures.append(measured.result())
            step()
    if first is None:
        raise _nothing_decoded(path)
    sizes = Counter([*(frame.size for frame in measures), *misfits])
    most = sizes.most_common(1)[0][0]
    if size is None and most != first.tags.size:
        return _scan_once(path, threads=threads, step=step, size=most)
    width, height = first.size
    claim = video.read_declared_length(path)
    declared = claim.count(_frame_rate(measures) or claim.rate)
    return Scan(
        width=width, height=height, gaps=len(gaps), size=most,
        declared=max(0, declared - len(misfits)),
        sharpness=np.array([frame.sharpness for frame in measures], np.float64),
        motion=np.array([frame.motion for frame in measures], np.float64),
        exposure=np.round(
            border.without_border(np.array([frame.exposure for frame in measures])), 4),
        seconds=tuple(frame.seconds for frame in measures),
        intact=_find_intact(measures, gaps), tracks=tracker.tracks(), overlay=overlay.overlay(),
        notices=(
            *_describe_sizes(path, most, sizes, Counter(misfits)),
            *describe_conversions(path, first, sum(frame.interlaced for frame in measures))))


def _describe_sizes(
    path: Path, most: tuple[int, int], sizes: Mapping[tuple[int, int], int],
    misfits: Mapping[tuple[int, int], int],
) -> list[str]:
    """Returns a notice for each size of frames but the most common one."""
    return [
        f"{path.name} changes its picture size: {count} frames of {width}x{height} are "
        + (f"left out, because {most[0]}x{most[1]} is more common and has another shape; to use "
           "them, give that part as a video of its own." if (width, height) in misfits else
           f"scaled to {most[0]}x{most[1]}.")
        for (width, height), count in sizes.items() if (width, height) != most]


def _nothing_decoded(path: Path) -> InputError:
    """Returns the error for a video of which no frame came out."""
    with video.open_video(path) as (_, stream):
        codec, stored = stream.codec_context.name, stream.frames
    if stored and not video.read_declared_length(path).frames:
        return InputError(
            f"{path} holds {stored} frames, but its edit list shows none of them.",
            hint="Take the trimming back, for example with "
            f'ffmpeg -ignore_editlist 1 -i "{path}" -c copy "{path.stem}-all.mp4"')
    return InputError(
        f"No frame of {path} can be decoded; its codec is {codec}.",
        hint=f"Copy it from the camera again. {video.convert_hint(path)}")


def _measure(
    picture: DecodedPicture, gray: NDArray[np.uint8], meter: MotionMeter
) -> _FrameMeasures:
    frame = picture.frame
    return _FrameMeasures(
        sharpness=measure_sharpness(gray), motion=meter.advance(gray),
        exposure=measure_exposure(gray), seconds=frame.time, pts=frame.pts,
        key=bool(frame.key_frame), bidirectional=frame.pict_type == PictureType.B,
        corrupt=bool(frame.is_corrupt), interlaced=picture.interlaced,
        size=(frame.width, frame.height))


def _frame_rate(measures: Sequence[_FrameMeasures]) -> float:
    """Returns the mean frames per second, 0 where times are unknown."""
    # Not of the first and the last frame: some programs number packets, B-frames and all.
    times = [frame.seconds for frame in measures if frame.seconds is not None]
    if len(times) < len(measures) or max(times) <= min(times):
        return 0.0
    return (len(measures) - 1) / (max(times) - min(times))


def _find_intact(
    measures: Sequence[_FrameMeasures], gaps: Sequence[tuple[int, int | None]]
) -> NDArray[np.bool_]:  # [F]
    """Returns False for each frame that depends, directly or not, on lost data."""
    intact = np.ones(len(measures), np.bool_)
    for index, frame in enumerate(measures):
        if frame.corrupt:
            _spoil(intact, measures, index, index + 1)
    # one more before the first and after the last
    beside_damage = np.zeros(len(measures) + 2, np.bool_)
    for count, pts in gaps:
        after = count
        if pts is not None:
            after = next(
                (i for i, frame in enumerate(measures) if (frame.pts or 0) > pts), len(measures))
        _spoil(intact, measures, after, after)
        beside_damage[after:after + 2] = True
    # Deinterlacing uses the frames on both sides.
    beside_damage[2:] |= ~intact
    beside_damage[:-2] |= ~intact
    return intact & ~(beside_damage[1:-1] & [frame.interlaced for frame in measures])


def _spoil(
    intact: NDArray[np.bool_], measures: Sequence[_FrameMeasures], first: int, search: int
) -> None:
    """Clears the frames from `first` to the next key frame at or after `search`."""
    end = next((i for i in range(search, len(measures)) if measures[i].key), len(measures))
    # B-frames shown before the damage are predicted from it as well.
    earliest = max(0, first - MAX_B_RUN)
    while first > earliest and measures[first - 1].bidirectional:
        first -= 1
    intact[first:end] = False


def describe_conversions(path: Path, first: DecodedPicture, interlaced: int) -> tuple[str, ...]:
    """Returns a sentence on each conversion that the owner of a video may not expect."""
    notices = []
    with video.open_video(path) as (container, _):
        videos = len(video.moving_pictures(container))
    if videos > 1:
        notices.append(f"{path.name} holds {videos} videos: the first that can be decoded is used.")
    if first.tags.packing is not None:
        width, height = first.size
        notices.append(
            f"{path.name} is 3D video ({first.tags.packing.words}): the view of the left eye is "
            f"used, {width}x{height} pixels.")
    if first.tags.transfer is not None:
        notices.append(
            f"{path.name} is {first.tags.transfer.value} video: tone-mapped to SDR by one curve.")
    elif first.may_be_log:
        notices.append(
            f"{path.name} does not say how its brightness is stored, as log video (such as Apple "
            "Log) does, and is read as SDR. If it looks flat, convert it first by the LUT of the "
            f'camera\'s maker: ffmpeg -i "{path}" -vf lut3d=LUT.cube -crf 16 '
            f'"{path.stem}-709.mp4"')
    elif first.tags.primaries in WIDE_GAMUTS:
        notices.append(
            f"{path.name} has colours of {WIDE_GAMUTS[first.tags.primaries]}: converted to sRGB.")
    if first.tags.orientation.mirrored:
        notices.append(
            f"{path.name} is mirrored as its display matrix says; if players show writing in it "
            "reversed, the scene is reversed, too.")
    if interlaced:
        notices.append(f"{path.name} is interlaced: {interlaced} frames are deinterlaced.")
    width, height = first.square_size
    stored = first.tags.size or (first.frame.width, first.frame.height)
    if (width, height) != stored and first.tags.packing is None:
        notices.append(
            f"{path.name} has pixels of aspect {first.tags.aspect}: its frames of "
            f"{stored[0]}x{stored[1]} are stretched to {width}x{height}.")
    return tuple(notices)
