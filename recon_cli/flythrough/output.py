"""The files of a flythrough: colour, 16-bit depth and trust with their colours, alpha, and
videos of them.

Videos are H.264 or AV1 through PyAV, tagged as BT.709 of limited range: without the tags, players
guess from the size of the picture. A .gif is Pillow's, which chooses colours for each frame.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.codec import Codec
from av.codec.codec import UnknownCodecError
from av.video.codeccontext import VideoCodecContext
from av.video.reformatter import ColorRange, Colorspace
from av.video.stream import VideoStream
from numpy.typing import NDArray
from PIL import Image

from recon_cli.capture.video_colour import BT709
from recon_cli.errors import ConfigError
from recon_cli.flythrough.request import ALPHA, DEPTH, RGB, TRUST
from recon_cli.io.images import read_image, to_uint8, write_png
from recon_cli.render import RenderOutput
from recon_cli.render.depth_loss import LEAST_COVERAGE
from recon_cli.scene.camera_paths import visible_depths
from recon_cli.scene.scene import Scene
from recon_cli.scene.splats import Splats
from recon_cli.trust.heat_map import error_steps, heat_colors
from recon_cli.workspace.atomic import replacing, write_bytes

DEPTH_COLOR, TRUST_COLOR = "depth_color", "trust_color"
# the frames of its video, and of a single picture
VIDEO_FRAMES = {RGB: RGB, DEPTH: DEPTH_COLOR, ALPHA: ALPHA, TRUST: TRUST_COLOR}
FOLDERS = {RGB: (RGB,), DEPTH: (DEPTH, DEPTH_COLOR), ALPHA: (ALPHA,),
           TRUST: (TRUST, TRUST_COLOR)}
FARTHEST = int(np.iinfo(np.uint16).max)  # steps; greater depths are clipped to it
# Quantiles of depth. Where a camera comes close, few points cover much of a picture: the colours
# begin at half of the first.
_ENDS = (0.02, 0.98)
_BLUE = 0.08  # of the colour map; colours before that are nearly black
ENCODERS = {"h264": ("libx264",), "av1": ("libsvtav1", "libaom-av1")}  # the first available
_QUALITY = 95  # of a .jpg or .webp
_GIF_MS = 20  # of a frame, at least: browsers show shorter ones for 100 ms
os.environ.setdefault("SVT_LOG", "1")  # SVT-AV1 prints its settings to stderr; 1 leaves errors


@dataclass(frozen=True)
class DepthScale:
    """The scale of depth pictures; lengths are in world units."""

    metres: bool  # a step is a millimetre; else it is a thousandth of the scene's extent
    step: float  # of a 16-bit depth
    near: float  # depth that is drawn red
    far: float  # depth that is drawn blue
    center: tuple[float, float, float]  # of the training cameras
    reach: float  # Gaussians farther than this from `center` count as no surface

    def describe_pictures(self) -> dict[str, Any]:
        """Returns what the numbers of the pictures mean, for their readers."""
        return {
            "unit": "millimetre" if self.metres else "thousandth of the scene's extent",
            "world_units_per_step": self.step, "nothing": 0, "this_or_farther": FARTHEST,
            "colors": {"near_red_steps": self.near / self.step,
                       "far_blue_steps": self.far / self.step},
            "surfaces_within": {"center": list(self.center), "world_units": self.reach},
        }

    def select_surfaces(self, splats: Splats) -> Splats:
        """Returns the Gaussians of the room, without the distant ones outside its windows.

        At 100 extents a weight of 0.01 behind a wall would move its mean depth by an extent.
        """
        inside = splats.within(self.center, self.reach)
        return splats if bool(inside.all()) else splats.select(inside)


def depth_scale(scene: Scene, *, metres: bool) -> DepthScale:
    """Returns the scale for a scene; colours span the depths that its training cameras see.

    All frames share it, so that a video does not flicker.
    """
    depths = np.concatenate([visible_depths(view.camera, scene.points) for view in scene.train])
    near, far = np.quantile(depths, _ENDS) if len(depths) else (0.0, scene.extent)
    step = 1e-3 if metres else 1e-3 * scene.extent
    x, y, z = map(float, scene.center)
    return DepthScale(
        metres, step, float(near / 2), float(max(far, near + step)), (x, y, z), scene.reach)


def write_frame(
    folder: Path, name: str, output: RenderOutput, surfaces: RenderOutput, kinds: Sequence[str],
    scale: DepthScale, expected: NDArray[np.float32] | None = None,
) -> None:
    """Writes the pictures of one frame, each atomically; depth is that of `surfaces`.

    `expected` [H, W] is the expected error, which trust needs.
    """
    file = f"{name}.png"
    for kind in kinds:
        if kind == RGB:
            write_png(folder / RGB / file, to_uint8(output.rgb.cpu().numpy()))
        elif kind == ALPHA:
            write_png(folder / ALPHA / file, to_uint8(output.alpha.cpu().numpy()))
        elif kind == TRUST:
            assert expected is not None, "trust was not measured"
            write_png(folder / TRUST / file, error_steps(expected))
            write_png(folder / TRUST_COLOR / file, heat_colors(expected))
        else:
            depth, alpha = surfaces.depth.cpu().numpy(), surfaces.alpha.cpu().numpy()
            steps = depth_steps(depth, alpha, scale.step)
            write_png(folder / DEPTH / file, steps)
            write_png(folder / DEPTH_COLOR / file, depth_colors(steps, scale))


def depth_steps(
    depth: NDArray[np.float32], alpha: NDArray[np.float32], step: float
) -> NDArray[np.uint16]:
    """Returns z-depth [H, W] in whole steps of world units from the sums of alpha T z and alpha T.

    0 where alpha is below one half; otherwise clipped to 1 to 65535.
    """
    covered = alpha >= LEAST_COVERAGE
    mean = depth.astype(np.float64) / np.where(covered, alpha, 1) / step
    return np.where(covered, np.clip(np.rint(mean), 1, FARTHEST), 0).astype(np.uint16)


def depth_colors(steps: NDArray[np.uint16], scale: DepthScale) -> NDArray[np.uint8]:
    """Returns RGB [H, W, 3]: red is near, blue is far, black is nothing."""
    nearness = np.clip((scale.far - steps * scale.step) / (scale.far - scale.near), 0, 1)
    level = (_BLUE + (1 - _BLUE) * nearness).astype(np.float32)
    colors = cv2.applyColorMap(to_uint8(level), cv2.COLORMAP_TURBO)
    rgb = np.asarray(colors[:, :, ::-1], np.uint8).copy()
    rgb[steps == 0] = 0
    return rgb


@dataclass(frozen=True)
class VideoEncoding:
    """The parameters of a video."""

    codec: str  # h264 or av1
    crf: int  # quality, smaller is better
    width: int  # in pixels, even
    height: int  # in pixels, even
    fps: float
    form: str = "mp4"  # of `request.VIDEOS`

    @property
    def rate(self) -> Fraction:
        """Frames a second; the denominator is small, or that of NTSC."""
        return Fraction(self.fps).limit_denominator(1001)

    def encoder(self) -> str:
        """Returns the name of an encoder; ConfigError if this build of PyAV has none."""
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
    """Raises ConfigError without an encoder, or if it rejects this size or rate."""
    if encoding.form == "gif":
        return
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

    Where the user is root, as in a container, SVT-AV1 leaves the thread that opens it with
    real-time priority: threads that spin there later would starve all others.
    """
    if not hasattr(os, "sched_getscheduler"):  # Linux alone has it
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if os.sched_getscheduler(0) != policy:
            os.sched_setscheduler(0, policy, parameters)


