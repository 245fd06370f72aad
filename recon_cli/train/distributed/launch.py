"""Processes that torchrun started: the first one runs the command line, the others train along."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager

from recon_cli.context import SINGLE_PROCESS, ProcessGroup
from recon_cli.errors import LostError
from recon_cli.lazy import load

# RANK and WORLD_SIZE alone are set by other programs as well, for purposes of their own.
_MARK = "TORCHELASTIC_RUN_ID"

logger = logging.getLogger("recon")


def follows() -> bool:
    """Tells whether this process is one of the others."""
    return _are_several() and os.environ["RANK"] != "0"


def _are_several() -> bool:
    return _MARK in os.environ and os.environ.get("WORLD_SIZE", "1") != "1"


@contextmanager
def leading() -> Iterator[ProcessGroup]:
    """Yields the processes that this one leads, and lets them go in the end.

    Raises:
        BackendError: they cannot be connected.
    """
    if not _are_several():
        yield SINGLE_PROCESS
        return
    # to be seen where they never all come: under somebody else's torchrun
    logger.info("one of %s processes that torchrun started: waiting for the others",
                os.environ["WORLD_SIZE"])
    ranks = load("recon_cli.train.distributed.process_group.TorchProcessGroup").join()
    del os.environ[_MARK]  # what this process starts itself is alone
    try:
        yield ranks
    finally:
        load("recon_cli.train.distributed.data_parallel.dismiss")(ranks)


def follow() -> int:
    """Trains along until the leader is done; returns the exit code. Ctrl-C is left to the leader.

    Raises:
        BackendError: the processes cannot be connected.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # torchrun ends it so, without a word
    logger.setLevel(logging.WARNING)
    processes = load("recon_cli.train.distributed.process_group.TorchProcessGroup")
    try:
        load("recon_cli.train.distributed.data_parallel.follow")(processes.join())
    except LostError as error:
        return error.exit_code
    return 0
