"""Images that lie in a file and are in memory only while they are looked at."""

from __future__ import annotations

import mmap
import tempfile
import threading
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

SEGMENT = 256 << 20  # bytes mapped, or in memory, at once: each mapping takes a file descriptor
_ALIGNMENT = 64  # bytes, a cache line


class ImageFile:
    """Keeps images in a file without a name; at most about `window` bytes of them are in memory.

    The arrays that `put` returns are views of the file, to be read only. Where the system cannot
    be told to drop pages (Windows), it drops them by itself.
    """

    def __init__(self, folder: Path | None, window: int) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  # closed with the object
        self._window, self._looked_at = window, 0
        self._segments: list[mmap.mmap] = []
        self._start = 0  # of the last segment in the file
        self._used = 0  # bytes of that
        self._lock = threading.Lock()

    def put(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Writes an image of any shape and returns it as it lies in the file.

        Raises:
            OSError: the disk is full.
        """
        data = np.ascontiguousarray(image)
        with self._lock:
            if not self._segments or self._used + data.nbytes > len(self._segments[-1]):
                self._add_segment(data.nbytes)
            segment, begin = self._segments[-1], self._used
            self._file.seek(self._start + begin)
            self._file.write(data.data)
            self._file.flush()
            self._used += -(-data.nbytes // _ALIGNMENT) * _ALIGNMENT
        return np.frombuffer(segment, np.uint8, data.size, begin).reshape(image.shape)

    def _add_segment(self, needed: int) -> None:
        granularity = mmap.ALLOCATIONGRANULARITY
        if self._segments:
            self._start += -(-len(self._segments[-1]) // granularity) * granularity
        size = max(SEGMENT, needed)
        self._file.truncate(self._start + size)  # takes no room on the disk yet
        self._segments.append(mmap.mmap(
            self._file.fileno(), size, access=mmap.ACCESS_COPY, offset=self._start))
        self._used = 0

    def look(self, size: int) -> None:
        """Counts `size` bytes that are read now; past the window all are let out of memory."""
        with self._lock:
            self._looked_at += size
            if self._looked_at <= self._window or not hasattr(mmap, "MADV_DONTNEED"):
                return
            self._looked_at = size
            for segment in self._segments:
                segment.madvise(mmap.MADV_DONTNEED)
