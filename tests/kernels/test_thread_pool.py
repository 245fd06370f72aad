"""Threads that run a kernel together: all of them finish, and what fails in one is heard."""

import _thread
import threading
import time

import pytest

from recon_cli.kernels.thread_pool import ThreadPool

WAIT = 0.3  # seconds; long against a switch of threads, short for a test


@pytest.fixture
def pool():
    pool = ThreadPool()
    pool.threads = 3
    return pool


def on_workers(work):
    """A stand-in for a kernel that does something in every thread but the caller's."""
    caller = threading.current_thread()

    def kernel(_counter, *_arguments):
        if threading.current_thread() is not caller:
            work()

    return kernel


def test_the_caller_gets_what_went_wrong_in_a_thread(pool):
    error = MemoryError()

    def fail():
        raise error

    with pytest.raises(MemoryError) as caught:
        pool.run(on_workers(fail))
    assert caught.value is error
    done = []
    pool.run(on_workers(lambda: done.append(1)))  # and the threads work on
    assert len(done) == 2


def test_an_interrupt_waits_until_no_thread_writes_any_more(pool):
    done = []

    def write_late():
        time.sleep(WAIT)
        done.append(1)

    pool.run(on_workers(lambda: None))  # starts the threads
    timer = threading.Timer(WAIT / 3, _thread.interrupt_main)
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        pool.run(on_workers(write_late))
    assert len(done) == 2
    timer.join()


def test_the_observer_hears_each_kernel_by_name(pool):
    heard = []
    pool.observer = lambda name, seconds: heard.append((name, seconds >= 0))
    pool.run(on_workers(lambda: None), scratch=False)
    assert heard == [("kernel", True)]
