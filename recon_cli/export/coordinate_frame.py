"""The frame in which a scene is handed out: measured, moved or turned as options say."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recon_cli.config.stages import ExportConfig
from recon_cli.context import StageInputs
from recon_cli.errors import ConfigError
from recon_cli.export.synthetic_cameras import has_views
from recon_cli.io.colmap import read_images, read_pinholes, read_points
from recon_cli.io.import_record import Origin
from recon_cli.scene.gravity import camera_up, turn_onto
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.measure import Measurement, ScaleBetween, measure
from recon_cli.workspace.summaries import WorldSummary

_UP = {"z": (0.0, 0.0, 1.0), "y": (0.0, 1.0, 0.0), "-y": (0.0, -1.0, 0.0)}

logger = logging.getLogger("recon")


@dataclass(frozen=True, eq=False)
class Frame:
    """The frame of the files.

    Attributes:
        similarity: from the world of the training to it.
        up: [3] unit vector in it; where up was not found, the mean up of the cameras.
        measured: what gave the scale; None where nothing was measured.
    """

    similarity: Similarity
    up: NDArray[np.float64]
    measured: Measurement | None


def frame_of(config: ExportConfig, inputs: StageInputs) -> Frame:
    """Returns the frame that the options ask for.

    Raises:
        ConfigError: --scale-between names no place, or --transform no similarity.
    """
    measured = _measured(config, inputs)
    similarity = Similarity(scale=measured.scale) if measured else Similarity()
    up = _up(inputs, asked=config.up is not None)
    if config.up is not None:
        similarity = Similarity(rotation=turn_onto(up, np.array(_UP[config.up]))).after(similarity)
    if config.transform is not None:
        similarity = _given(config.transform).after(similarity)
    return Frame(similarity, similarity.rotation @ up, measured)


def _given(values: tuple[float, ...]) -> Similarity:
    try:
        return Similarity.from_matrix(np.array(values).reshape(4, 4))
    except ValueError as error:
        raise ConfigError(
            f"The matrix of --transform cannot be used: {error}.",
            hint="It has to be a rotation times one scale above 0, and a shift in its last "
            "column.") from error


def _measured(config: ExportConfig, inputs: StageInputs) -> Measurement | None:
    """Returns how long a metre is in the scene that was trained, where the user says so."""
    if config.scale_between is None:
        return None
    sparse = inputs.folders["sfm"] / "undistorted" / "sparse"
    points, _ = read_points(sparse / "points3D.bin")
    viewmats = {name: viewmat for name, _, viewmat in read_images(sparse / "images.bin")}
    return measure(ScaleBetween(*config.scale_between), points, viewmats, read_pinholes(sparse))


def _up(inputs: StageInputs, *, asked: bool) -> NDArray[np.float64]:
    """Returns up in the world of the training; with a warning where it counts and is a guess."""
    origin = Origin.of(inputs.folders["train"])
    if origin and not has_views(inputs):
        return np.array(_UP["z" if origin.z_up else "-y"])
    world = WorldSummary.read(inputs.folders["sfm"])
    if world and world.evidence.up_found:
        return np.array(_UP["z"])
    sparse = inputs.folders["sfm"] / "undistorted" / "sparse"
    viewmats = np.stack([viewmat for _, _, viewmat in read_images(sparse / "images.bin")])
    if asked:
        logger.warning("up was not found, so --up goes by the mean up of the cameras")
    return camera_up(viewmats).up
