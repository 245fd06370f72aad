"""What can be done with an imported scene in a workspace that holds no views, and what cannot."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from recon_cli.config.stages import ExportConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ReconstructionError, StageError
from recon_cli.evaluation.reference_views import render_on_black
from recon_cli.io.import_record import Origin
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats

AROUND = 4  # cameras outside, and as many inside
_BULK = 0.9  # of the opaque Gaussians lie within the radius; far ones behind windows do not count
_OPAQUE = 0.5
_DISTANCE = 2.5  # radii: the bulk and some space around it fill a field of view of 60 degrees
_HEIGHT = 0.6  # radii, of the cameras outside
_INSIDE = 0.6  # radii from the middle, within which the emptiest place is sought
_PLACES = 1000  # that are tried
_VISIBLE = 0.5 / 255  # coverage that changes an 8-bit picture
_FOV_DEG = 60.0
_ASPECT = 1.5
_POINTS = 20_000
# PSNR that a good scene reaches on photos. Against its own renders a scene is perfect, and any
# rounding would cost tens of dB that nobody sees.
ASSUMED_DB = 30.0


def made_up_scene(splats: Splats, *, z_up: bool, max_size: int) -> Scene:
    """Returns a scene whose training views are cameras without pictures; the same every time.

    The first four stand around the bulk of the opaque Gaussians and look at its middle, the other
    four stand where there is most space inside and look outward.

    Args:
        splats: at least one Gaussian.
        z_up: up is z; else it is -y.
        max_size: longest side of the pictures in pixels.
    """
    opaque = splats.opacities >= _OPAQUE
    means = splats.means[opaque if bool(opaque.any()) else ~opaque].double().cpu().numpy()
    middle = np.median(means, axis=0)
    radius = max(float(np.quantile(np.linalg.norm(means - middle, axis=1), _BULK)), 1e-3)
    up = np.array([0.0, 0, 1] if z_up else [0.0, -1, 0])
    one = np.array([1.0, 0, 0])
    two = np.cross(up, one)
    turns = np.pi * (0.25 + np.arange(AROUND) / 2)
    level = [np.cos(turn) * one + np.sin(turn) * two for turn in turns]
    width, height = max_size, max(16, round(max_size / _ASPECT))
    focal = height / 2 / float(np.tan(np.radians(_FOV_DEG) / 2))
    inside = _emptiest(means, middle, _INSIDE * radius)
    viewmats = [
        *(looking_at(middle + radius * (_DISTANCE * way + _HEIGHT * up), middle, up)
          for way in level),
        *(looking_at(inside, inside + radius * way, up) for way in level)]
    views = tuple(
        View(f"made-up-{at}", Camera(
            width, height, focal, focal, width / 2, height / 2, viewmat), Path(), Path())
        for at, viewmat in enumerate(viewmats))
    points = means[:: max(1, len(means) // _POINTS)]
    return Scene(views, (), (), (), points, np.zeros((len(points), 3), np.uint8))


def _emptiest(
    means: NDArray[np.float64], middle: NDArray[np.float64], within: float
) -> NDArray[np.float64]:
    """Returns the place [3] near the middle that is farthest from all Gaussians."""
    draw = np.random.default_rng(0)
    ways = draw.standard_normal((_PLACES, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    places = middle + within * np.cbrt(draw.random((_PLACES, 1))) * ways
    clearance, _ = cKDTree(means).query(places)
    return np.asarray(places[np.argmax(clearance)])


@dataclass(frozen=True, eq=False)
class Likeness:
    """How like itself a scene still is, told in the dB of photos.

    The loss is that of a scene which shows photos at ASSUMED_DB: its error there and the difference
    to the renders from before add up as variances do. Pixels count that something is seen in.

    Attributes:
        views: cameras, what the whole scene shows there, [H, W, 3] in [0, 1], and where, [H, W].
        ctx: backend and device.
    """

    views: tuple[tuple[Camera, NDArray[np.float32], NDArray[np.bool_]], ...]
    ctx: StageContext

    @staticmethod
    def of(splats: Splats, scene: Scene, ctx: StageContext) -> Likeness:
        """Returns the likeness to `splats` as the training cameras of `scene` see them.

        Raises:
            ReconstructionError: none of them sees anything.
        """
        shown = [(view.camera, *_shown(splats, view.camera, ctx)) for view in scene.train]
        views = tuple(view for view in shown if view[2].any())
        if not views:
            raise ReconstructionError(
                f"None of {len(shown)} made-up cameras sees anything of the scene, so no file of "
                "it can be checked.", hint="Look at its bounds in a viewer; it may be damaged.")
        return Likeness(views, ctx)

    def described(self) -> str:
        """Returns what is looked at, as part of a sentence."""
        return (f"{len(self.views)} made-up cameras, against renders of the scene itself, as if it "
                f"showed photos at {ASSUMED_DB:g} dB")

    def psnr_db(self, splats: Splats) -> float:
        """Returns the mean over the cameras in dB, at most ASSUMED_DB."""
        found = []
        for camera, before, seen in self.views:
            image, _ = _shown(splats, camera, self.ctx)
            difference = float(np.mean((image - before)[seen].astype(np.float64) ** 2))
            found.append(-10 * np.log10(10 ** (-ASSUMED_DB / 10) + difference))
        return float(np.mean(found))


def _shown(
    splats: Splats, camera: Camera, ctx: StageContext
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Returns a picture [H, W, 3], and where something is seen in it [H, W]."""
    there = splats.map(lambda tensor: tensor.to(ctx.device))
    shown = render_on_black(there, camera, there.sh_degree, ctx.backend)
    image: NDArray[np.float32] = shown.rgb.clamp(0, 1).cpu().numpy()
    seen: NDArray[np.bool_] = (shown.alpha > _VISIBLE).cpu().numpy()
    return image, seen


HINT = ("Run `recon ingest CAPTURE` and `recon sfm` in this workspace, then `recon import` again.")
_OF_VIEWS = ("colmap", "transforms.json")  # formats that hold cameras and images


def has_views(inputs: StageInputs) -> bool:
    """Tells whether there are views that the scene was made of or held against."""
    origin = Origin.of(inputs.folders["train"])
    return (origin is None or origin.views) and "sfm" in inputs.folders


def viewless_scene(splats: Splats, inputs: StageInputs, max_size: int) -> Scene:
    """Returns made-up cameras for an imported scene, by what is known of its axes."""
    origin = Origin.of(inputs.folders["train"])
    assert origin is not None, "trained without views"
    return made_up_scene(splats, z_up=origin.z_up, max_size=max_size)


def refuse_without_views(config: ExportConfig, inputs: StageInputs) -> None:
    """Raises StageError where an export asks for what only views can tell, and there are none."""
    origin = Origin.of(inputs.folders["train"])
    if origin and origin.doubt and config.drop_floaters:
        raise StageError(
            f"--drop-floaters goes by the views, but {origin.doubt}.",
            hint="Run `recon import` with another --frame, or from a file in the right one.")
    if has_views(inputs):
        return
    asked = [f"--format {name}" for name in config.formats if name in _OF_VIEWS]
    if config.drop_floaters:
        asked.append("--drop-floaters")
    if config.max_mb is not None:  # which Gaussians matter
        asked.append("--max-mb")
    if config.scale_between is not None:  # points and frames
        asked.append("--scale-between")
    if asked:
        raise StageError(
            f"{' and '.join(asked)} cannot be had of a scene that was imported without views.",
            hint=HINT)
