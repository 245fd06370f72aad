"""From the mapper's frame to the world: which way is up, where the floor is, how long a metre is.

A mapper's frame is that of its first pair of images, in an arbitrary scale. `world_transform`
combines what cameras, points and the user say about the world into one similarity, with its
evidence; `place_model` applies it to a COLMAP model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from recon_cli.io.colmap import Pinhole
from recon_cli.io.records import read_poses
from recon_cli.scene.gravity import Gravity, find_gravity, upright_axes
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.job import MappingJob, Result, fresh_folder, publish
from recon_cli.sfm.measure import Measurement, ScaleBetween, measure
from recon_cli.workspace import atomic
from recon_cli.workspace.summaries import WorldEvidence, WorldSummary

ARBITRARY, DATA_SET, MEASURED = "arbitrary", "data set", "measured"  # where the scale comes from


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """The world frame; see `WorldSummary`.

    Attributes:
        measurement: what gave the scale, in the world before it was scaled; None without one.
    """

    similarity: Similarity
    evidence: WorldEvidence
    measurement: Measurement | None
    sentences: tuple[str, ...]

    def summary(self) -> WorldSummary:
        """Returns the record for world.json and the summary of the stage."""
        return WorldSummary(
            similarity=self.similarity.to_json(), evidence=self.evidence,
            measurement=self.measurement.to_json() if self.measurement else None,
            sentences=self.sentences)


def place_model(job: MappingJob) -> Result:
    """Writes the mapper's model, moved into the world frame, into out/sparse.

    The axes of a data set with poses are left as they are: others build on them.

    Returns:
        A `WorldSummary` as JSON values.

    Raises:
        ConfigError: a place of --scale-between is unknown.
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
    move_model(model, world.similarity)
    folder = fresh_folder(job.out / "sparse.partial")
    model.write(folder)
    publish(folder, job.out / "sparse")
    summary = world.summary().to_json()
    atomic.write_json(job.out / WorldSummary.FILE, summary)
    return summary


def move_model(model: pycolmap.Reconstruction, similarity: Similarity) -> None:
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


def world_transform(
    points: NDArray[np.float64],
    viewmats: Mapping[str, NDArray[np.float64]],
    *,
    gravity: bool,
    scale_between: ScaleBetween | None,
    metric: bool,
    pinholes: Mapping[str, Pinhole] | None = None,
) -> WorldFrame:
    """Returns the world frame of a model.

    Up and the floor are used where cameras and points agree on them; otherwise the axes stay, and
    the evidence says why. The scale is that of `scale_between`, whose points x,y,z are in the
    turned frame, as a viewer shows it. The origin stays where it is when the scale changes.

    Args:
        points: [P, 3] sparse points in the mapper's frame.
        viewmats: [4, 4] world to camera of each frame, by name.
        gravity: find up; False leaves the axes and the origin.
        scale_between: two places and their distance.
        metric: the mapper's units are metres, as in a data set with measured poses.
        pinholes: undistorted camera of each frame, by name; needed for FRAME:u,v.

    Raises:
        ConfigError: a place of `scale_between` is unknown.
    """
    names = sorted(viewmats)
    up, turn, axis, strength = _upright_frame(
        points, np.array([viewmats[name] for name in names]).reshape(-1, 4, 4), gravity)
    measured = None
    if scale_between:
        moved = {name: turn.viewmat(viewmats[name]) for name in names}
        measured = measure(scale_between, turn.points(points), moved, pinholes or {})
    source = MEASURED if measured else DATA_SET if metric else ARBITRARY
    evidence = _evidence(up, axis, strength, source)
    scale = Similarity(scale=measured.scale) if measured else Similarity()
    return WorldFrame(
        scale.after(turn), evidence, measured,
        (*_describe_up(evidence, gravity), _describe_scale(source, measured, metric)))


def _upright_frame(
    points: NDArray[np.float64], viewmats: NDArray[np.float64], gravity: bool
) -> tuple[Gravity, Similarity, str, float | None]:
    """Returns what is known of up, the frame that follows, and the source of its x axis."""
    if not gravity:
        return Gravity(None, None, None, "it was not looked for"), Similarity(), "mapper", None
    gravity_found = find_gravity(points, viewmats)
    if gravity_found.up is None:
        return gravity_found, Similarity(), "mapper", None
    axes = upright_axes(gravity_found, points, viewmats)
    axis = "walls" if axes.walls.found else "cameras"
    return gravity_found, axes.similarity, axis, axes.walls.strength


def _evidence(gravity: Gravity, axis: str, strength: float | None, source: str) -> WorldEvidence:
    cameras, floor = gravity.cameras, gravity.floor
    tilt = None
    if cameras is not None and floor is not None:
        tilt = float(np.degrees(np.arccos(np.clip(cameras.up @ floor.up, -1, 1))))
    return WorldEvidence(
        up_found=gravity.up is not None,
        up_reason=gravity.reason,
        camera_roll_deg=None if cameras is None else cameras.roll_deg,
        camera_spread_deg=None if cameras is None else cameras.spread_deg,
        camera_error_deg=None if cameras is None else cameras.error_deg,
        upright_share=None if cameras is None else cameras.upright,
        floor_found=floor is not None,
        floor_share=None if floor is None else floor.share,
        floor_contrast=None if floor is None else floor.contrast,
        floor_tilt_deg=tilt,
        axis=axis,
        wall_strength=strength,
        scale_source=source,
        metres=source != ARBITRARY,
    )


def _describe_up(evidence: WorldEvidence, asked: bool) -> tuple[str, ...]:
    if not asked:
        return ()
    if not evidence.up_found:
        return (f"Up is unknown, so the axes stay as they are: {evidence.up_reason}.",)
    if evidence.floor_found:
        return (
            f"z is up and the floor lies at 0: {evidence.floor_share:.0%} of the points lie in it, "
            f"{evidence.floor_tilt_deg:.1f} degrees off the horizon of the cameras.",)
    return (
        "z is up by the horizon of the cameras, to about "
        f"{evidence.camera_error_deg:.1f} degrees; no floor is seen, so 0 is their mean height.",)


def _describe_scale(source: str, measured: Measurement | None, metric: bool) -> str:
    if source == ARBITRARY:
        return "The scale is arbitrary; --scale-between A B METRES makes one unit a metre."
    if measured is None:
        return "One unit is one metre, as in the data set."
    request = measured.request
    sentence = f"One unit is one metre: {request.a} and {request.b} are {request.metres:g} m apart"
    return f"{sentence}, {1 / measured.scale:.4g} times as long in the data set." if metric else (
        f"{sentence}.")
