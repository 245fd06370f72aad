"""Interlaced video to whole frames: one frame out for each one in, at its time.

Two fields taken 1/50 s apart show a moving edge as a comb, which gives false corners and a false
sharpness. bwdif (FFmpeg; w3fdif and yadif together) fills in the rows of the later field from the
earlier one and the frames on both sides. Frames that are not flagged are passed on as they are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator

import av
from av.filter import Graph

from recon_cli.capture.decoded_picture import Gap

# One frame per frame, not per field: the first field's rows stay as they were recorded.
BWDIF = "mode=send_frame:parity=auto:deint=interlaced"


def progressive(
    items: Iterable[av.VideoFrame | Gap],
) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
    """Yields each frame without its comb and whether it had one; gaps keep their place.

    Args:
        items: frames of one size in the order of showing, and gaps.
    """
    filter_: _Deinterlacer | None = None
    for item in items:
        if filter_ is None and isinstance(item, av.VideoFrame) and item.interlaced_frame:
            filter_ = _Deinterlacer(item)
        if filter_ is not None:
            yield from filter_.put(item)
        else:
            yield item if isinstance(item, Gap) else (item, False)
    if filter_ is not None:
        yield from filter_.finish()


class _Deinterlacer:
    """A filter graph, which is one frame late, and what waits for it."""

    def __init__(self, first: av.VideoFrame) -> None:
        self._waiting: deque[av.VideoFrame | Gap] = deque()
        self._graph = Graph()
        source = self._graph.add("buffer", ":".join((
            f"video_size={first.width}x{first.height}", f"pix_fmt={first.format.name}",
            f"time_base={first.time_base}", "pixel_aspect=1/1",
            f"colorspace={first.colorspace}", f"range={first.color_range}")))
        bwdif = self._graph.add("bwdif", BWDIF)
        self._graph.link_nodes(source, bwdif, self._graph.add("buffersink")).configure()

    def put(self, item: av.VideoFrame | Gap) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
        self._waiting.append(item)
        if isinstance(item, av.VideoFrame):
            self._graph.vpush(item)
        yield from self._ready()

    def finish(self) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
        self._graph.vpush(None)
        yield from self._ready()

    def _ready(self) -> Iterator[tuple[av.VideoFrame, bool] | Gap]:
        while self._waiting:
            oldest = self._waiting[0]
            if isinstance(oldest, Gap):
                yield oldest
            else:
                try:
                    frame = self._graph.vpull()
                except (av.error.BlockingIOError, av.error.EOFError):
                    return
                # The filter counts in half frames.
                frame.pts, frame.time_base = oldest.pts, oldest.time_base
                yield frame, oldest.interlaced_frame
            self._waiting.popleft()
