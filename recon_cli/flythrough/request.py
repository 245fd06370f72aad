"""The options of `recon render`, checked as far as possible without a workspace."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from recon_cli.errors import ConfigError

TRAINING, ORBIT, TOUR = "training", "orbit", "tour"  # values of --path besides a file
RGB, DEPTH, ALPHA, TRUST = OUTPUTS = ("rgb", "depth", "alpha", "trust")
PNG = "png"
# The kinds of video and the codecs of each, the default first; a .gif has no other
VIDEOS = {"mp4": ("h264", "av1"), "mov": ("h264",), "webm": ("av1",), "gif": ("gif",)}
FORMATS = (PNG, *VIDEOS)
PICTURES = (".png", ".jpg", ".jpeg", ".webp")  # of a single view
FPS, SECONDS = 30.0, 10.0  # defaults
TOUR_SECONDS, TOUR_SIZE = 60.0, 1280  # of a tour
_CRF_LIMITS = {"h264": 51, "av1": 63}
CODECS = tuple(_CRF_LIMITS)
CRF = {"h264": 18, "av1": 28}  # hardly a difference to the eye
MAX_FRAMES = 100_000


@dataclass(frozen=True)
class RenderRequest:
    """The options of the command; ConfigError if one is out of range, or two exclude each other."""

    path: str = TRAINING  # "training", "orbit", "tour" or a .json with cameras
    views: tuple[str, ...] = ()  # test, train, validation or names of frames, instead of a path
    outputs: tuple[str, ...] = (RGB,)  # of rgb, depth, alpha, trust
    model: str = "auto"  # auto, base or pruned
    fps: float | None = None  # None takes that of the file, or 30
    seconds: float | None = None  # length of a path that is made here; None is 10, of a tour 60
    size: int | None = None  # longest side in pixels
    width: int | None = None  # without size, width and height: the size of training or the file
    height: int | None = None
    background: tuple[int, int, int] | None = None  # RGB, 0 to 255; None is the scene's own
    form: str | None = None  # of FORMATS; None is that of `out`, or png
    codec: str | None = None  # h264 or av1; None is the first of the format
    crf: int | None = None  # quality of the video, smaller is better
    out: Path | None = None  # folder, video or picture; None is a folder in the workspace
    panorama: bool = False  # each frame shows all directions

    def __post_init__(self) -> None:
        if self.file is None and self.path not in (TRAINING, ORBIT, TOUR):
            raise ConfigError(
                f"--path takes {TRAINING}, {ORBIT}, {TOUR} or a FILE.json, but got {self.path!r}.",
                hint="Give one of these; a file of cameras must end in .json.")
        self._check_numbers()
        self._check_views()
        self._check_video()
        if self.out_file is not None and len(self.outputs) > 1:
            raise ConfigError(
                f"{self.out_file} is one file, but there are {len(self.outputs)} outputs.",
                hint="Give a folder with --out, or one --output.")

    @property
    def file(self) -> Path | None:
        """The camera path to read, if --path names one."""
        return Path(self.path) if self.path.lower().endswith(".json") else None

    @property
    def out_file(self) -> Path | None:
        """The file that --out names; None if it names a folder."""
        suffix = "" if self.out is None else self.out.suffix.lower()
        return self.out if suffix in PICTURES or suffix[1:] in VIDEOS else None

    @property
    def video(self) -> str:
        """The kind of video that frames become; empty where they do not."""
        form = self.form
        if form is None and self.out_file is not None:
            form = self.out_file.suffix.lower()[1:]
        return form if form in VIDEOS else ""

    @property
    def quality(self) -> tuple[str, int]:
        """Codec and CRF of the video."""
        codec = self.codec or VIDEOS[self.video or "mp4"][0]
        return codec, CRF.get(codec, 0) if self.crf is None else self.crf

    def frames(self) -> int:
        """Returns how many frames a path that is made here has."""
        seconds = self.seconds or (TOUR_SECONDS if self.path == TOUR else SECONDS)
        return max(1, round((self.fps or FPS) * seconds))

    def _check_numbers(self) -> None:
        for name, value, highest in (("fps", self.fps, 240), ("seconds", self.seconds, 86_400)):
            if value is not None and not (math.isfinite(value) and 0 < value <= highest):
                raise ConfigError(
                    f"--{name} is {value:g}; it must be above 0 and at most {highest}.",
                    hint=f"Give a number in that range with --{name}, or leave it out.")
        for name in ("size", "width", "height"):
            pixels = getattr(self, name)
            if pixels is not None and pixels < 1:
                raise ConfigError(
                    f"--{name} is {pixels}; it must be at least 1 pixel.",
                    hint=f"Give more pixels with --{name}, or leave it out.")
        if self.size is not None and (self.width or self.height):
            raise ConfigError(
                "--size and --width or --height exclude each other.",
                hint="Leave --size out, or the others.")
        if self.panorama and self.width and self.height and self.width != 2 * self.height:
            raise ConfigError(
                f"A panorama is twice as wide as high, not {self.width}x{self.height} pixels.",
                hint="Give --size, --width or --height alone.")
        if self.panorama and self.width and self.width % 2:
            raise ConfigError(
                f"--width is {self.width}; that of a panorama is even.",
                hint="Give an even number.")
        if not all(0 <= value <= 255 for value in self.background or ()):
            raise ConfigError(
                f"--background is {self.background}; values must be 0 to 255.",
                hint="Give red, green and blue, such as --background 255,255,255.")
        if self.frames() > MAX_FRAMES:
            raise ConfigError(
                f"The path has {self.frames():,} frames; at most {MAX_FRAMES:,} are rendered.",
                hint="Lower --fps or --seconds.")

    def _check_views(self) -> None:
        if self.file is not None and self.seconds is not None:
            raise ConfigError(
                "--seconds has no effect on a path from a file, which lists its frames.",
                hint="Leave --seconds out; --fps makes the video longer or shorter.")
        if not self.views:
            return
        for name in ("fps", "seconds"):
            if getattr(self, name) is not None:
                raise ConfigError(
                    f"--{name} has no effect on single views.",
                    hint=f"Leave --{name} out, or give --path instead of --views.")
        if self.video:
            raise ConfigError(
                "Single views cannot become a video.",
                hint="Give --path instead of --views, or no video.")
        if self.width and self.height:
            raise ConfigError(
                "--width and --height together have no effect on single views, which keep their "
                "shape.", hint="Give one of them, or --size.")

    def _check_video(self) -> None:
        codec, _ = self.quality
        for name in ("codec", "crf"):
            if getattr(self, name) is not None and self.video in ("", "gif"):
                raise ConfigError(
                    f"--{name} has no effect without a video, nor on a .gif.",
                    hint=f"Add --format mp4, or leave --{name} out.")
        if self.video and codec not in VIDEOS[self.video]:
            raise ConfigError(
                f"A .{self.video} holds {' or '.join(VIDEOS[self.video])}, not {codec}.",
                hint="Leave --codec out, or give another --format.")
        if self.crf is not None and not 0 <= self.crf <= _CRF_LIMITS[codec]:
            raise ConfigError(
                f"--crf is {self.crf}; {codec} accepts 0 to {_CRF_LIMITS[codec]}.",
                hint=f"Give a number in that range; {CRF[codec]} is the default.")
        self._check_out()

    def _check_out(self) -> None:
        file, out = self.out_file, self.out
        if file is None:
            if out is not None and out.suffix[1:2].isalpha() and not out.is_dir():
                raise ConfigError(
                    f"--out names {out.name}, but {out.suffix} cannot be written.",
                    hint=f"Videos are {', '.join(f'.{form}' for form in VIDEOS)}, single views "
                    f"{', '.join(PICTURES)}; a folder has no suffix.")
            return
        if not self.video and DEPTH in self.outputs:
            raise ConfigError(
                f"{file} alone would not tell the unit of its depth.",
                hint="Give a folder with --out; its render.json tells the unit.")
        kind = file.suffix.lower()[1:]
        if kind != self.video if self.video else kind in VIDEOS or (
                self.form == PNG and kind != PNG):
            raise ConfigError(
                f"--out names {file.name}, but the format is {self.video or PNG}.",
                hint="Give a folder, or a file that ends as the format does.")
