"""Which camera model a lens has, by points that the adjustment did not see.

Half of the points of a finished model adjust its cameras with another camera model in place of its
own. The other half is then triangulated by those cameras, which stay as they are, and its errors
are compared: a model with too few parameters leaves errors that depend on the place in the image,
one with too many fits noise, and both show in points that were left out.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recon_cli.io.colmap_library import pycolmap
from recon_cli.scene.statistics import LEAST_SAMPLE, MIN_OBSERVATIONS, OUTLIER_SIGMAS
from recon_cli.sfm.limits import MAX_ERROR_PX
from recon_cli.sfm.mapping import mapper
from recon_cli.sfm.model_arrays import registered_images
from recon_cli.workspace.json_record import JsonRecord

# The models that are tried. FULL_OPENCV gained .3% at most over the better of the last two.
MODELS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
# Share of the error that another model must take away to be preferred, beside OUTLIER_SIGMAS of it.
# Of 20 captures by ordinary cameras OPENCV lost .9% at most against any other, but for one
# walk straight ahead, in which RADIAL was 2.5% better.
CLEARLY = 0.05
# From which share on a model cannot be trusted. OPENCV lost 41% on a fisheye of 155 degrees, whose
# cameras were 9 cm off in a room, and 18% on one of 104 degrees, with 1.8 cm. SIMPLE_RADIAL, which
# only those get who ask for it, lost 6% at most in the 20 captures.
WRONG = 0.10
LEAST_PX = 0.02  # that it must take away: features are not found more exactly
LEAST_IMAGES = 5  # that are judged; fewer decide nothing
MOST_IMAGES = 40  # of a camera; they show a lens as well as all
_GRID = 15  # pixels a side, by which a camera is put into another model
_EVALUATIONS = 60  # of that fit

Errors = Mapping[int, NDArray[np.float64]]  # mean squares of the images of each camera, [F]


@dataclass(frozen=True)
class BetterLens(JsonRecord):
    """A camera whose errors another camera model takes away."""

    camera: int
    model: str  # COLMAP's name, as it was mapped
    better: str  # the model of the least error
    error_px: float  # of points that were left out, root mean square
    better_px: float
    gain: float  # share of the error that the better model takes away
    noise: float  # standard error of that

    @property
    def is_wrong(self) -> bool:
        """Whether the model is so far off that cameras cannot be trusted."""
        return self.gain > WRONG

    def describe(self) -> str:
        """Returns what the errors show, as a part of a sentence."""
        return (
            f"the lens model {self.model} does not fit camera {self.camera}: points that were left "
            f"out of its adjustment are off by {self.error_px:.2f} pixels, and by "
            f"{self.better_px:.2f} with {self.better}")

    def sentence(self) -> str:
        """Returns what is wrong, and what to type."""
        text = self.describe()
        return f"{text[:1].upper()}{text[1:]}: --camera-model {self.better} uses that."


def find_better_lenses(
    model: pycolmap.Reconstruction, cameras: Collection[int]
) -> tuple[BetterLens, ...]:
    """Returns which of some cameras of a finished model have another lens than it says."""
    part = _middle(model)
    own = {number: part.camera(number) for number in sorted(cameras)
           if number in part.cameras}
    if not own or len(_left_out(part)) < LEAST_SAMPLE:
        return ()
    names = dict.fromkeys([*(camera.model_name for camera in own.values()), *MODELS])
    errors = {name: try_lens(part, own, name) for name in names}
    found = []
    for number, camera in own.items():
        ours = errors[camera.model_name].get(number, np.zeros(0))
        if len(ours) < LEAST_IMAGES:
            continue
        better = min(names, key=lambda name: float(errors[name][number].mean()))
        gain, noise = gain_over(errors[better][number], ours)
        error, less = root(ours), root(errors[better][number])
        if gain > max(CLEARLY, OUTLIER_SIGMAS * noise) and error - less > LEAST_PX:
            found.append(BetterLens(number, camera.model_name, better, error, less, gain, noise))
    return tuple(found)


def try_lens(model: pycolmap.Reconstruction, cameras: Collection[int], name: str) -> Errors:
    """Returns the mean squared errors of the images of some cameras, if they are of a model."""
    held = _left_out(model)
    return _judge(model, held, _fit(model, held, cameras, name), cameras)


def gain_over(
    ours: NDArray[np.float64], theirs: NDArray[np.float64]  # [F] mean squares
) -> tuple[float, float]:
    """Returns the share of an error that another model takes away, and its standard error.

    Images are what is drawn: the errors of one image depend on each other.
    """
    mean = max(float(theirs.mean()), 1e-12)
    ratio = max(float(ours.mean()) / mean, 1e-12)
    spread = float(np.std(ours - ratio * theirs)) / mean / np.sqrt(max(1, len(ours) - 1))
    return 1 - float(np.sqrt(ratio)), float(spread / (2 * np.sqrt(ratio)))


def root(squares: NDArray[np.float64]) -> float:
    """Returns the root mean square of mean squares [F]."""
    return float(np.sqrt(squares.mean()))


def convert(camera: pycolmap.Camera, name: str) -> pycolmap.Camera:
    """Returns the camera of a model that is nearest to another one, on a grid of pixels."""
    if camera.model_name == name:
        return camera
    shares = np.linspace(0.02, 0.98, _GRID)
    across, down = np.meshgrid(shares * camera.width, shares * camera.height)
    pixels = np.stack([across.ravel(), down.ravel()], axis=1)
    rays = np.column_stack([camera.cam_from_img(pixels), np.ones(len(pixels))])
    found = pycolmap.Camera.create_from_model_name(
        camera.camera_id, name, camera.mean_focal_length(), camera.width, camera.height)

    def misses(params: NDArray[np.float64]) -> NDArray[np.float64]:
        found.params = params
        off = np.asarray(found.img_from_cam(rays) - pixels)
        return np.asarray(np.clip(np.nan_to_num(off, nan=camera.width), -1e4, 1e4).ravel())

    start = np.array(found.params)
    found.params = least_squares(
        misses, start, x_scale=np.maximum(np.abs(start), 0.1), max_nfev=_EVALUATIONS).x
    return found


def _middle(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Returns a model with the images in the middle of each camera's alone, in order of names."""
    images: dict[int, list[pycolmap.Image]] = {}
    every = registered_images(model)
    for image in sorted(every, key=lambda each: each.name):
        images.setdefault(image.camera_id, []).append(image)
    rest = []
    for own in images.values():
        first = max(0, (len(own) - MOST_IMAGES) // 2)
        rest += own[:first] + own[first + MOST_IMAGES:]
    part = pycolmap.Reconstruction(model) if rest else model
    for image in rest:
        part.deregister_frame(image.frame_id)
    return part


def _left_out(model: pycolmap.Reconstruction) -> list[int]:
    """Returns the points that are left out: every second one of those that enough images see."""
    return [number for number, point in sorted(model.points3D.items())
            if point.track.length() >= MIN_OBSERVATIONS][::2]


def _fit(
    model: pycolmap.Reconstruction, held: Collection[int], cameras: Collection[int], name: str
) -> pycolmap.Reconstruction:
    """Returns a model adjusted with another camera model, without the points that are left out."""
    fitted = pycolmap.Reconstruction(model)
    for number in held:
        fitted.delete_point3D(number)
    for number in cameras:
        camera = fitted.camera(number)
        other = convert(camera, name)
        camera.model, camera.params = other.model, other.params
    mapper.adjust(fitted)
    return fitted


def _judge(
    model: pycolmap.Reconstruction, held: Collection[int], fitted: pycolmap.Reconstruction,
    cameras: Collection[int],
) -> dict[int, NDArray[np.float64]]:
    """Returns the mean squared errors of the points that were left out, as `try_lens`."""
    for number in list(fitted.points3D):
        fitted.delete_point3D(number)
    for number in held:
        known = model.point3D(number)
        fitted.add_point3D(known.xyz, known.track, known.color)
    mapper.adjust_points(fitted)
    squares: dict[int, list[float]] = {number: [] for number in cameras}
    for image_id in sorted(fitted.reg_image_ids()):
        image = fitted.image(image_id)
        spots = image.get_observation_points2D()
        if image.camera_id not in squares or not spots:
            continue
        pose = image.cam_from_world().matrix()
        places = np.array([fitted.point3D(spot.point3D_id).xyz for spot in spots])
        pixels = np.asarray(image.camera.img_from_cam(places @ pose[:, :3].T + pose[:, 3]))
        off = np.linalg.norm(pixels - np.array([spot.xy for spot in spots]), axis=1)
        off = np.minimum(np.nan_to_num(off, nan=MAX_ERROR_PX), MAX_ERROR_PX)
        squares[image.camera_id].append(float((off**2).mean()))
    return {number: np.array(each) for number, each in squares.items()}
