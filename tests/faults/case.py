"""One fault: its folder, its dice, and the commands that it runs."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from forked import Finished, Running, start, start_process
from judge import (
    Outcome,
    Verdict,
    broken,
    clear_error,
    costs_training,
    follow_hint,
    snapshot,
    wrong,
)
from lab import LIMIT, Lab, copy
from moments import Moments

T = TypeVar("T")
# Of a reader: a decoder, and pixels or coefficients of a small file; then what text takes as JSON
MOST_BYTES, MOST_RATIO = 1 << 30, 64


@dataclass
class Case:
    """The inputs of a kind of fault."""

    lab: Lab
    rng: random.Random
    turn: int  # how many faults of the kind came before: to go through lists in order
    folder: Path  # empty, and its own
    ran: list[Finished] = field(default_factory=list)
    story: list[str] = field(default_factory=list)  # what was done, for -v
    may_add: bool = False  # to the user's files outside, where a link asks for that
    _canary: dict[str, str] = field(default_factory=dict)

    def tell(self, text: str) -> None:
        """Notes what is done to whom."""
        self.story.append(text)

    def pick(self, items: Sequence[object], *, stride: int = 1) -> object:
        """Returns an item: all of them come up in turn."""
        return items[self.turn * stride % len(items)]

    def draw(self, items: Iterable[T]) -> T:
        """Returns an item at random; the same one again where a few others came or went.

        For what an interrupted command left, which differs a little from run to run.
        """
        salt = self.rng.random()
        return min(items, key=lambda item: hashlib.sha256(f"{salt} {item}".encode()).digest())

    def workspace(self, source: Path | None = None, *, without: Sequence[str] = ()) -> Path:
        """Returns a copy of a workspace, the finished one unless another is named."""
        return copy(source or self.lab.tiny, self.folder / "ws", without=without)

    def outside(self) -> Path:
        """Returns a folder of the user's files outside of any workspace, which must survive."""
        folder = self.folder / "outside"
        (folder / "photos").mkdir(parents=True)
        for name in ("thesis.db", "photos/a.jpg", "photos/b.jpg"):
            (folder / name).write_bytes(name.encode() * 1000)
        self._canary = snapshot(folder)
        return folder

    def canary_lost(self) -> Verdict | None:
        """Returns the verdict where a file outside of the workspace was changed."""
        found = snapshot(self.folder / "outside") if self._canary else {}
        if self.may_add:
            found = {name: digest for name, digest in found.items() if name in self._canary}
        if found != self._canary:
            return wrong(Outcome.LOST, self.ran[-1] if self.ran else None,
                         "files outside of the workspace are gone or changed")
        return None

    def start(
        self, *words: str, moments: Moments | None = None, at: int | None = None,
        act: Callable[[int], None] | None = None, prepare: Callable[[], None] | None = None,
    ) -> Running:
        """Starts a command; `act` is done at its `at`-th moment."""
        def ready() -> None:
            if prepare is not None:
                prepare()
            if moments is not None:
                moments.watch(at, act)

        return start(words, cwd=self.folder, prepare=ready)

    def start_process(
        self, *words: str, flags: Sequence[str] = (), environment: Mapping[str, str] | None = None
    ) -> Running:
        """Starts a command as a new process of Python."""
        return start_process(words, cwd=self.folder, flags=flags, environment=environment)

    def finish(self, running: Running, limit: float = LIMIT) -> Finished:
        """Returns how a command ended."""
        done = running.finish(limit)
        self.ran.append(done)
        self.tell(f"{done}\n{done.err.strip()[-1500:]}")
        return done

    def run(self, *words: str, prepare: Callable[[], None] | None = None) -> Finished:
        """Runs a command to its end."""
        return self.finish(self.start(*words, prepare=prepare))

    def judge_error(self, done: Finished, workspace: Path | None, *, follow: bool = True
                    ) -> Verdict:
        """Returns the verdict on a command that failed: clear, with a hint that helps?"""
        bad = broken(done) or self.canary_lost()
        if bad:
            return bad
        if not follow:
            return clear_error(done)
        if workspace is not None and self._keeps_scene(workspace) and (
                bad := costs_training(done)):
            return bad
        return follow_hint(done, workspace, lambda words: self.run(*words),
                           lambda: self.run(*done.words))

    def _keeps_scene(self, workspace: Path) -> bool:
        """Returns whether the scene of a workspace is there, byte for byte."""
        scenes = [root / "train" / "splats.ply" for root in (workspace, self.lab.tiny)]
        return scenes[0].is_file() and scenes[0].read_bytes() == scenes[1].read_bytes()

    def judge_memory(self, done: Finished, path: Path) -> Verdict | None:
        """Returns the verdict where a reader took more memory than a file's size explains."""
        files = path.rglob("*") if path.is_dir() else [path]
        size = sum(one.stat().st_size for one in files if one.is_file())
        if done.memory_bytes > MOST_BYTES + MOST_RATIO * size:
            return wrong(Outcome.BUG, done, f"{done.memory_bytes >> 20} MB for {size:,} bytes")
        return None
