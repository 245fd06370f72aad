"""What was captured: the contact sheet or thumbnails, the frames in order, the plan from above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from recon_cli.config.stages import TrainConfig
from recon_cli.errors import FormatError
from recon_cli.io.colmap import read_scene
from recon_cli.io.frames import FOLDER, Frame, fitted, read_frame_list, read_png
from recon_cli.report import floor_plan
from recon_cli.report.chart import entry, mark
from recon_cli.report.images import data_uri, sheet
from recon_cli.report.stage_status import Standing
from recon_cli.scene.scene import Scene
from recon_cli.workspace.summaries import SfmSummary

_SHEETS = 4  # contact sheets that are shown; a capture may have many sources
_THUMBS, _THUMB_SIDE, _THUMB_QUALITY = 24, 220, 72
_STRIP_HEIGHT = 34  # pixels of the row of frames


@dataclass(frozen=True)
class Capture:
    """What the page shows of the capture.

    Attributes:
        sheets: contact sheets as data URIs.
        more_sheets: how many more there are.
        thumbs: (name, data URI) of frames where there is no contact sheet.
        plan: the view from above; None where there is no mapping to draw.
        notes: what must be known to read the plan, sentences.
        strip: all frames in order.
        legend: of plan and strip.
        damaged: why something is not shown.
    """

    sheets: tuple[Markup, ...]
    more_sheets: int
    thumbs: tuple[tuple[str, Markup], ...]
    plan: Markup | None
    notes: tuple[str, ...]
    strip: Markup | None
    legend: Markup | None
    damaged: tuple[str, ...]


def capture(stages: Mapping[str, Standing]) -> Capture:
    """Returns the capture of a workspace, as far as its files can be read."""
    ingest = stages["ingest"]
    damaged: list[str] = []
    frames: tuple[Frame, ...] = ()
    sheets, more, thumbs = [], 0, []
    try:
        frames = read_frame_list(ingest.folder).frames
        found = sorted(ingest.folder.glob("*contact.png"))
        sheets = [sheet(read_png(path)) for path in found[:_SHEETS]]
        more = len(found) - len(sheets)
        thumbs = [] if sheets else _thumbs(ingest.folder, frames)
    except (FormatError, OSError) as error:
        damaged.append(f"The frames are not shown: {error}")
    scene = None
    if stages["sfm"].there and frames:
        try:
            scene = _scene(stages, frames)
        except (FormatError, OSError) as error:
            damaged.append(f"The plan is not shown: {error}")
    plan, notes = _plan(scene, stages["sfm"].read_summary(SfmSummary)) if scene else (None, ())
    return Capture(
        tuple(sheets), more, tuple(thumbs), plan, notes,
        _strip(frames, scene) if frames else None, _legend(frames, scene) if frames else None,
        tuple(damaged))


def _thumbs(folder: Path, frames: Sequence[Frame]) -> list[tuple[str, Markup]]:
    some = frames[:: max(1, -(-len(frames) // _THUMBS))]
    return [(frame.name, data_uri(
        fitted(read_png(folder / FOLDER / frame.name), _THUMB_SIDE), _THUMB_QUALITY))
        for frame in some]


def _scene(stages: Mapping[str, Standing], frames: Sequence[Frame]) -> Scene:
    """Returns cameras and points, split as training splits them."""
    train = stages["train"].manifest
    share = train.basis.config.get("validation") if train else None
    return read_scene(
        stages["sfm"].folder / "undistorted",
        held_out=frozenset(frame.name for frame in frames if frame.held_out),
        validation=TrainConfig.validation if share is None else float(share))


def _plan(scene: Scene, sfm: SfmSummary | None) -> tuple[Markup, tuple[str, ...]]:
    metres = sfm is not None and sfm.world.evidence.metres
    axes = floor_plan.frame_of(scene, z_up=sfm is not None and sfm.world.evidence.up_found)
    notes = [f"{len(scene.points):,} points."]
    if not axes.known:
        notes.append("Up is not known: this is seen along the mean up of the cameras.")
    if not metres:
        notes.append("The scale is arbitrary, so there is no scale bar; "
                     "recon sfm --scale-between A B METRES sets it.")
    return floor_plan.draw(scene, axes, metres=metres), tuple(notes)


def _parts(frames: Sequence[Frame], scene: Scene | None) -> dict[str, str]:
    """Returns what became of each frame, by name; without a mapping only what is held out."""
    if scene is None:
        return {frame.name: "held out" if frame.held_out else "training" for frame in frames}
    parts = {view.name: part for part, views in floor_plan.by_part(scene).items()
             for view in views}
    return {frame.name: parts.get(frame.name, "lost") for frame in frames}


def _strip(frames: Sequence[Frame], scene: Scene | None) -> Markup:
    """Returns one bar for each frame in order; what is held out or lost stands out by its shape."""
    step, bars = floor_plan.WIDTH / len(frames), []
    heights = {"training": 14, "validation": 20, "held out": 28, "lost": 28}
    for at, (frame, part) in enumerate(
            zip(frames, _parts(frames, scene).values(), strict=True)):
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


def _legend(frames: Sequence[Frame], scene: Scene | None) -> Markup:
    counts: dict[str, int] = {}
    for part in _parts(frames, scene).values():
        counts[part] = counts.get(part, 0) + 1
    texts = {"training": "training", "validation": "validation (never trained on, steers progress)",
             "held out": "held out (only scored)", "lost": "without a camera"}
    marks = {**floor_plan.PARTS, "lost": floor_plan.LOST}
    return Markup('<ul class="legend">{}</ul>').format(Markup("").join(
        entry(f"{counts[part]:,} {texts[part]}", mark(shape, 13, 7, 4.5, color))
        for part, (color, shape) in marks.items() if part in counts))
