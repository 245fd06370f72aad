"""Encodes frames as H.264 or AV1 in an .mp4, through PyAV.

Colours are stored and tagged as BT.709 of limited range: without the tags, players guess from the
size of the picture.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
from av.codec import Codec
from av.codec.codec import UnknownCodecError
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream

from recon_cli.errors import ConfigError
from recon_cli.io.images import read_image
from recon_cli.workspace.atomic import replacing

ENCODERS = {"h264": ("libx264",), "av1": ("libsvtav1", "libaom-av1")}  # the first available
_BT709 = 1  # in FFmpeg's lists of primaries, transfer functions and matrices alike
os.environ.setdefault("SVT_LOG", "1")  # SVT-AV1 prints its settings to stderr; 1 leaves errors


@dataclass(frozen=True)
class VideoEncoding:
    """The parameters of a video."""

    codec: str  # h264 or av1
    crf: int  # quality, smaller is better
    width: int  # in pixels, even
    height: int  # in pixels, even
    fps: float

    @property
    def rate(self) -> Fraction:
        """Frames a second; the denominator is small, or that of NTSC."""
        return Fraction(self.fps).limit_denominator(1001)

    def encoder(self) -> str:
        """Returns the name of an encoder.

        Raises:
            ConfigError: this build of PyAV has none for the codec.
        """
        for name in ENCODERS[self.codec]:
            try:
                return str(Codec(name, "w").name)
            except UnknownCodecError:
                continue
        others = ", ".join(codec for codec in ENCODERS if codec != self.codec)
        raise ConfigError(
            f"The installed PyAV {av.__version__} cannot encode {self.codec}: it lacks "
            f"{' or '.join(ENCODERS[self.codec])}.",
            hint=f"Give another --codec ({others}), or install PyAV with pip.")


def check_encoding(encoding: VideoEncoding) -> None:
    """Raises ConfigError if there is no encoder, or it rejects this size or rate."""
    encoder = encoding.encoder()
    context = VideoCodecContext.create(encoder, "w")
    assert isinstance(context, VideoCodecContext)
    _configure(context, encoding)
    context.time_base = 1 / encoding.rate
    try:
        with _restore_scheduling():
            context.open()
    except av.error.FFmpegError as error:
        raise ConfigError(
            f"{encoder} cannot encode a video of {encoding.width}x{encoding.height} pixels at "
            f"{encoding.fps:g} fps.", hint="Give another --size, --fps or --codec.") from error


@contextmanager
def _restore_scheduling() -> Iterator[None]:
    """Restores the scheduling of this thread at the end.

    SVT-AV1 gives the thread that opens it real-time priority where the user is root, as in a
    container, and leaves it so: what spins on that thread later would starve all others for good.
    """
    if not hasattr(os, "sched_getscheduler"):  # Linux alone has it
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)


def _configure(context: VideoCodecContext, encoding: VideoEncoding) -> None:
    context.width, context.height = encoding.width, encoding.height
    context.pix_fmt = "yuv420p"
    context.framerate = encoding.rate
    context.options = {"crf": str(encoding.crf)}
    context.color_primaries = context.color_trc = context.colorspace = _BT709
    context.color_range = ColorRange.MPEG


def encode_video(
    pictures: Sequence[Path], path: Path, encoding: VideoEncoding, *, threads: int,
    on_frame: Callable[[], None],
) -> None:
    """Writes pictures as a video, atomically.

    Args:
        pictures: RGB or gray files, in order.
        path: of the .mp4.
        encoding: that `check_encoding` accepted.
        threads: of the encoder.
        on_frame: called after each picture.

    Raises:
        OSError: the file cannot be written.
        FormatError: a picture cannot be read.
    """
    with _restore_scheduling(), replacing(path) as temporary, av.open(
            str(temporary), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream(encoding.encoder(), rate=encoding.rate)
        assert isinstance(stream, VideoStream)
        _configure(stream.codec_context, encoding)
        stream.codec_context.thread_count = threads
        for picture in pictures:
            image = read_image(picture, encoding.width, encoding.height)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24").reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG)))
            on_frame()
        container.mux(stream.encode(None))
