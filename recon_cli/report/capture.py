"""The capture on the page: contact sheets or thumbnails, the strip of frames, the floor plan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from recon_cli.config.stages import TrainConfig
from recon_cli.errors import FormatError
from recon_cli.io.colmap import read_scene
from recon_cli.io.images import fit_image, read_png
from recon_cli.io.records import FOLDER, Frame, read_frame_list
from recon_cli.report import floor_plan
from recon_cli.report.chart import draw_mark, legend_item
from recon_cli.report.gallery import data_uri, encode_sheet
from recon_cli.report.stage_status import Statuses
from recon_cli.scene.scene import Scene
from recon_cli.workspace.summaries import SfmSummary

_SHEETS = 4  # contact sheets on the page; a capture may have many sources
_THUMBS, _THUMB_SIDE, _THUMB_QUALITY = 24, 220, 72
_STRIP_HEIGHT = 34  # pixels of the strip of frames


@dataclass(frozen=True)
class Capture:
    """The section on the capture; pictures are data URIs."""

    sheets: tuple[Markup, ...]  # contact sheets
    more_sheets: int  # contact sheets that are left out
    thumbs: tuple[tuple[str, Markup], ...]  # (name, picture) of frames if there is no sheet
    plan: Markup | None  # None without a mapping to draw
    notes: tuple[str, ...]  # on the plan
    strip: Markup | None  # all frames in order
    legend: Markup | None  # of plan and strip
    damaged: tuple[str, ...]  # why something is not shown


def read_capture(stages: Statuses) -> Capture:
    """Returns the capture of a workspace, as far as its files can be read."""
    ingest = stages["ingest"]
    damaged: list[str] = []
    frames: tuple[Frame, ...] = ()
    sheets, more, thumbs = [], 0, []
    try:
        frames = read_frame_list(ingest.folder).frames
        paths = sorted(ingest.folder.glob("*contact.png"))
        sheets = [encode_sheet(read_png(path)) for path in paths[:_SHEETS]]
        more = len(paths) - len(sheets)
        thumbs = [] if sheets else _read_thumbs(ingest.folder, frames)
    except (FormatError, OSError) as error:
        damaged.append(f"The frames are not shown: {error}")
    scene = None
    if stages["sfm"].there and frames:
        try:
            scene = _read_scene(stages, frames)
        except (FormatError, OSError) as error:
            damaged.append(f"The plan is not shown: {error}")
    plan, notes = _draw_plan(scene, stages["sfm"].read_summary(SfmSummary)) if scene else (None, ())
    parts = _part_of_each(frames, scene)
    return Capture(
        tuple(sheets), more, tuple(thumbs), plan, notes,
        _draw_strip(frames, parts) if frames else None, _draw_legend(parts) if frames else None,
        tuple(damaged))


def _read_thumbs(folder: Path, frames: Sequence[Frame]) -> list[tuple[str, Markup]]:
    some = frames[:: max(1, -(-len(frames) // _THUMBS))]
    return [(frame.name, data_uri(
        fit_image(read_png(folder / FOLDER / frame.name), _THUMB_SIDE), _THUMB_QUALITY))
        for frame in some]


def _read_scene(stages: Statuses, frames: Sequence[Frame]) -> Scene:
    """Returns cameras and points, split as training splits them."""
    train = stages["train"].manifest
    share = train.key.config.get("validation") if train else None
    return read_scene(
        stages["sfm"].folder / "undistorted",
        held_out=frozenset(frame.name for frame in frames if frame.held_out),
        validation=TrainConfig.validation if share is None else float(share))


def _draw_plan(scene: Scene, sfm: SfmSummary | None) -> tuple[Markup, tuple[str, ...]]:
    """Returns the floor plan and notes on it."""
    metres = sfm is not None and sfm.world.evidence.metres
    axes = floor_plan.find_axes(scene, z_up=sfm is not None and sfm.world.evidence.up_found)
    notes = [f"{len(scene.points):,} points."]
    if not axes.known:
        notes.append("Up is not known: the view is along the mean up of the cameras.")
    if not metres:
        notes.append("The scale is arbitrary, so there is no scale bar; "
                     "recon sfm --scale-between A B METRES sets it.")
    return floor_plan.draw_plan(scene, axes, metres=metres), tuple(notes)


def _part_of_each(frames: Sequence[Frame], scene: Scene | None) -> list[str]:
    """Returns the part that each frame belongs to; without a mapping only what is held out."""
    if scene is None:
        return ["held out" if frame.held_out else "training" for frame in frames]
    parts = {view.name: part for part, views in floor_plan.by_part(scene).items()
             for view in views}
    return [parts.get(frame.name, "lost") for frame in frames]


def _draw_strip(frames: Sequence[Frame], parts: Sequence[str]) -> Markup:
    """Returns one bar for each frame in order; held-out and lost frames are taller."""
    step, bars = floor_plan.WIDTH / len(frames), []
    heights = {"training": 14, "validation": 20, "held out": 28, "lost": 28}
    for at, (frame, part) in enumerate(zip(frames, parts, strict=True)):
        color = (floor_plan.PARTS.get(part) or floor_plan.LOST)[0]
        time = "" if frame.time_seconds is None else f", {frame.time_seconds:g} s"
        bars.append(Markup(
            '<rect class="part c{}{}" x="{:.2f}" y="{}" width="{:.2f}" height="{}">'
            "<title>{}</title></rect>").format(
                color, " hollow" if part == "lost" else "", at * step,
                _STRIP_HEIGHT - heights[part], max(0.6, 0.8 * step), heights[part],
                f"{frame.name} ({part}{time})"))
    return Markup(
        '<svg class="strip" viewBox="0 0 {} {}" preserveAspectRatio="none" role="img" '
        'aria-label="The frames in order">{}</svg>').format(
            floor_plan.WIDTH, _STRIP_HEIGHT, Markup("").join(bars))


def _draw_legend(parts: Sequence[str]) -> Markup:
    counts = Counter(parts)
    texts = {"training": "training", "validation": "validation (never trained on, steers progress)",
             "held out": "held out (only scored)", "lost": "without a camera"}
    marks = {**floor_plan.PARTS, "lost": floor_plan.LOST}
    return Markup('<ul class="legend">{}</ul>').format(Markup("").join(
        legend_item(f"{counts[part]:,} {texts[part]}", draw_mark(shape, 13, 7, 4.5, color))
        for part, (color, shape) in marks.items() if part in counts))
