"""What a stage is given beside its config: where to read, how to report, what to compute on."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recon_cli.progress import NullProgress, Progress
from recon_cli.train.ranks import ALONE, Ranks
from recon_cli.watching import Nobody, Watcher

Summary = dict[str, Any]  # JSON values only; goes into the manifest

logger = logging.getLogger("recon")


def _ignore(done: int, total: int) -> None:
    """Keeps no record of progress."""


@dataclass(frozen=True)
class StageInputs:
    """What a stage may read.

    Attributes:
        folders: finished folder of each stage named in `needs`, and of those in `uses` that are
            fresh, by stage name.
        sources: the user's own files; only ingest has any.
    """

    folders: Mapping[str, Path] = field(default_factory=dict)
    sources: tuple[Path, ...] = ()


@dataclass(frozen=True)
class StageContext:
    """How a stage reports and where it computes.

    Attributes:
        progress: opens progress bars.
        device: "cpu" or "cuda", already resolved.
        backend: name of a rasterizer, already resolved.
        threads: CPU threads to use.
        record: called with (done, total) whenever that much would survive a crash;
            `recon status` shows it as partial (412/600).
        watcher: looks on while Gaussians are trained.
        ranks: the processes that train together, which this one leads.
    """

    progress: Progress = field(default_factory=NullProgress)
    device: str = "cpu"
    backend: str = "torch"
    threads: int = 1
    record: Callable[[int, int], None] = _ignore
    watcher: Watcher = field(default_factory=Nobody)
    ranks: Ranks = ALONE

    def notice(self, text: str) -> None:
        """Tells the user something that is no error but must not be missed, in one line.

        It may hold file names, and those may hold whatever moves a terminal's cursor.
        """
        logger.warning("%s", "".join(
            one if one.isprintable() else repr(one)[1:-1] for one in text))

    def notice_idle(self, views: int) -> None:
        """Tells the user where steps of so many views leave processes without one."""
        idle = self.ranks.count - views
        if idle > 0:
            self.notice(f"{idle} of the {self.ranks.count} processes have nothing to do: a step "
                        f"takes --batch-views {views}")
