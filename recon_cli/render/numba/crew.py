"""Threads that run one kernel together, and the scratch memory that each of them owns.

Kernels release the GIL and take blocks of work from a shared counter, so a Python thread each is
all it needs: no OpenMP, whose threads spin at every barrier and slow down whatever runs beside
them. What a block computes does not depend on who takes it: any number of threads gives the same
bits.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

SCRATCH_FLOATS = 1 << 13  # 32 KB: no kernel needs more, and it stays in the first-level cache

Kernel = Callable[..., Any]


def aligned(size: int, dtype: Any = np.float32) -> NDArray[Any]:
    """Returns an uninitialised flat array that begins on a cache line."""
    kind = np.dtype(dtype)
    raw = np.empty(size * kind.itemsize + 64, np.uint8)
    shift = -raw.ctypes.data % 64
    return raw[shift : shift + size * kind.itemsize].view(kind)


class Crew:
    """A pool of threads that waits for kernels.

    Attributes:
        threads: how many run a kernel; torch's number of threads if None.
        observer: told the name of each kernel and the seconds that it took; None for nobody.
    """

    def __init__(self) -> None:
        self.threads: int | None = None
        self.observer: Callable[[str, float], None] | None = None
        self._lock = threading.Lock()
        self._inboxes: list[SimpleQueue[Callable[[], None]]] = []
        self._done: SimpleQueue[BaseException | None] = SimpleQueue()
        self._scratch: list[NDArray[np.float32]] = []
        self._process = os.getpid()

    @property
    def size(self) -> int:
        """How many threads run a kernel."""
        return self.threads or torch.get_num_threads()

    def run(self, kernel: Kernel, *arguments: Any, scratch: bool = True) -> None:
        """Calls kernel(counter, *arguments, scratch) in every thread and waits for all.

        Args:
            kernel: takes blocks of work from counter[0] until none is left.
            *arguments: the same for all threads.
            scratch: the kernel takes a flat array that no other thread uses as its last argument.
        """
        start = time.perf_counter()
        count = self.size
        counter = np.zeros(1, np.int64)
        with self._lock:
            self._prepare(count)

            def call(number: int) -> Callable[[], None]:
                own = (self._scratch[number],) if scratch else ()
                return lambda: kernel(counter, *arguments, *own)

            for number in range(1, count):
                self._inboxes[number - 1].put(call(number))
            failures: list[BaseException | None] = []
            try:
                call(0)()
            finally:  # no thread may still write when the arrays are handed on
                failures = [self._done.get() for _ in range(count - 1)]
            for failure in failures:
                if failure is not None:
                    raise failure
        if self.observer is not None:
            self.observer(getattr(kernel, "py_func", kernel).__name__, time.perf_counter() - start)

    def _prepare(self, count: int) -> None:
        if self._process != os.getpid():  # threads do not survive a fork
            self._inboxes, self._done, self._process = [], SimpleQueue(), os.getpid()
        while len(self._scratch) < count:
            self._scratch.append(aligned(SCRATCH_FLOATS))
        while len(self._inboxes) < count - 1:
            inbox: SimpleQueue[Callable[[], None]] = SimpleQueue()
            self._inboxes.append(inbox)
            threading.Thread(
                target=_work, args=(inbox, self._done), daemon=True, name="recon-kernel").start()


def _work(
    inbox: SimpleQueue[Callable[[], None]], done: SimpleQueue[BaseException | None]
) -> None:
    while True:
        task = inbox.get()
        failure: BaseException | None = None
        try:
            task()
        except BaseException as error:  # handed to the caller's thread
            failure = error
        del task
        done.put(failure)


crew = Crew()
