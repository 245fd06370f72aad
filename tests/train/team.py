"""Processes that train together: the test's own leads, the others are started for it."""

from __future__ import annotations

import dataclasses
import os
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from tiny_task import Hooks

import recon_cli
from recon_cli.train.distributed.data_parallel import dismiss, fit_together
from recon_cli.train.distributed.process_group import TorchProcessGroup
from recon_cli.train.state import save_state

HERE = Path(__file__).parent
ROOT = Path(recon_cli.__file__).parents[1]
PATIENCE = 60  # seconds, for what takes a moment


@dataclass(eq=False)
class Team:
    """The leader's end, and the others as processes."""

    ranks: TorchProcessGroup
    others: list[subprocess.Popen]
    folder: Path
    fits: int = 0

    def fit(self, state, task, until, *, importance=None, **hooks):
        self.fits += 1
        fit_together(
            state, dataclasses.replace(task, ranks=self.ranks), until, (Hooks(**hooks),),
            importance)

    def others_hold(self, state):
        """Whether all others ended the last fit with the very bytes that `state` is saved as."""
        own = self.folder / "own.safetensors"
        # what only the leader keeps, for it alone looks at the validation views
        save_state(own, dataclasses.replace(state, looks=[], jump=None))
        return all(
            self._left(rank).read_bytes() == own.read_bytes()
            for rank in range(1, self.ranks.count))

    def said(self, rank):
        """What another process wrote to stderr."""
        return (self.folder / f"stderr-{rank}").read_text()

    def _left(self, rank):
        path = self.folder / f"rank-{rank}-fit-{self.fits - 1}.safetensors"
        for _ in range(10 * PATIENCE):
            if path.exists():
                break
            time.sleep(0.1)
        return path


@contextmanager
def team(count, folder, script="follower.py"):
    """Yields the leader's end of so many processes, and waits for the others in the end."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    shared = {
        "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "WORLD_SIZE": str(count),
        "LOCAL_WORLD_SIZE": str(count), "TORCHELASTIC_RUN_ID": "test", "PYTHONPATH": str(ROOT)}

    def place(rank):
        return {**os.environ, **shared, "RANK": str(rank), "LOCAL_RANK": str(rank)}

    def started(rank):
        with (folder / f"stderr-{rank}").open("w") as stderr:
            return subprocess.Popen(
                [sys.executable, str(HERE / script), str(folder)], env=place(rank), stderr=stderr)

    others = [started(rank) for rank in range(1, count)]
    try:
        with mock.patch.dict(os.environ, place(0)):
            ranks = TorchProcessGroup.join()
        try:
            yield Team(ranks, others, folder)
        finally:
            dismiss(ranks)
        for one in others:
            one.wait(PATIENCE)
    finally:
        for one in others:
            one.kill()
