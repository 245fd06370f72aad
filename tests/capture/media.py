"""Small videos and RAW photos that the tests make for themselves."""

import struct
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

UPRIGHT = (65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30)


def texture(height, width, *, seed=0, coarseness=4):
    """Returns random blocks, [height, width, 3]: corners to follow, edges to blur."""
    shape = (-(-height // coarseness), -(-width // coarseness), 3)
    blocks = np.random.default_rng(seed).integers(30, 226, shape, dtype=np.uint8)
    return np.kron(blocks, np.ones((coarseness, coarseness, 1), np.uint8))[:height, :width]


def write_video(
    path: Path, frames: Iterable[np.ndarray], *, codec="libx264", pixels="yuv420p", rate=10,
    colorspace=None, color_range=None, options=None, muxer=None, aspect=None,
):
    """Writes RGB frames; with the default options almost without loss."""
    with av.open(str(path), "w", format=muxer) as container:
        stream = None
        for rgb in frames:
            if stream is None:
                stream = container.add_stream(codec, rate=rate)
                stream.height, stream.width = rgb.shape[:2]
                stream.pix_fmt = pixels
                stream.codec_context.options = options or ({"qp": "4"} if "264" in codec else {})
                if aspect is not None:
                    stream.codec_context.sample_aspect_ratio = aspect
                if colorspace is not None:
                    stream.codec_context.colorspace = colorspace
                    stream.codec_context.color_range = color_range
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")
            target = {} if colorspace is None else {
                "dst_colorspace": colorspace, "dst_color_range": color_range}
            for packet in stream.encode(frame.reformat(format=pixels, **target)):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def write_luma(path: Path, lumas, *, depth=10, trc=1, primaries=1, colorspace=1):
    """Writes gray frames of these code values [H, W], limited range, without loss."""
    pixels = "yuv420p10le" if depth == 10 else "yuv420p"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.height, stream.width = lumas[0].shape
        stream.pix_fmt = pixels
        context = stream.codec_context
        context.options = {"qp": "0"}
        context.color_trc, context.color_primaries = trc, primaries
        context.colorspace, context.color_range = colorspace, 1
        for luma in lumas:
            chroma = np.full((luma.shape[0] // 2, luma.shape[1]), 1 << (depth - 1))
            planes = np.concatenate([luma, chroma]).astype(np.uint16 if depth == 10 else np.uint8)
            frame = av.VideoFrame.from_ndarray(planes, format=pixels)
            frame.colorspace, frame.color_range = colorspace, 1
            for packet in stream.encode(frame):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def woven(moments, order="tff"):
    """Returns frames whose rows come from two moments in turn: the top ones first, or last."""
    later = 1 if order == "tff" else 0
    frames = [first.copy() for first in moments[::2]]
    for frame, second in zip(frames, moments[1::2], strict=True):
        frame[later::2] = second[later::2]
    return frames


def write_interlaced(path: Path, frames, *, order="tff", options=None, rate=25, muxer=None):
    """Writes RGB frames as interlaced H.264, flagged with the order of their fields."""
    graph = av.filter.Graph()
    height, width = frames[0].shape[:2]
    source = graph.add_buffer(
        width=width, height=height, format="yuv420p", time_base=Fraction(1, rate))
    # x264 takes the order from the frames, and only a filter can flag those.
    graph.link_nodes(source, graph.add("setfield", order), graph.add("buffersink")).configure()
    with av.open(str(path), "w", format=muxer) as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        stream.codec_context.options = {
            "qp": "4", "x264-params": f"{order}=1", **(options or {})}
        for index, rgb in enumerate(frames):
            frame = av.VideoFrame.from_ndarray(rgb).reformat(format="yuv420p")
            frame.pts, frame.time_base = index, Fraction(1, rate)
            graph.vpush(frame)
            container.mux(stream.encode(graph.vpull()))
        container.mux(stream.encode())
    return path


def write_sound(path: Path):
    """Writes half a second of silence."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=16000, layout="mono")
        samples = av.AudioFrame.from_ndarray(
            np.zeros((1, 8000), np.float32), format="fltp", layout="mono")
        samples.sample_rate = 16000
        for packet in [*stream.encode(samples), *stream.encode()]:
            container.mux(packet)
    return path


def set_display_matrix(path: Path, matrix):
    """Overwrites the 3x3 matrix in an MP4's track header, as a phone held upright writes it."""
    data = bytearray(path.read_bytes())
    box = data.index(b"tkhd")
    times = 32 if data[box + 4] else 20  # version 1 holds 64-bit times
    start = box + 8 + times + 16
    assert struct.unpack(">9i", data[start:start + 36]) == UPRIGHT
    data[start:start + 36] = struct.pack(">9i", *matrix)
    path.write_bytes(data)


def set_edit_list(path: Path, edits):
    """Makes an MP4 show these parts of its video: (first second, seconds) each; None is a pause."""
    data = bytearray(path.read_bytes())
    movie, media = (
        struct.unpack_from(">I", data, data.index(name) + 16)[0] for name in (b"mvhd", b"mdhd"))
    start = data.index(b"elst") - 4
    length, = struct.unpack_from(">I", data, start)
    first, = struct.unpack_from(">i", data, start + 20)  # what B-frames need in front
    entries = b"".join(
        struct.pack(">Iihh", round(seconds * movie),
                    -1 if second is None else first + round(second * media), 1, 0)
        for second, seconds in edits)
    box = struct.pack(">I4sII", 16 + len(entries), b"elst", 0, len(edits)) + entries
    for parent in (b"moov", b"trak", b"edts"):
        at = data.index(parent) - 4
        size, = struct.unpack_from(">I", data, at)
        struct.pack_into(">I", data, at, size + len(box) - length)
    data[start:start + length] = box
    path.write_bytes(data)


def spoil_packets(path: Path, numbers, *, erase=False):
    """Overwrites the inside of the packets that come at these places in the file."""
    with av.open(str(path)) as container:
        spans = [(p.pos, p.size) for p in container.demux(video=0) if p.size]
    data = bytearray(path.read_bytes())
    noise = np.random.default_rng(7)
    for number in numbers:
        start, size = spans[number]
        # From 8 bytes on: behind the length and the first header, so that the damage is decoded.
        first = start if erase else start + min(8, size // 2)
        length = start + size - first
        data[first:start + size] = bytes(length) if erase else noise.bytes(length)
    path.write_bytes(data)


def write_dng(path: Path, mosaic, *, orientation=1):
    """Writes an RGGB mosaic [H, W] of 16 bits as the smallest DNG that LibRaw takes."""
    height, width = mosaic.shape
    pixels = mosaic.astype("<u2").tobytes()

    def rationals(*values):
        return struct.pack(f"<{2 * len(values)}i", *(x for v in values for x in (v, 1)))

    short, long = struct.Struct("<H").pack, struct.Struct("<I").pack
    name = b"Test\0"
    entries = [  # tag, type, count, value
        (254, 4, 1, long(0)), (256, 4, 1, long(width)), (257, 4, 1, long(height)),
        (258, 3, 1, short(16)), (259, 3, 1, short(1)), (262, 3, 1, short(32803)),
        (271, 2, 5, name), (272, 2, 5, name), (273, 4, 1, None),
        (274, 3, 1, short(orientation)), (277, 3, 1, short(1)), (278, 4, 1, long(height)),
        (279, 4, 1, long(len(pixels))), (33421, 3, 2, short(2) + short(2)),
        (33422, 1, 4, bytes([0, 1, 1, 2])), (50706, 1, 4, bytes([1, 4, 0, 0])),
        (50708, 2, 5, name), (50714, 4, 1, long(0)), (50717, 4, 1, long(65535)),
        (50721, 10, 9, rationals(1, 0, 0, 0, 1, 0, 0, 0, 1)), (50728, 5, 3, rationals(1, 1, 1)),
    ]
    beyond = 8 + 2 + 12 * len(entries) + 4  # values longer than 4 bytes, then the pixels
    pixels_at = beyond + sum(len(v) + len(v) % 2 for *_, v in entries if v and len(v) > 4)
    table, values = b"", b""
    for tag, kind, count, value in entries:
        value = long(pixels_at) if value is None else value
        if len(value) > 4:
            table += struct.pack("<HHII", tag, kind, count, beyond + len(values))
            values += value + b"\0" * (len(value) % 2)
        else:
            table += struct.pack("<HHI", tag, kind, count) + value.ljust(4, b"\0")
    path.write_bytes(b"II*\0" + long(8) + short(len(entries)) + table + long(0) + values + pixels)
    return path


def turn_heic(path: Path, turns):
    """Makes a HEIC say in its box irot that it is to be turned left by quarters.

    The box takes the place of pixi, which only repeats the number of bits.
    """
    data = bytearray(path.read_bytes())
    box = data.index(b"pixi")
    assert data[box - 4:box] == struct.pack(">I", 16)
    data[box:box + 12] = b"irot" + bytes([turns]) + bytes(7)
    path.write_bytes(data)
    return path
