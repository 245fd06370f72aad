"""What the bytes of a file tell that PyAV does not: for errors alone, never to decode by.

PyAV names a codec only where it has a decoder, and takes an MP4 without its index for any file.
"""

from __future__ import annotations

import mmap
import re
import struct
from pathlib import Path

# How containers mark their video: MP4 and MOV in the first sample entry of a video track, Matroska
# as V_ and capitals, AVI in the header of a video stream.
MARKS = (
    re.compile(rb"hdlr.{8}vide.*?stsd.{12}([\x20-\x7e]{4})", re.DOTALL),
    re.compile(rb"(V_[A-Z0-9_/]{3,30})"),
    re.compile(rb"strh.{4}vids([\x20-\x7e]{4})", re.DOTALL),
)
SIGNATURES = (rb"....ftyp|....moov|....mdat|....wide", rb"\x1aE\xdf\xa3", rb"RIFF....AVI ")
# What people call those that a build may lack: patents keep HEVC out of some, age AV1 and VVC.
NAMES = {
    "av01": "AV1", "V_AV1": "AV1", "AV01": "AV1",
    "hvc1": "HEVC", "hev1": "HEVC", "dvh1": "HEVC", "dvhe": "HEVC", "V_MPEGH/ISO/HEVC": "HEVC",
    "vvc1": "VVC", "vvi1": "VVC", "evc1": "EVC",
}


def codec_name(path: Path) -> str:
    """Returns what a file calls the codec of its first video, "" where that is not found."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for signature, mark in zip(SIGNATURES, MARKS, strict=True):
            if re.match(signature, data, re.DOTALL) and (found := mark.search(data)):
                name = found[1].decode("ascii").strip()
                return NAMES.get(name, name)
    return ""


def lacks_index(path: Path) -> bool:
    """Returns whether a file is an MP4 or MOV whose index, the moov box, is not there in full."""
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
