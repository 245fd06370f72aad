"""The coordinate frame of an export: that of the training, measured, moved or turned by options."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.export import ExportConfig
from recon_cli.errors import ConfigError, StageError
from recon_cli.io.colmap import read_pinholes
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.room.measures import RoomFrame
from recon_cli.room.scale import (
    ARBITRARY,
    DATA_SET,
    MEASURED,
    PICKED_ERROR,
    Measurement,
    ScaleBetween,
    measure,
)
from recon_cli.room.scale_fusion import (
    GIVEN,
    GIVEN_ERROR,
    MEASURED_BETWEEN,
    FusedScale,
    ScaleSource,
    fuse_measured,
)
from recon_cli.scene.gravity import camera_up, find_gravity, turn_onto
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.statistics import ROUNDING
from recon_cli.splats.axes import UP
from recon_cli.workspace.export_formats import PLAN
from recon_cli.workspace.summaries import WorldSummary

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class ExportFrame:
    """The coordinate frame of the exported files."""

    similarity: Similarity  # from the world of the training to this frame
    up: NDArray[np.float64]  # [3] unit vector in it; the mean up of the cameras if up was not found
    measurement: Measurement | None  # of the user; None if nothing was measured
    fused: FusedScale | None = None  # the scale by it and by all that sfm knew; None without it


def choose_frame(
    config: ExportConfig, capture: PlacedCapture | None, imported_up: NDArray[np.float64] | None
) -> ExportFrame:
    """Returns the coordinate frame that the options select.

    Without a `capture`, up [3] is that of the imported scene. ConfigError if --scale-between does
    not name a place, or --transform is not a similarity.
    """
    measurement, fused, similarity = None, None, Similarity()
    if capture is not None and config.scale_between is not None:
        measurement = _measure_scale(config.scale_between, capture)
        fused = fuse_measured(
            measurement.scale, measurement.error, _known_sources(capture.world))
        assert fused.scale is not None  # what the user measured decides
        similarity = Similarity(scale=fused.scale)
    up = imported_up if capture is None else _find_up(capture, warn=config.up is not None)
    assert up is not None, "trained without views"
    if config.up is not None:
        similarity = Similarity(rotation=turn_onto(up, np.array(UP[config.up]))).after(similarity)
    if config.transform is not None:
        try:
            transform = Similarity.from_matrix(np.array(config.transform).reshape(4, 4))
        except ValueError as error:
            raise ConfigError(
                f"The matrix of --transform cannot be used: {error}.",
                hint="It must be a rotation times one scale above 0, with a translation in its "
                "last column.") from error
        similarity = transform.after(similarity)
    return ExportFrame(similarity, similarity.rotation @ up, measurement, fused)


def find_room_frame(capture: PlacedCapture, frame: ExportFrame) -> RoomFrame:
    """Returns the frame for measures; StageError if scale or up is unknown: none is guessed."""
    world = capture.world
    source = world.evidence.scale_source if world else ARBITRARY
    if frame.fused is None and source == ARBITRARY:
        raise StageError(
            f"{PLAN} cannot be measured: the scale is arbitrary.",
            hint="Give one known length with --scale-between A B METRES.")
    scale = frame.similarity.scale / ((frame.fused and frame.fused.scale) or 1.0)
    if abs(scale - 1) > ROUNDING:
        raise StageError(
            f"{PLAN} cannot be measured: --transform changes the scale, so units are no longer "
            "metres.",
            hint="Leave out the scale of --transform.")
    error = frame.fused.error if frame.fused else max(
        (one.error for one in _known_sources(world)), default=0.0)
    if frame.fused is None and world and world.evidence.scale_error is not None:
        error = world.evidence.scale_error
    if world and world.evidence.scale_spread:  # where a length is, is not known
        error = float(np.hypot(error, world.evidence.scale_spread))
    if capture.z_up:
        return RoomFrame(frame.similarity.rotation @ np.array(UP["z"]), error)
    gravity = find_gravity(capture.points, np.stack(list(capture.viewmats.values())))
    if gravity.up is None:
        raise StageError(
            f"{PLAN} cannot be measured: it is not known where up is, as {gravity.reason}.",
            hint="Film some of the floor, level; or measure on the mesh.")
    return RoomFrame(frame.similarity.rotation @ gravity.up, error)


def _measure_scale(between: tuple[str, str, float], capture: PlacedCapture) -> Measurement:
    a, b = capture.frames.find(between[:2])
    return measure(ScaleBetween(a, b, between[2]), capture.points, capture.viewmats,
                   read_pinholes(capture.sparse))


def _known_sources(world: WorldSummary | None) -> list[ScaleSource]:
    """Returns what sfm knew of the scale, in metres of a unit of its world, and what it used."""
    if world is None:
        return []
    unit = Similarity.from_json(world.similarity).scale
    known = [ScaleSource.from_json(one) for one in world.evidence.scale_sources]
    if known:
        return [ScaleSource(
            "--scale-between of recon sfm" if one.name == MEASURED_BETWEEN else one.name,
            one.scale / unit, one.error) for one in known]
    # of older versions, which recorded several sources only
    old = {MEASURED: ("--scale-between of recon sfm", PICKED_ERROR), DATA_SET: (GIVEN, GIVEN_ERROR)}
    name = old.get(world.evidence.scale_source)
    return [ScaleSource(name[0], 1.0, name[1])] if name else []


def _find_up(capture: PlacedCapture, *, warn: bool) -> NDArray[np.float64]:
    """Returns up in the world of the training; `warn` says whether a guess is worth a warning."""
    if capture.z_up:
        return np.array(UP["z"])
    if warn:
        logger.warning("up was not found, so --up uses the mean up of the cameras")
    return camera_up(np.stack(list(capture.viewmats.values()))).up
