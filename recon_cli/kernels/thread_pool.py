"""Threads that run one kernel together, and the scratch memory that each of them owns.

Kernels release the GIL and take blocks of work from a shared counter. OpenMP is not used: its
threads spin at every barrier and slow down other processes. The result of a block does not
depend on who takes it: any number of threads gives the same bits.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any

import numpy as np
from numpy.typing import NDArray

AT_ONCE = 128  # rows, triangles or blocks that a thread takes at a time
SCRATCH_FLOATS = 1 << 14  # 64 KB: no kernel needs more; what it uses all the time stays in L1
Kernel = Callable[..., Any]


def empty_aligned(size: int, dtype: Any = np.float32) -> NDArray[Any]:
    """Returns an uninitialised flat array that begins on a cache line."""
    kind = np.dtype(dtype)
    raw = np.empty(size * kind.itemsize + 64, np.uint8)
    shift = -raw.ctypes.data % 64
    return raw[shift : shift + size * kind.itemsize].view(kind)


class ThreadPool:
    """A pool of threads that waits for kernels."""

    def __init__(self) -> None:
        self.threads: int | None = None  # None: torch's number of threads
        # called with the name of each kernel and the seconds that it took
        self.observer: Callable[[str, float], None] | None = None
        self._lock = threading.Lock()
        self._inboxes: list[SimpleQueue[Callable[[], None]]] = []
        self._wake: SimpleQueue[None] = SimpleQueue()
        self._scratch: list[NDArray[np.float32]] = []
        self._process = os.getpid()

    @property
    def size(self) -> int:
        """How many threads run a kernel."""
        if self.threads:
            return self.threads
        import torch

        return torch.get_num_threads()

    def run(self, kernel: Kernel, *arguments: Any, scratch: bool = True) -> None:
        """Calls kernel(counter, *arguments, scratch) in every thread and waits for all.

        The kernel takes blocks of work from counter[0] until none is left. With `scratch` its last
        argument is a flat array that no other thread uses.
        """
        start = time.perf_counter()
        count = self.size
        counter = np.zeros(1, np.int64)
        with self._lock:
            self._prepare(count)
            ended: list[BaseException | None] = []  # the failure of each other thread

            def call(number: int) -> None:
                own = (self._scratch[number],) if scratch else ()
                kernel(counter, *arguments, *own)

            def task(number: int) -> Callable[[], None]:
                return lambda: ended.append(_failure_of(call, number))

            for number in range(1, count):
                self._inboxes[number - 1].put(task(number))
            try:
                call(0)
            finally:
                interrupt = self._wait(ended, count - 1)
            for failure in (interrupt, *ended):
                if failure is not None:
                    raise failure
        if self.observer is not None:
            self.observer(getattr(kernel, "py_func", kernel).__name__, time.perf_counter() - start)

    def _wait(self, ended: list[BaseException | None], count: int) -> BaseException | None:
        """Waits until `count` threads have ended; returns the Ctrl-C that came meanwhile.

        The list decides; a message on the queue only wakes, because an interrupt may lose one.
        """
        interrupt: BaseException | None = None
        while len(ended) < count:
            try:
                self._wake.get()
            except KeyboardInterrupt as error:
                interrupt = error
        return interrupt

    def _prepare(self, count: int) -> None:
        if self._process != os.getpid():  # threads do not survive a fork
            self._inboxes, self._wake, self._process = [], SimpleQueue(), os.getpid()
        while len(self._scratch) < count:
            self._scratch.append(empty_aligned(SCRATCH_FLOATS))
        while len(self._inboxes) < count - 1:
            inbox: SimpleQueue[Callable[[], None]] = SimpleQueue()
            self._inboxes.append(inbox)
            threading.Thread(
                target=_work, args=(inbox, self._wake), daemon=True, name="recon-kernel").start()


def _work(inbox: SimpleQueue[Callable[[], None]], wake: SimpleQueue[None]) -> None:
    while True:
        inbox.get()()
        wake.put(None)


def _failure_of(call: Callable[[int], None], number: int) -> BaseException | None:
    """Returns the exception of a call, to be raised in the thread that waits."""
    try:
        call(number)
    except BaseException as error:
        return error
    return None


pool = ThreadPool()
