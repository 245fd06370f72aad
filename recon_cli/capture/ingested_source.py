"""The result of ingesting one source of any kind, and the context that this needs."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from recon_cli.capture.contact_sheet import SHEET, ContactSheet
from recon_cli.capture.frame_selection import CHOICE, FrameCandidate, write_choice
from recon_cli.io.tracks import Tracks, merge_tracks
from recon_cli.progress import Progress
from recon_cli.workspace.records import Frame, Group, KnownPoses


class IngestContext(Protocol):
    """How an ingest reports; a stage's context is one."""

    @property
    def progress(self) -> Progress:
        """Opens progress bars."""

    @property
    def threads(self) -> int:
        """CPU threads to use."""

    def notice(self, text: str) -> None:
        """Tells the user something important that is not an error."""

    def record(self, done: int, total: int, /) -> None:
        """Records how much would survive a crash."""


@dataclass(frozen=True, eq=False)
class Selection:
    """The candidates that the frames of a source were selected from."""

    candidates: tuple[FrameCandidate, ...]  # every frame or photo, in order
    sheet: ContactSheet  # with their thumbnails
    prefix: str  # of the names of the frames and of the two files

    def write(self, stage: Path, held_out: Collection[str]) -> None:
        """Writes the record and the contact sheet into ingest's folder `stage`."""
        write_choice(stage / f"{self.prefix}{CHOICE}", self.candidates)
        self.sheet.write(stage / f"{self.prefix}{SHEET}", held_out)


@dataclass(frozen=True)
class IngestedSource:
    """The stored frames of one source."""

    kind: str  # "video", "photos", or the layout of a data set
    groups: tuple[Group, ...]  # of frames that share intrinsics
    frames: tuple[Frame, ...]  # sorted by name; their groups count within this source
    declared: int  # images that the source claims to hold, 0 where it does not say
    decoded: int  # undamaged ones that it gave
    lost: int  # broken or missing ones
    blurred: int = 0  # those that were too blurred or badly exposed
    skipped: tuple[str, ...] = ()  # names of files that were left out
    splits: bool = False  # the source itself says which frames are held out
    poses: KnownPoses | None = None  # by the names of the frames
    selection: Selection | None = None  # None where all frames are used
    tracks: Tracks | None = None  # through frames that follow each other


def merge_sources(parts: Sequence[IngestedSource]) -> IngestedSource:
    """Returns several sources as one; the names of their frames must differ already."""
    if len(parts) == 1:
        return parts[0]
    groups: list[Group] = []
    frames: list[Frame] = []
    for part in parts:
        frames += [replace(frame, group=frame.group + len(groups)) for frame in part.frames]
        groups += part.groups
    kinds = {part.kind for part in parts}
    tracks = [part.tracks for part in parts if part.tracks is not None]
    return IngestedSource(
        kind=kinds.pop() if len(kinds) == 1 else "mixed", groups=tuple(groups),
        frames=tuple(sorted(frames, key=lambda frame: frame.name)),
        declared=sum(part.declared for part in parts),
        decoded=sum(part.decoded for part in parts),
        lost=sum(part.lost for part in parts),
        blurred=sum(part.blurred for part in parts),
        skipped=tuple(name for part in parts for name in part.skipped),
        tracks=merge_tracks(tracks) if tracks else None)
