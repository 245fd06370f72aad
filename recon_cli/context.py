"""The inputs of a stage beside its config: folders to read, reporting, device and backend."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon_cli.deadline import Deadline
from recon_cli.progress import NullProgress, Progress

if TYPE_CHECKING:
    from recon_cli.config.stages import ComputeConfig
    from recon_cli.scene.camera import Camera
    from recon_cli.scene.splats import Splats


@dataclass(frozen=True)
class TrainReport:
    """How the run stands."""

    iteration: int  # steps done
    loss: float  # of this step
    validation_psnr_db: float | None  # mean over the validation views; None where there are none
    gaussians: int  # count
    seconds: float  # of this call, so far
    cpu_seconds: float = 0.0  # of all threads of this process in this call, so far
    # to which the run skips now; None where it just continues
    skip_to_iteration: int | None = None


class TrainCallback:
    """Is called between the steps of a training; may read its arguments and change nothing.

    By default it does nothing. What takes long belongs elsewhere, and an exception ends the fit.
    """

    def on_begin(self, label: str, until: int, cameras: Sequence[Camera], splats: Splats) -> None:
        """Is called before the first step of a run that begins or is resumed.

        `label` names what is trained, `until` is its last step, `cameras` are of training views.
        """

    def on_step(self, iteration: int, splats: Splats) -> None:
        """Is called after steps, at least those of `needs_step`; the next changes the Gaussians."""

    def on_report(self, report: TrainReport) -> None:
        """Is called every hundred steps or so and at the end, before `on_step`."""

    def needs_step(self, iteration: int) -> bool:  # noqa: ARG002
        """Returns whether `on_step` must be called after this step; else the host may run ahead."""
        return False


logger = logging.getLogger("recon")


def _ignore(done: int, total: int) -> None:
    """Keeps no record of progress."""


def _leave_idle() -> None:
    """Does nothing with an idle core."""


@dataclass(frozen=True)
class EarlierResult:
    """The finished result that a stage replaces, of which it reads edits."""

    folder: Path
    changed: frozenset[str] = frozenset()  # relative paths of files that were changed by hand
    missing: frozenset[str] = frozenset()  # of those that were removed
    foreign: frozenset[str] = frozenset()  # of those that the stage did not write


@dataclass(frozen=True)
class StageInputs:
    """The folders and files that a stage may read."""

    # finished folder by stage name: of all in `needs`, and of those in `uses` that are fresh
    folders: Mapping[str, Path] = field(default_factory=dict)
    sources: tuple[Path, ...] = ()  # the user's own files, of ingest and import
    continues: Path | None = None  # finished result of the stage itself that the run continues
    digests: Mapping[str, str] = field(default_factory=dict)  # of the files in each of `folders`
    # what the stage of each of `folders` says about its result
    summaries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    earlier: EarlierResult | None = None  # whose edits the stage reads, if any
    part: str = ""  # of the stage that is made; empty for its own result


@dataclass(frozen=True)
class StageContext:
    """How a stage reports and where it computes."""

    progress: Progress = field(default_factory=NullProgress)  # opens progress bars
    device: str = "cpu"  # "cpu" or "cuda", already resolved
    backend: str = "torch"  # name of a rasterizer, already resolved
    threads: int = 1  # CPU threads to use
    # called with (done, total) whenever that would survive a crash; shown by `recon status`
    record: Callable[[int, int], None] = _ignore
    # called where the stage keeps to one core, of another process, from now on
    while_idle: Callable[[], None] = _leave_idle
    callbacks: tuple[TrainCallback, ...] = ()  # called while Gaussians are trained
    max_memory_bytes: int | None = None  # that a stage may take; None: all that is free
    scratch: Path | None = None  # folder for files without a name; None: the system's
    compute: ComputeConfig | None = None  # as typed, for work on other machines; None: as here
    deadline: Deadline = field(default_factory=Deadline)  # for what the stage may do without

    shared: dict[Hashable, Any] = field(default_factory=dict)  # by one run with its parts

    name_photos: Callable[[str], str] = str  # calls them in a text by the names of their files

    def notice(self, text: str) -> None:
        """Tells the user one line that must not be missed; unprintable characters are escaped."""
        logger.warning("%s", self._printable(text))

    def tell(self, text: str, *, detail: bool = False) -> None:
        """Tells the user one line about a run that goes well; a `detail` is for the log and -v."""
        logger.log(logging.DEBUG if detail else logging.INFO, "%s", self._printable(text))

    def _printable(self, text: str) -> str:
        return "".join(one if one.isprintable() else repr(one)[1:-1]
                       for one in self.name_photos(text))
