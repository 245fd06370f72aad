"""The capture on the page: contact sheets or thumbnails, the strip of frames, the floor plan.

On the plan, points are one density image, whose size does not depend on their number; a camera is a
mark with a line in its viewing direction.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from recon_cli.config.stages import TrainConfig
from recon_cli.errors import list_names
from recon_cli.io.colmap import read_scene
from recon_cli.io.images import read_png
from recon_cli.io.svg import PlanLayout, element, label
from recon_cli.report.chart import TICK_STEPS, draw_legend, draw_mark
from recon_cli.report.gallery import embed, encode_sheet, note_damage, read_picture
from recon_cli.report.records import read_regions
from recon_cli.report.stage_status import StageReports
from recon_cli.scene.gravity import find_gravity, mean_up
from recon_cli.scene.scene import Scene, View, views_ahead
from recon_cli.trust.records import PoorlySeenRegion
from recon_cli.workspace.records import FOLDER, Frame, describe_stretches, read_frame_list
from recon_cli.workspace.summaries import PlaceSummary

_SHEETS = 4  # contact sheets on the page; a capture may have many sources
_THUMBS = 24  # without contact sheets
_STRETCHES = 30  # of frames that are left out, by name
_STRIP_HEIGHT = 34  # pixels of the strip of frames
WIDTH = 640  # pixels of plan and strip; the page scales them
_MAX_HEIGHT = 560
_MARGIN = 26  # pixels around the plan
_CELL = 2  # pixels of the plan in a cell of the density image
_PERCENTILES = (2.0, 98.0)  # of the points that fit in; outliers may lie far away
_GRAY = 128  # of the points: visible on white and on black
_MANY_CAMERAS = 150  # from which on marks are smaller
_REGION_COLOR, _REGION_SIZE = 6, 9.0  # of the marks of poorly seen regions, pixels
# (color, mark) of the page's charts; green and blue are those of the contact sheet
PARTS = {"training": (2, "circle"), "validation": (5, "square"), "held out": (0, "diamond")}
MISSING = {"other part": (4, "triangle"), "left out": (1, "plus"), "lost": (3, "cross")}


@dataclass(frozen=True)
class CaptureSection:
    """The section on the capture; pictures are data URIs."""

    sheets: tuple[Markup, ...]  # contact sheets
    more_sheets: int  # contact sheets that are left out
    overlays: tuple[Markup, ...]  # frames with overlays in red
    thumbs: tuple[tuple[str, Markup], ...]  # (name, picture) of frames, without a contact sheet
    plan: Markup | None  # None without a mapping to draw
    notes: tuple[str, ...]  # on the plan
    strip: Markup | None  # all frames in order
    left_out: str  # which frames are left out with a part that is not trusted; empty if none
    legend: Markup | None  # of plan and strip
    damaged: tuple[str, ...]  # why something is not shown


def read_capture(stages: StageReports) -> CaptureSection:
    """Returns the capture of a workspace, as far as its files can be read."""
    ingest = stages["ingest"]
    damaged: list[str] = []
    frames: tuple[Frame, ...] = ()
    sheets, more, thumbs = [], 0, []
    overlays: list[Markup] = []
    scene = None
    with note_damage(damaged, "The frames are not shown"):
        frames = read_frame_list(ingest.folder).frames
        paths = sorted(ingest.folder.glob("*contact.png"))
        sheets = [encode_sheet(read_png(path)) for path in paths[:_SHEETS]]
        more = len(paths) - len(sheets)
        some = () if sheets else frames[:: max(1, -(-len(frames) // _THUMBS))]
        thumbs = [(frame.name, read_picture(ingest.folder / FOLDER / frame.name))
                  for frame in some]
    with note_damage(damaged, "Masked areas are not shown"):
        overlays = [read_picture(path)
                    for path in sorted(ingest.folder.glob("*overlay.png"))[:_SHEETS]]
    if stages["place"].there and frames:
        with note_damage(damaged, "The plan is not shown"):
            scene = _read_scene(stages, frames)
    sfm = stages["place"].read_summary(PlaceSummary)
    left_out = sfm.left_out if sfm else ()
    plan, notes = _draw_plan(scene, sfm, read_regions(stages)) if scene else (None, ())
    by_name = {view.frame: part for part, views in by_part(scene).items()
               for view in views} if scene else {
        frame.name: "held out" if frame.held_out else "training" for frame in frames}
    missing = {
        **{name: "other part" for part in (sfm.parts if sfm else ()) for name in part.names},
        **dict.fromkeys(left_out, "left out")}
    parts = [by_name.get(frame.name, missing.get(frame.name, "lost")) for frame in frames]
    return CaptureSection(
        tuple(sheets), more, tuple(overlays), tuple(thumbs), plan, notes,
        _draw_strip(frames, parts) if frames else None, _describe_left_out(frames, left_out),
        _draw_legend(parts) if frames else None, tuple(damaged))


def _describe_left_out(frames: Sequence[Frame], names: Sequence[str]) -> str:
    """Returns where in the capture the frames are that have no camera to trust."""
    held_out = sum(frame.held_out for frame in frames if frame.name in names)
    stretches = list_names(describe_stretches(frames, names), _STRETCHES)
    return (f"{len(names):,} frames are left out, as their cameras could not be trusted, "
            f"{held_out or 'none'} of them held out: {stretches}.") if stretches else ""


def _read_scene(stages: StageReports, frames: Sequence[Frame]) -> Scene:
    """Returns cameras and points, with the split of the training."""
    train = stages["train"].manifest
    share = train.key.config.get("validation") if train else None
    return read_scene(
        stages["place"].folder / "undistorted",
        held_out=frozenset(frame.name for frame in frames if frame.held_out),
        validation=TrainConfig.validation if share is None else float(share))


def _draw_plan(
    scene: Scene, sfm: PlaceSummary | None, regions: Sequence[PoorlySeenRegion]
) -> tuple[Markup, tuple[str, ...]]:
    """Returns the floor plan and notes on it."""
    metres = sfm is not None and sfm.world.evidence.metres
    axes = find_axes(scene, z_up=sfm is not None and sfm.world.evidence.up_found)
    notes = [f"{len(scene.points):,} points."]
    if not axes.known:
        notes.append("Up is not known: the view is along the mean up of the cameras.")
    if not metres:
        notes.append("The scale is arbitrary, so the plan has no scale bar;  "
                     "recon sfm --scale-between A B METRES sets it.")
    if regions:
        notes.append("Numbers are poorly seen regions, as listed under Trust.")
    return draw_plan(scene, axes, metres=metres, regions=regions), tuple(notes)


def _draw_strip(frames: Sequence[Frame], parts: Sequence[str]) -> Markup:
    """Returns one bar for each frame in order; held-out and lost frames are taller."""
    step, bars = WIDTH / len(frames), []
    heights = {"training": 14, "validation": 20}  # others are taller
    for i, (frame, part) in enumerate(zip(frames, parts, strict=True)):
        color = {**PARTS, **MISSING}[part][0]
        time = "" if frame.time_seconds is None else f", {frame.time_seconds:g} s"
        height = heights.get(part, 28)
        bars.append(element(
            "rect", element("title", f"{frame.name} ({part}{time})"),
            class_=f"part c{color}{' hollow' if part in MISSING else ''}", x=f"{i * step:.2f}",
            y=_STRIP_HEIGHT - height, width=f"{max(0.6, 0.8 * step):.2f}", height=height))
    return element("svg", Markup("").join(bars), class_="strip", role="img",
                   viewBox=f"0 0 {WIDTH} {_STRIP_HEIGHT}", preserveAspectRatio="none",
                   aria_label="The frames in order")


def _draw_legend(parts: Sequence[str]) -> Markup:
    counts = Counter(parts)
    texts = {"training": "training", "validation": "validation (never trained on, steers progress)",
             "held out": "held out (only scored)", "lost": "without a camera",
             "other part": "in another part of the capture",
             "left out": "left out, with a camera that is not trusted"}
    marks = {**PARTS, **MISSING}
    return draw_legend(
        (f"{counts[part]:,} {texts[part]}", draw_mark(shape, 13, 7, 4.5, color))
        for part, (color, shape) in marks.items() if part in counts)


@dataclass(frozen=True, eq=False)
class PlanAxes:
    """The axes of a plan."""

    axes: NDArray[np.float64]  # [2, 3] unit vectors of the world: right and up on the page
    known: bool  # the vertical is known, from the mapping or from cameras and floor


def find_axes(scene: Scene, *, z_up: bool) -> PlanAxes:
    """Returns the axes of a plan: x and y where z is up, otherwise approximately level."""
    if z_up:
        return PlanAxes(np.eye(3)[:2], known=True)
    viewmats = np.stack([view.camera.viewmat for views in by_part(scene).values()
                         for view in views])
    gravity = find_gravity(scene.points, viewmats).up
    up = mean_up(viewmats) if gravity is None else gravity
    right = np.eye(3)[np.argmin(np.abs(up))]
    right = right - (right @ up) * up
    right = right / np.linalg.norm(right)
    return PlanAxes(np.stack([right, np.cross(up, right)]), known=gravity is not None)


def draw_plan(
    scene: Scene, axes: PlanAxes, *, metres: bool, regions: Sequence[PoorlySeenRegion] = ()
) -> Markup:
    """Returns the plan as SVG, with a scale bar if one world unit is a metre (`metres`).

    Poorly seen `regions` are circles of their size, numbered from 1.
    """
    parts = by_part(scene)
    centers = np.stack([view.camera.center for views in parts.values() for view in views])
    points, places = scene.points @ axes.axes.T, centers @ axes.axes.T
    middles = np.array([each.position for each in regions]).reshape(-1, 3) @ axes.axes.T
    layout = _fit_layout(points, np.vstack([places, middles]))
    size = 3.0 if len(centers) > _MANY_CAMERAS else 4.5
    marks = [_draw_camera(view, axes, layout, part, size)
             for part, views in parts.items() for view in views]
    marks += [_draw_region(number, each, axes, layout)
              for number, each in enumerate(regions, 1)]
    if metres:
        most = WIDTH / layout.scale / 4
        power = 10.0 ** math.floor(math.log10(most))
        length = max(step * power for step in TICK_STEPS if step * power <= most)
        marks.append(layout.scale_bar(
            (WIDTH - _MARGIN, layout.height - 10), length, 6, class_="axis scale"))
    return element(
        "svg", _draw_density(points, layout) + Markup("").join(marks), class_="plan", role="img",
        viewBox=f"0 0 {WIDTH} {layout.height}", aria_label="Cameras and points from above")


def by_part(scene: Scene) -> Mapping[str, Sequence[View]]:
    """Returns the views of a scene by the names of PARTS."""
    parts = map(views_ahead, (scene.train, scene.validation, scene.test))
    return dict(zip(PARTS, parts, strict=True))


def _fit_layout(points: NDArray[np.float64], places: NDArray[np.float64]) -> PlanLayout:
    """Returns the largest centred layout of every camera [C, 2] and nearly all points [N, 2]."""
    most = np.percentile(points, _PERCENTILES, axis=0) if len(points) else places
    low, high = np.minimum(most.min(0), places.min(0)), np.maximum(most.max(0), places.max(0))
    room = np.maximum(0.02 * (high - low), 1e-6 + 0.02 * float((high - low).max()))
    low, high = low - room, high + room
    size = high - low
    scale = float(((np.array([WIDTH, _MAX_HEIGHT]) - 2 * _MARGIN) / size).min())
    height = round(float(size[1]) * scale) + 2 * _MARGIN
    middle = np.array([WIDTH, height]) / 2
    return PlanLayout(scale, (low + high) / 2 - middle / scale, height)


def _draw_density(points: NDArray[np.float64], layout: PlanLayout) -> Markup:
    """Returns the points as an image whose opacity grows with the logarithm of their number."""
    rows, columns = math.ceil(layout.height / _CELL), math.ceil(WIDTH / _CELL)
    pixels = layout.at(points)
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], bins=(rows, columns),
        range=((0, rows * _CELL), (0, columns * _CELL)))
    full = np.percentile(counts[counts > 0], 99) if counts.any() else 1
    opacity = np.where(counts > 0, 0.4 + 0.6 * np.log1p(counts) / np.log1p(full), 0).clip(0, 1)
    picture = np.full((rows, columns, 4), _GRAY, np.uint8)
    picture[..., 3] = np.rint(230 * opacity)
    _, data = cv2.imencode(".png", picture)
    return element("image", width=columns * _CELL, height=rows * _CELL,
                   href=embed(data.tobytes(), "png"))


def _draw_camera(view: View, axes: PlanAxes, layout: PlanLayout, part: str, size: float) -> Markup:
    color, shape = PARTS[part]
    camera = view.camera
    x, y = map(float, layout.at(axes.axes @ camera.center))
    ahead = axes.axes @ camera.viewmat[2, :3]  # z of the camera, projected onto the plan
    across, down = 4 * size * ahead * (1, -1)
    line = element("path", class_=f"line c{color}", d=f"M{x:.1f},{y:.1f}l{across:.1f},{down:.1f}")
    radius = size * (1.25 if part == "held out" else 1.0)
    return line + draw_mark(shape, x, y, radius, color, f"{view.name} ({part})")


def _draw_region(
    number: int, each: PoorlySeenRegion, axes: PlanAxes, layout: PlanLayout
) -> Markup:
    x, y = map(float, layout.at(axes.axes @ np.array(each.position)))
    return (
        element("circle", class_=f"line c{_REGION_COLOR}", cx=x, cy=y,
                r=each.size / 2 * layout.scale)
        + draw_mark("circle", x, y, _REGION_SIZE, _REGION_COLOR, f"poorly seen: {each.cause}")
        + label(x, y + 4, number, class_="next"))
