"""A capture in several parts: the frames of each, and where to film to join them.

Parts are joined by a film that shows the way from one to the other, so the page shows the moments
between them: the last frame of one and the first of the next. As many moments are shown as are
needed to join all parts, the shortest first; filming one twice joins no more.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from recon_cli.errors import FormatError, Hint
from recon_cli.io.colmap import read_images, read_points
from recon_cli.report.capture import draw_plan, find_axes
from recon_cli.report.gallery import note_damage, read_picture
from recon_cli.report.stage_status import StageReports
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.workspace.records import FOLDER, Frame, read_frame_list
from recon_cli.workspace.summaries import PartSummary, PlaceSummary

_MOST = 12  # parts on the page
MARGIN = 2.0  # seconds to film before and after a moment, so that the new film ties to both parts
_HINT = Hint("sfm", again=True)


@dataclass(frozen=True)
class PartView:
    """One part on the page."""

    number: int
    placed: bool  # it is the one that is trained
    size: str  # its frames, of how many
    time: str  # when in the film it was seen; empty for photos
    plan: Markup | None  # its cameras and points from above; None where they cannot be read


@dataclass(frozen=True)
class Moment:
    """Where one part ends and another one begins."""

    numbers: tuple[int, int]  # of the parts, in order of the film
    names: tuple[str, str]  # the last frame of the one and the first of the other
    times: tuple[str, str]  # theirs; empty for photos
    pictures: tuple[Markup, Markup]
    lost: int  # frames between them that are in no part
    advice: str  # what to film, in a sentence


@dataclass(frozen=True)
class Parts:
    """The section on parts; without any where the capture is in one."""

    views: tuple[PartView, ...] = ()
    moments: tuple[Moment, ...] = ()
    film: bool = False  # the frames are those of a film
    more: int = 0  # parts that are not shown
    damaged: tuple[str, ...] = ()  # why something is not shown


def read_parts(stages: StageReports) -> Parts:
    """Returns the parts of a workspace's capture, as far as they can be read."""
    cameras = stages["place"].read_summary(PlaceSummary) if stages["place"].there else None
    if cameras is None or len(cameras.parts) < 2:
        return Parts()
    ingest, damaged = stages["ingest"].folder, list[str]()
    try:
        known = read_frame_list(ingest)
        frames = known.frames
        panoramas = any(group.lens is not None and group.lens.is_panorama for group in known.groups)
        moments = tuple(_read_moment(ingest, gap, panoramas=panoramas)
                        for gap in find_moments(frames, cameras.parts))
    except (FormatError, OSError) as error:
        return Parts(damaged=(f"The parts of the capture are not shown: {error}",))
    views = []
    for number, part in list(enumerate(cameras.parts, 1))[:_MOST]:
        placed, plan = number == cameras.part, None
        with note_damage(damaged, f"Part {number} is not drawn"):
            folder = (stages["place"].folder / "sparse" if placed
                      else stages["sfm"].folder / f"parts/{number}")
            up_found = placed and cameras.world.evidence.up_found
            plan = _draw_part(folder, frames, up_found=up_found)
        views.append(PartView(
            number, placed,
            f"{len(part.names):,} of {cameras.frames:,} frames, {part.points:,} points",
            describe_time(frames, cameras.parts, number), plan))
    return Parts(tuple(views), moments, any(frame.time_seconds is not None for frame in frames),
                 len(cameras.parts) - len(views), tuple(damaged))


def _draw_part(model: Path, frames: Sequence[Frame], *, up_found: bool) -> Markup:
    """Returns cameras and points of a COLMAP model from above."""
    held_out = {frame.name for frame in frames if frame.held_out}
    views = [View(name, Camera(1, 1, 1.0, 1.0, 0.5, 0.5, viewmat), Path(name), Path(name))
             for name, _, viewmat in read_images(model / "images.bin", hint=_HINT)]
    points, colors = read_points(model / "points3D.bin", hint=_HINT)
    scene = Scene(
        tuple(view for view in views if view.name not in held_out), (),
        tuple(view for view in views if view.name in held_out), (), points, colors)
    return draw_plan(scene, find_axes(scene, z_up=up_found), metres=False)


def number_frames(frames: Sequence[Frame], parts: Sequence[PartSummary]) -> list[int]:
    """Returns the number of the part of each frame, 0 for none."""
    numbers = {name: number for number, part in enumerate(parts, 1) for name in part.names}
    return [numbers.get(frame.name, 0) for frame in frames]


