"""From the mapper's frame to the world: which way is up, where the floor is, how long a metre is.

A mapper's frame is that of its first pair of images, in an arbitrary scale. `world_transform`
combines what cameras, points, a device and the user say about the world into one similarity, with
its evidence. The user gives a scale by --scale-between: a known distance between two places.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import SfmError, name_command
from recon_cli.room.scale import (
    ARBITRARY,
    DATA_SET,
    FUSED,
    MEASURED,
    Measurement,
    ScaleBetween,
    measure,
    parse_place,
)
from recon_cli.room.scale_fusion import (
    GIVEN,
    GIVEN_ERROR,
    MEASURED_BETWEEN,
    FusedScale,
    ScaleSource,
    describe_sources,
    fuse,
    fuse_measured,
)
from recon_cli.scene.camera import Lens
from recon_cli.scene.gravity import Gravity, find_gravity, turn_onto, upright_axes
from recon_cli.scene.similarity import Similarity
from recon_cli.workspace.records import FrameList
from recon_cli.workspace.summaries import WorldEvidence, WorldSummary


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """The world frame; see `WorldSummary`."""

    similarity: Similarity
    evidence: WorldEvidence
    measurement: Measurement | None  # what gave the scale, in the world before it was scaled
    sentences: tuple[str, ...]

    def summary(self) -> WorldSummary:
        """Returns the record for world.json and the summary of the stage."""
        return WorldSummary(
            similarity=self.similarity.to_json(), evidence=self.evidence,
            measurement=self.measurement.to_json() if self.measurement else None,
            sentences=self.sentences)


def find_places(
    frames: FrameList, scale_between: tuple[str, str, float] | None
) -> tuple[str, str, float] | None:
    """Returns the two places of --scale-between by the names of frames, and their distance.

    ConfigError if a place is unknown.
    """
    if scale_between is None:
        return None
    first, second = frames.find(scale_between[:2])
    for place in (first, second):
        parse_place(place, [frame.name for frame in frames.frames])
    return first, second, scale_between[2]


def world_transform(
    points: NDArray[np.float64],  # [P, 3] sparse points in the mapper's frame
    viewmats: Mapping[str, NDArray[np.float64]],  # [4, 4] world to camera of each frame
    *,
    # [C, 4, 4] views whose x axes are held level, to find up by; None leaves axes and origin
    level_views: NDArray[np.float64] | None,
    scale_between: ScaleBetween | None,
    metric: bool,  # the mapper's units are metres, as in a data set with measured poses
    sources: Sequence[ScaleSource] = (),  # what else tells the scale, in the order of trust
    given_up: tuple[float, float, float] | None = None,  # unit vector that a data set knows
    pinholes: Mapping[str, Lens] | None = None,  # of undistorted frames, for FRAME:u,v
) -> WorldFrame:
    """Returns the world frame of a model.

    Up and the floor are used where cameras and points agree on them; otherwise the axes stay, and
    the evidence says why. A given up becomes z, and neither heading nor origin change. The scale is
    that of `scale_between`, whose points x,y,z are in the turned frame, as a viewer shows it; the
    origin stays. ConfigError if a place is unknown.
    """
    names = sorted(viewmats)
    matrices = np.array([viewmats[name] for name in names]).reshape(-1, 4, 4)
    up = (find_gravity(points, level_views) if level_views is not None and given_up is None
          else Gravity(None, None, None, "it was not looked for"))
    turn, axis, strength = Similarity(), "mapper", None
    if level_views is not None and given_up is not None:
        given = np.array(given_up)
        up = Gravity(given, None, None)
        turn, axis = Similarity(rotation=turn_onto(given, np.array([0.0, 0.0, 1.0]))), "data set"
    elif up.up is not None:
        axes = upright_axes(up, points, matrices)
        turn, strength = axes.similarity, axes.walls.strength
        axis = "walls" if axes.walls.found else "cameras"
    measured = None
    if scale_between:
        moved = {name: turn.viewmat(viewmats[name]) for name in names}
        measured = measure(scale_between, turn.points(points), moved, pinholes or {})
    known = sources or ([ScaleSource(GIVEN, 1.0, GIVEN_ERROR)] if metric else [])
    fused = (fuse_measured(measured.scale, measured.error, known) if measured
             else fuse(known) if known else None)
    source = _name_source(fused)
    evidence = _evidence(up, axis, strength, source, fused)
    return WorldFrame(
        Similarity(scale=fused.scale or 1.0 if fused else 1.0).after(turn), evidence, measured,
        (*_describe_up(evidence, level_views is not None),
         *_describe_scale(source, measured, fused)))


def refuse_contradiction(evidence: WorldEvidence, *, accepted: bool) -> None:
    """Raises SfmError if sources of the scale contradict each other and none can be chosen."""
    if evidence.metres or not evidence.scale_sources or accepted:
        return
    told = describe_sources([ScaleSource.from_json(one) for one in evidence.scale_sources])
    raise SfmError(
        f"What tells the scale contradicts itself, so that no length would be right: {told}.",
        hint="Name a length that you measured with --scale-between A B METRES; or type "
        f"{name_command('sfm --accept-weak')} for a scene in an arbitrary scale.")


def _name_source(fused: FusedScale | None) -> str:
    """Returns where the scale comes from."""
    if fused is None or fused.scale is None:
        return ARBITRARY
    names = [source.name for source in fused.used]
    return MEASURED if names == [MEASURED_BETWEEN] else DATA_SET if names == [GIVEN] else FUSED


def _evidence(
    gravity: Gravity, axis: str, strength: float | None, source: str, fused: FusedScale | None
) -> WorldEvidence:
    cameras, floor = gravity.cameras, gravity.floor
    tilt = None
    if cameras is not None and floor is not None:
        tilt = float(np.degrees(np.arccos(np.clip(cameras.up @ floor.up, -1, 1))))
    return WorldEvidence(
        up_found=gravity.up is not None, up_reason=gravity.reason,
        camera_roll_deg=None if cameras is None else cameras.roll_deg,
        camera_spread_deg=None if cameras is None else cameras.spread_deg,
        camera_error_deg=None if cameras is None else cameras.error_deg,
        upright_share=None if cameras is None else cameras.upright,
        floor_found=floor is not None,
        floor_share=None if floor is None else floor.share,
        floor_contrast=None if floor is None else floor.contrast,
        floor_tilt_deg=tilt, axis=axis, wall_strength=strength,
        scale_source=source, metres=source != ARBITRARY,
        scale_error=fused.error if fused and fused.scale else None,
        scale_sources=tuple(source.to_json() for source in (
            *fused.used, *fused.contradicting)) if fused else ())


def _describe_up(evidence: WorldEvidence, asked: bool) -> tuple[str, ...]:
    if not asked:
        return ()
    if evidence.axis == "data set":
        return ("z is up, as in the data set.",)
    if not evidence.up_found:
        return (f"Up is unknown, so the axes stay as they are: {evidence.up_reason}.",)
    if evidence.floor_found:
        return (
            f"z is up and the floor lies at 0: {evidence.floor_share:.0%} of the points lie in it, "
            f"{evidence.floor_tilt_deg:.1f} degrees off the horizon of the cameras.",)
    return (
        "z is up by the horizon of the cameras, to about "
        f"{evidence.camera_error_deg:.1f} degrees; no floor is seen, so 0 is their mean height.",)


def _describe_scale(
    source: str, measured: Measurement | None, fused: FusedScale | None
) -> tuple[str, ...]:
    if fused is None:
        return ("The scale is arbitrary; --scale-between A B METRES makes one unit a metre.",)
    if source == DATA_SET:
        return ("One unit is one metre, as in the data set.",)
    if source != MEASURED or measured is None:
        return fused.describe()
    request = measured.request
    return (f"One unit is one metre, to {fused.interval:.1%}: {request.a} and {request.b} are "
            f"{request.metres:g} m apart.", *fused.describe_contradicting())
