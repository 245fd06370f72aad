"""What every kind of capture comes down to, and what taking one needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from recon_cli.capture.frames import Frame, Group
from recon_cli.io.poses import KnownPoses
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
        blurred: how many were passed over for blur.
        skipped: names of files that were left out.
        details: further facts for the summary, JSON values.
        splits: the source says itself which frames are held out.
        poses: known poses, by the names of the frames.
    """

    kind: str
    groups: tuple[Group, ...]
    frames: tuple[Frame, ...]
    declared: int
    decoded: int
    lost: int
    blurred: int = 0
    skipped: tuple[str, ...] = ()
    details: dict[str, Any] | None = None
    splits: bool = False
    poses: KnownPoses | None = None


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
        details={key: value for part in parts for key, value in (part.details or {}).items()},
    )
