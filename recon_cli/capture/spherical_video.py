"""360-degree videos: stitched ones by their metadata or content, and those still to be stitched.

Metadata are the boxes of Google's Spherical Video V2 (st3d, sv3d) and the XML of V1, in the index
of an MP4 or MOV.
"""

from __future__ import annotations

import mmap
import re
import struct
from pathlib import Path

from recon_cli.capture import video
from recon_cli.capture.panoramas import wraps_around
from recon_cli.errors import InputError

_V2 = re.compile(rb"sv3d.{0,400}?proj.{0,200}?(equi|cbmp|mshp)", re.DOTALL)
_V1 = re.compile(rb"GSpherical:ProjectionType>\s*([A-Za-z]+)")
# after version and flags: 1 top and bottom, 2 left and right
_STEREO = re.compile(rb"st3d.{4}[\x01\x02]|GSpherical:StereoMode>\s*(?:top|left)", re.DOTALL)
# Frames that are looked at, and how many of them must wrap around.
_LOOKED_AT, _EVERY, _LEAST = 5, 40, 3
# What cameras with two fisheye lenses write, and who stitches that.
_STITCHERS = {
    ".insv": "Insta360 Studio", ".360": "GoPro Player", ".osv": "DJI Studio"}


def refuse_unstitched(path: Path) -> None:
    """Raises InputError for the recording of two fisheye lenses, which must be stitched first."""
    stitcher = _STITCHERS.get(path.suffix.lower())
    sizes = []
    if path.suffix.lower() in (".mp4", ".mov", *_STITCHERS):
        with video.open_video(path) as (container, _):
            sizes = [(stream.codec_context.width, stream.codec_context.height)
                     for stream in video.moving_pictures(container)
                     if stream.codec_context is not None]
    twins = len(sizes) == 2 and sizes[0] == sizes[1] and (
        stitcher is not None or sizes[0][0] == sizes[0][1])
    if stitcher is None and not twins:
        return
    tracks = f"{len(sizes)} tracks of video" if len(sizes) > 1 else "one track of video"
    raise InputError(
        f"{path} is a recording of two fisheye lenses that is not stitched yet ({tracks}).",
        hint=f"Export it as a 360-degree (equirectangular) .mp4 with {stitcher or 'the app'}"
        f"{'' if stitcher else ' of the camera'}, with stabilisation on, and give that.")


def is_spherical(path: Path, width: int, height: int, frames: int, camera: str) -> bool:
    """Returns whether a video is a stitched 360-degree one; `camera` is that of IngestConfig.

    `width`, `height` and `frames` are those of the scan. InputError for one that cannot be used: in
    another projection, or with a picture for each eye.
    """
    if camera == "perspective":
        return False
    projection, stereo = read_projection(path)
    if stereo and (projection or camera == "equirectangular"):
        raise InputError(
            f"{path} holds a panorama for each eye.",
            hint="Cut one out: of top and bottom, for example with "
            f'ffmpeg -i "{path}" -vf crop=iw:ih/2:0:0 -crf 16 "{path.stem}-left.mp4"')
    if projection not in ("", "equirectangular"):
        raise InputError(
            f"{path} is a 360-degree video in the projection {projection}; needed is "
            "equirectangular.",
            hint="Export it as equirectangular with the app of the camera.")
    if projection or camera == "equirectangular":
        if abs(width / height / 2 - 1) > 0.02:
            raise InputError(
                f"{path} has {width}x{height} pixels; a panorama is twice as wide as high.",
                hint="Export it as a full 360-degree video, or give --camera perspective.")
        return True
    if width != 2 * height:
        return False
    chosen = {index for index in range(0, _LOOKED_AT * _EVERY, _EVERY) if index < frames}
    around = [wraps_around(rgb) for _, rgb in video.frames_at(path, chosen, threads=1)]
    return sum(around) >= min(_LEAST, len(around))


def read_projection(path: Path) -> tuple[str, bool]:
    """Returns the projection by a video's metadata, "" without any, and whether it is stereo."""
    index = _read_index(path)
    v2, v1 = _V2.search(index), _V1.search(index)
    names = {b"equi": "equirectangular", b"cbmp": "cubemap", b"mshp": "mesh"}
    projection = names[v2[1]] if v2 else v1[1].decode().lower() if v1 else ""
    return projection, _STEREO.search(index) is not None


def _read_index(path: Path) -> bytes:
    """Returns the moov box of an MP4 or MOV; empty of other files."""
    size = path.stat().st_size
    if size < 16:
        return b""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        at = 0
        while at + 16 <= size:
            length, name = struct.unpack_from(">I4s", data, at)
            if length == 1:
                length = struct.unpack_from(">Q", data, at + 8)[0]
            if name == b"moov":
                return bytes(data[at:at + length if length else size])
            if length < 8 or not name.isalpha():
                break
            at += length
    return b""
