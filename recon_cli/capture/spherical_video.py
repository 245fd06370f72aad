"""Videos that are no pictures of one ordinary lens: 360-degree, unstitched, both eyes of 3D.

They are told by their metadata (Google's Spherical Video V1 and V2 in MP4 and MOV, the projection
and the stereo mode in Matroska, which FFmpeg all gives with each frame), else by what they show.
"""

from __future__ import annotations

import struct
from pathlib import Path

from recon_cli.capture import video
from recon_cli.capture.decoded_picture import DecodedPicture, Packing, read_side_data
from recon_cli.capture.limits import SAME_SHAPE
from recon_cli.capture.panoramas import wraps_around
from recon_cli.capture.two_views import find_two_views, has_two_circles
from recon_cli.errors import InputError

# AVSphericalProjection (libavutil/spherical.h); the fifth, rectilinear, is an ordinary picture.
_PROJECTIONS = {
    0: "equirectangular", 1: "cubemap", 2: "equirectangular tile", 3: "half equirectangular",
    5: "fisheye", 6: "parametric immersive"}
_LOOKED_AT, _EVERY = 5, 40  # frames that are looked at, of which most must wrap around
# What cameras with two fisheye lenses write, and who stitches that.
_STITCHERS = {
    ".insv": "Insta360 Studio", ".360": "GoPro Player", ".osv": "DJI Studio"}


def refuse_unusable(path: Path, camera: str) -> None:
    """Raises InputError for a video of which no frame is one picture; `camera` of IngestConfig.

    That are two fisheye lenses, which must be stitched first, and the views of both eyes where no
    tag tells them apart.
    """
    stitcher = _STITCHERS.get(path.suffix.lower())
    sizes = []
    if path.suffix.lower() in (".mp4", ".mov", *_STITCHERS):
        with video.open_video(path) as (container, _):
            sizes = [(stream.codec_context.width, stream.codec_context.height)
                     for stream in video.moving_pictures(container)
                     if stream.codec_context is not None]
    twins = len(sizes) == 2 and sizes[0] == sizes[1] and (
        stitcher is not None or sizes[0][0] == sizes[0][1])
    if stitcher is not None or twins:
        raise _unstitched(path, stitcher, len(sizes))
    if camera == "perspective":
        return
    pictures = [picture.rgb() for picture in video.sample_frames(path, _LOOKED_AT)
             if picture.tags.packing is None]
    if has_two_circles(pictures):
        raise _unstitched(path, None, 1)
    packing = find_two_views(pictures)
    if packing is not None:
        crop = "iw/2:ih:0:0" if packing is Packing.SIDE_BY_SIDE else "iw:ih/2:0:0"
        raise InputError(
            f"Every frame of {path} shows the same view twice ({packing.words}), as 3D video does.",
            hint=f'Cut one view out, for example with ffmpeg -i "{path}" -vf crop={crop} -crf 16 '
            f'"{path.stem}-left.mp4"; --camera perspective uses the frames as they are.')


def _unstitched(path: Path, stitcher: str | None, tracks: int) -> InputError:
    """Returns the error for a recording of two fisheye lenses."""
    held = f"{tracks} tracks of video" if tracks > 1 else "one track of video"
    return InputError(
        f"{path} is a recording of two fisheye lenses that is not stitched yet ({held}).",
        hint=f"Export it as a 360-degree (equirectangular) .mp4 with {stitcher or 'the app'}"
        f"{'' if stitcher else ' of the camera'}, with stabilisation on, and give that.")


def is_spherical(
    path: Path, width: int, height: int, frames: int, camera: str, *,
    size: tuple[int, int] | None = None,
) -> bool:
    """Returns whether a video is a stitched 360-degree one; `camera` is that of IngestConfig.

    `width`, `height`, `frames` and `size` are those of the scan. InputError for one in another
    projection.
    """
    if camera == "perspective":
        return False
    projection = read_projection(path)
    if projection not in ("", "equirectangular"):
        raise InputError(
            f"{path} is a 360-degree video in the projection {projection}; needed is "
            "equirectangular.",
            hint="Export it as equirectangular with the app of the camera.")
    if projection or camera == "equirectangular":
        if abs(width / height / 2 - 1) > SAME_SHAPE:
            raise InputError(
                f"{path} has {width}x{height} pixels; a panorama is twice as wide as high.",
                hint="Export it as a full 360-degree video, or give --camera perspective.")
        return True
    if width != 2 * height:
        return False
    chosen = {index for index in range(0, _LOOKED_AT * _EVERY, _EVERY) if index < frames}
    around = [wraps_around(rgb) for _, rgb in video.frames_at(
        path, chosen, threads=1, size=size)]
    return sum(around) >= min(_LOOKED_AT // 2 + 1, len(around))


def read_projection(path: Path) -> str:
    """Returns the projection of a 360-degree video by its metadata; "" without any."""
    first = next((item for item in video.decode(path, threads=1)
                  if isinstance(item, DecodedPicture)), None)
    data = None if first is None else read_side_data(first.frame, "SPHERICAL")
    return "" if data is None else _PROJECTIONS.get(struct.unpack_from("=i", data)[0], "")