@dataclass(frozen=True)
class PartGap:
    """The gap between two parts in the order of the frames."""

    numbers: tuple[int, int]
    before: Frame
    after: Frame
    lost: int  # frames between

    @property
    def length(self) -> tuple[float, int]:
        """Seconds, where they are known, and frames; of two films no seconds are known."""
        times = (self.before.time_seconds, self.after.time_seconds)
        if None in times or self.before.source != self.after.source:
            return float("inf"), self.lost
        return float(times[1] or 0.0) - float(times[0] or 0.0), self.lost


def find_moments(frames: Sequence[Frame], parts: Sequence[PartSummary]) -> list[PartGap]:
    """Returns the shortest gaps that join all parts with each other, in the order of the frames."""
    numbers = number_frames(frames, parts)
    rows = [row for row, number in enumerate(numbers) if number]
    gaps = [PartGap((numbers[row], numbers[other]), frames[row], frames[other], other - row - 1)
            for row, other in itertools.pairwise(rows) if numbers[row] != numbers[other]]
    group = list(range(len(parts) + 1))  # of parts that are joined by now, by any of their numbers
    chosen = []
    for gap in sorted(gaps, key=lambda each: each.length):
        first, second = (group[number] for number in gap.numbers)
        if first != second:
            group = [first if one == second else one for one in group]
            chosen.append(gap)
    return [gap for gap in gaps if gap in chosen][:_MOST]


def _read_moment(ingest: Path, gap: PartGap, *, panoramas: bool) -> Moment:
    pictures = [read_picture(ingest / FOLDER / frame.name) for frame in (gap.before, gap.after)]
    times = _format_time(gap.before), _format_time(gap.after)
    return Moment(gap.numbers, (gap.before.name, gap.after.name), times,
                  (pictures[0], pictures[1]), gap.lost,
                  advise(gap, panoramas=panoramas))


def advise(gap: PartGap, *, panoramas: bool = False) -> str:
    """Returns a sentence on where to film to join two parts."""
    first, second = _format_time(gap.before), _format_time(gap.after)
    if panoramas and not (first and second):
        return (f"Take panoramas half a metre apart on the way from where {gap.before.name} was "
                f"taken to where {gap.after.name} was taken, one of them in each doorway.")
    if not first or not second:
        return (f"Take ten or more photos on the way from where {gap.before.name} was taken to "
                f"where {gap.after.name} was taken; each overlaps the one before by half.")
    if gap.before.source != gap.after.source:
        where = f"the way from {gap.before.source} at {first} to {gap.after.source} at {second}"
    else:
        start, end = _format_time(gap.before, -MARGIN), _format_time(gap.after, MARGIN)
        where = f"the places of the film from {start} to {end}"
    return (f"Film {where} again: walk slowly from where the left picture was taken to where the "
            "right one was taken, sideways rather than turning on the spot, and keep half of the "
            "view in the picture from one second to the next.")


def describe_time(
    frames: Sequence[Frame], parts: Sequence[PartSummary], number: int
) -> str:
    """Returns when in the film a part was seen, and for how long; empty for photos."""
    seen: list[list[Frame]] = []
    numbers = number_frames(frames, parts)
    numbered = [item for item in zip(numbers, frames, strict=True) if item[0]]
    for (one, _), run in itertools.groupby(numbered, key=lambda item: (item[0], item[1].source)):
        if one == number:
            seen.append([frame for _, frame in run])
    spans = [(run[0], run[-1]) for run in seen]
    if any(frame.time_seconds is None for span in spans for frame in span):
        return ""
    seconds = sum((last.time_seconds or 0.0) - (first.time_seconds or 0.0)
                  for first, last in spans)
    text = ", ".join(f"{_format_time(first)} to {_format_time(last)}" for first, last in spans)
    return f"{text} ({seconds:.0f} s of the film)"


def _format_time(frame: Frame, later: float = 0.0) -> str:
    """Returns minutes and seconds of a frame in its film, or later; empty for a photo."""
    if frame.time_seconds is None:
        return ""
    minutes, seconds = divmod(int(max(0.0, frame.time_seconds + later) + 0.5), 60)
    return f"{minutes}:{seconds:02d}"
