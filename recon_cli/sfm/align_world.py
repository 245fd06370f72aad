"""From the mapper's frame to the world: which way is up, where the floor is, how long a metre is.

A mapper's frame is that of its first pair of images, in an arbitrary scale. What cameras, points
and the user say about the world is put into one similarity here, with its evidence. It knows no
pycolmap and touches no files: `placing` applies it to a COLMAP model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli.io.colmap import Pinhole
from recon_cli.io.posed import read_poses
from recon_cli.scene.gravity import Gravity, find_gravity, upright_axes
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.job import Job
from recon_cli.sfm.measure import Measurement, ScaleBetween, measure
from recon_cli.sfm.step_log import Result, fresh_folder, publish
from recon_cli.workspace import atomic

WORLD = "world.json"  # the similarity from the mapper's frame, and its evidence


def place_model(job: Job) -> Result:
    """Writes the mapper's model, moved into the world frame, into out/sparse.

    The axes of a data set with poses are left as they are: others build on them.

    Returns:
        What `World` says as JSON values.

    Raises:
        ConfigError: a place of --scale-between cannot be made out.
    """
    model = pycolmap.Reconstruction(job.model)
    images = {model.image(i).name: model.image(i) for i in model.reg_image_ids()}
    world = world_transform(
        np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3),
        {name: _viewmat(image) for name, image in images.items()},
        gravity=job.gravity and not job.known_poses,
        scale_between=ScaleBetween(*job.scale_between) if job.scale_between else None,
        metric=job.known_poses and job.poses is not None and read_poses(job.poses).metric,
        pinholes={name: _pinhole(image.camera) for name, image in images.items()})
    place(model, world.similarity)
    folder = fresh_folder(job.out / "sparse.partial")
    model.write(folder)
    publish(folder, job.out / "sparse")
    atomic.write_json(job.out / WORLD, world.to_json())
    return world.to_json()


def place(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
    """Moves cameras and points of `model`; each observation keeps its reprojection error."""
    model.transform(pycolmap.Sim3d(
        similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation))


def _viewmat(image: pycolmap.Image) -> NDArray[np.float64]:
    viewmat = np.eye(4)
    viewmat[:3] = image.cam_from_world().matrix()
    return viewmat


def _pinhole(camera: pycolmap.Camera) -> Pinhole:
    """Returns the camera of the undistorted image, to whose pixels --scale-between may point."""
    flat = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    return Pinhole(flat.width, flat.height, *flat.params)


ARBITRARY, DATA_SET, MEASURED = "arbitrary", "data set", "measured"  # where the scale comes from


@dataclass(frozen=True)
class Evidence:
    """Why the world is as it is. None stands for what was not looked at or not found.

    Attributes:
        up_found: z is up.
        up_reason: why it is not; empty where it is.
        camera_roll_deg: median angle of the cameras' x axes to the horizontal.
        camera_spread_deg: how far they turn within it, a standard deviation.
        camera_error_deg: standard error of up from the cameras alone.
        upright_share: of the cameras whose image is not upside down.
        floor_found: z is 0 on the floor.
        floor_share: of the points that lie in it.
        floor_contrast: density of points in it over that right above it.
        floor_tilt_deg: between its normal and up as the cameras have it.
        axis: what x goes along: "walls", "cameras" (their mean right) or "mapper".
        wall_strength: how much sharper the points line up along the walls than along a middling
            direction.
        scale_source: "arbitrary", "data set" or "measured".
        metres: one world unit is one metre.
    """

    up_found: bool
    up_reason: str
    camera_roll_deg: float | None
    camera_spread_deg: float | None
    camera_error_deg: float | None
    upright_share: float | None
    floor_found: bool
    floor_share: float | None
    floor_contrast: float | None
    floor_tilt_deg: float | None
    axis: str
    wall_strength: float | None
    scale_source: str
    metres: bool


@dataclass(frozen=True, eq=False)
class World:
    """The world frame.

    Attributes:
        similarity: from the mapper's frame to the world.
        evidence: for it.
        measurement: what gave the scale, in the world before it was scaled; None without one.
        sentences: the same for a terminal.
    """

    similarity: Similarity
    evidence: Evidence
    measurement: Measurement | None
    sentences: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """Returns everything as JSON values."""
        return {
            "similarity": self.similarity.to_json(),
            "evidence": asdict(self.evidence),
            "measurement": self.measurement.to_json() if self.measurement else None,
            "sentences": list(self.sentences),
        }


def world_transform(
    points: NDArray[np.float64],
    viewmats: Mapping[str, NDArray[np.float64]],
    *,
    gravity: bool,
    scale_between: ScaleBetween | None,
    metric: bool,
    pinholes: Mapping[str, Pinhole] | None = None,
) -> World:
    """Returns the world frame of a model.

    Up and the floor are taken where cameras and points agree on them; else the frame is left as it
    is, and the evidence says why. The scale is that of `scale_between`, whose points x,y,z are in
    the turned frame, as a viewer shows it. The origin stays where it is when the scale changes.

    Args:
        points: [P, 3] sparse points in the mapper's frame.
        viewmats: [4, 4] world to camera of each frame, by name.
        gravity: look for up; False leaves the axes and the origin.
        scale_between: two places and their distance.
        metric: the mapper's units are metres already, as in a data set with measured poses.
        pinholes: undistorted camera of each frame, by name; needed for FRAME:u,v.

    Raises:
        ConfigError: a place of `scale_between` cannot be made out.
    """
    names = sorted(viewmats)
    found, turn, axis, strength = _turned(
        points, np.array([viewmats[name] for name in names]).reshape(-1, 4, 4), gravity)
    measured = None
    if scale_between:
        moved = {name: turn.viewmat(viewmats[name]) for name in names}
        measured = measure(scale_between, turn.points(points), moved, pinholes or {})
    source = MEASURED if measured else DATA_SET if metric else ARBITRARY
    evidence = _evidence(found, axis, strength, source)
    scale = Similarity(scale=measured.scale) if measured else Similarity()
    return World(
        scale.after(turn), evidence, measured,
        (*_said_of_up(evidence, gravity), _said_of_scale(source, measured, metric)))


def _turned(
    points: NDArray[np.float64], viewmats: NDArray[np.float64], gravity: bool
) -> tuple[Gravity, Similarity, str, float | None]:
    """Returns what is known of up, the frame that follows, and what gave its x axis how clearly."""
    if not gravity:
        return Gravity(None, None, None, "it was not looked for"), Similarity(), "mapper", None
    found = find_gravity(points, viewmats)
    if found.up is None:
        return found, Similarity(), "mapper", None
    axes = upright_axes(found, points, viewmats)
    axis = "walls" if axes.walls.found else "cameras"
    return found, axes.similarity, axis, axes.walls.strength


def _evidence(found: Gravity, axis: str, strength: float | None, source: str) -> Evidence:
    held, floor = found.cameras, found.floor
    tilt = None
    if held is not None and floor is not None:
        tilt = float(np.degrees(np.arccos(np.clip(held.up @ floor.up, -1, 1))))
    return Evidence(
        up_found=found.up is not None,
        up_reason=found.reason,
        camera_roll_deg=None if held is None else held.roll_deg,
        camera_spread_deg=None if held is None else held.spread_deg,
        camera_error_deg=None if held is None else held.error_deg,
        upright_share=None if held is None else held.upright,
        floor_found=floor is not None,
        floor_share=None if floor is None else floor.share,
        floor_contrast=None if floor is None else floor.contrast,
        floor_tilt_deg=tilt,
        axis=axis,
        wall_strength=strength,
        scale_source=source,
        metres=source != ARBITRARY,
    )


def _said_of_up(evidence: Evidence, asked: bool) -> tuple[str, ...]:
    if not asked:
        return ()
    if not evidence.up_found:
        return (f"Up is not known, so the axes stay as they are: {evidence.up_reason}.",)
    if evidence.floor_found:
        return (
            f"z is up and the floor lies at 0: {evidence.floor_share:.0%} of the points lie in it, "
            f"{evidence.floor_tilt_deg:.1f} degrees off the horizon of the cameras.",)
    return (
        "z is up by the horizon of the cameras, to about "
        f"{evidence.camera_error_deg:.1f} degrees; no floor is seen, so 0 is their mean height.",)


def _said_of_scale(source: str, measured: Measurement | None, metric: bool) -> str:
    if source == ARBITRARY:
        return "The scale is arbitrary; --scale-between A B METRES makes one unit a metre."
    if measured is None:
        return "One unit is one metre, as in the data set."
    request = measured.request
    said = f"One unit is one metre: {request.a} and {request.b} are {request.metres:g} m apart"
    return f"{said}, {1 / measured.scale:.4g} times as long in the data set." if metric else (
        f"{said}.")
