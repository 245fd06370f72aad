"""What every kind of capture comes down to, and what taking one needs."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from recon_cli.capture.contact_sheet import SHEET, ContactSheet
from recon_cli.capture.selection_record import CHOICE, Candidate, write_choice
from recon_cli.io.frames import Frame, Group
from recon_cli.io.posed import KnownPoses
from recon_cli.progress import Progress


class Context(Protocol):
    """How taking a capture reports; a stage's context is one."""

    @property
    def progress(self) -> Progress:
        """Opens progress bars."""

    @property
    def threads(self) -> int:
        """CPU threads to use."""

    def notice(self, text: str) -> None:
        """Tells the user something that is no error but must not be missed."""

    def record(self, done: int, total: int, /) -> None:
        """Notes how much would survive a crash."""


@dataclass(frozen=True, eq=False)
class Choice:
    """What a source was chosen from.

    Attributes:
        candidates: every frame or photo, in order.
        sheet: with the thumbnails that it wants.
        prefix: of the names of the frames, and of the files about the choice.
    """

    candidates: tuple[Candidate, ...]
    sheet: ContactSheet
    prefix: str

    def write(self, stage: Path, held_out: Collection[str]) -> None:
        """Writes the record and the contact sheet into ingest's folder.

        Args:
            stage: the folder.
            held_out: names of the frames that are kept for the score.
        """
        write_choice(stage / f"{self.prefix}{CHOICE}", self.candidates)
        self.sheet.write(stage / f"{self.prefix}{SHEET}", held_out)


@dataclass(frozen=True)
class Taken:
    """The stored frames of one source.

    Attributes:
        kind: "video", "photos", or the layout of a data set.
        groups: of frames that share intrinsics.
        frames: sorted by name; their groups count within this source.
        declared: how many images the source claims to hold, 0 where it does not say.
        decoded: how many whole ones it gave.
        lost: how many are broken or missing.
        blurred: how many were passed over for blur or exposure.
        skipped: names of files that were left out.
        splits: the source says itself which frames are held out.
        poses: known poses, by the names of the frames.
        choice: what it was chosen from, None where nothing was to be chosen.
    """

    kind: str
    groups: tuple[Group, ...]
    frames: tuple[Frame, ...]
    declared: int
    decoded: int
    lost: int
    blurred: int = 0
    skipped: tuple[str, ...] = ()
    splits: bool = False
    poses: KnownPoses | None = None
    choice: Choice | None = None


def joined(parts: Sequence[Taken]) -> Taken:
    """Returns several sources as one; the names of their frames must differ already."""
    if len(parts) == 1:
        return parts[0]
    groups: list[Group] = []
    frames: list[Frame] = []
    for part in parts:
        frames += [replace(frame, group=frame.group + len(groups)) for frame in part.frames]
        groups += part.groups
    kinds = {part.kind for part in parts}
    return Taken(
        kind=kinds.pop() if len(kinds) == 1 else "mixed",
        groups=tuple(groups),
        frames=tuple(sorted(frames, key=lambda frame: frame.name)),
        declared=sum(part.declared for part in parts),
        decoded=sum(part.decoded for part in parts),
        lost=sum(part.lost for part in parts),
        blurred=sum(part.blurred for part in parts),
        skipped=tuple(name for part in parts for name in part.skipped),
    )