def _configure(context: VideoCodecContext, encoding: VideoEncoding) -> None:
    context.width, context.height = encoding.width, encoding.height
    context.pix_fmt = "yuv420p"
    context.framerate = encoding.rate
    context.options = {"crf": str(encoding.crf)}
    # one number in FFmpeg's lists of primaries, transfer functions and matrices
    context.color_primaries = context.color_trc = context.colorspace = int(BT709)
    context.color_range = ColorRange.MPEG


def encode_video(
    pictures: Sequence[Path], path: Path, encoding: VideoEncoding, *, threads: int,
    on_frame: Callable[[], None],
) -> None:
    """Writes RGB or gray pictures as a video, atomically; `on_frame` is called after each."""
    def images() -> Iterator[NDArray[np.uint8]]:
        for picture in pictures:
            yield read_image(picture, encoding.width, encoding.height)
            on_frame()

    if encoding.form == "gif":
        _write_gif(images(), path, encoding.fps)
        return
    options = {} if encoding.form == "webm" else {"movflags": "+faststart"}
    with _restore_scheduling(), replacing(path) as temporary, av.open(
            str(temporary), "w", format=encoding.form, options=options) as container:
        stream = container.add_stream(encoding.encoder(), rate=encoding.rate)
        assert isinstance(stream, VideoStream)
        _configure(stream.codec_context, encoding)
        stream.codec_context.thread_count = threads
        for image in images():
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24").reformat(
                format="yuv420p", dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG)))
        container.mux(stream.encode(None))


def _write_gif(images: Iterator[NDArray[np.uint8]], path: Path, fps: float) -> None:
    """Writes an animation without end; browsers play no faster than 50 frames a second."""
    frames = map(Image.fromarray, images)
    with replacing(path) as temporary:
        next(frames).save(temporary, format="GIF", save_all=True, append_images=frames,
                          duration=max(_GIF_MS, round(1000 / fps)), loop=0)


def write_picture(picture: Path, path: Path) -> None:
    """Writes a finished picture under another name, in the format that its suffix says."""
    if path.suffix.lower() == picture.suffix:
        write_bytes(path, picture.read_bytes())
        return
    with replacing(path) as temporary, Image.open(picture) as image:
        image.save(temporary, format=Image.registered_extensions()[path.suffix.lower()],
                   quality=_QUALITY)
