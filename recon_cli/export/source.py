"""The views and points behind an export, in the world of its files, loaded once needed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from recon_cli.context import StageContext
from recon_cli.export.bounds import SIZE, VIEWS, Room, bound_scene
from recon_cli.export.coordinate_frame import ExportFrame
from recon_cli.export.page import make_guide
from recon_cli.export.synthetic_cameras import SelfPsnr, synthetic_scene
from recon_cli.export.verify import ReferencePsnr, load_reference_psnr
from recon_cli.io.images import fit_camera
from recon_cli.io.sensor_depth import ALL_SAMPLES, read_sensor_depth
from recon_cli.io.training_scene import PlacedCapture
from recon_cli.io.views import ReferenceView, evenly_spread
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View, views_ahead
from recon_cli.scene.splats import Splats, transformed
from recon_cli.scene.train_view import TrainView
from recon_cli.splats.format import Guide, WriteSettings
from recon_cli.train.finished_model import FinishedModel
from recon_cli.train.fit.train_data import load_views
from recon_cli.workspace.records import POSES, read_poses


class ExportSource:
    """The inputs of an export besides the Gaussians.

    A scene that was imported without views has synthetic cameras instead of them, which show
    `splats`, the unreduced scene in the world of the files.
    """

    def __init__(
        self, splats: Callable[[], Splats], trained: FinishedModel, capture: PlacedCapture | None,
        frame: ExportFrame, ctx: StageContext, *, antialiased: bool,
    ) -> None:
        self.frame, self.ctx, self.capture, self.has_views = (
            frame, ctx, capture, capture is not None)
        self._splats, self._trained, self._antialiased = splats, trained, antialiased
        self._similarity = frame.similarity  # from the world of the training to that of the files

    @cached_property
    def scene(self) -> Scene:
        """Views and points in the world of the training."""
        config, record = self._trained.config, self._trained.import_record
        if self.capture is not None:
            return self.capture.load_scene(validation=config.validation)
        assert record is not None, "trained without views"
        imported = transformed(self._splats(), self._similarity.inverse())
        return synthetic_scene(imported, up=record.up(), max_size=config.max_size)

    @cached_property
    def psnr(self) -> ReferencePsnr | SelfPsnr:
        """The measure of all files: on reference views, or against renders of the scene itself."""
        if self.has_views:
            return load_reference_psnr(
                self.scene, self._similarity, self._trained.config.max_size, self.ctx)
        cameras = [camera for _, camera in self.place(self.scene.train)]
        psnr = SelfPsnr.from_renders(self._splats(), cameras, self.ctx)
        self.ctx.notice(f"no views: checked on {psnr.describe()}")
        return psnr

    def load_training(self) -> list[TrainView]:
        """Returns the training views with their images."""
        return [dataclasses.replace(view, camera=self._similarity.camera(view.camera))
                for view in self._load_views()]

    def load_training_with_depth(self) -> list[TrainView]:
        """Returns the training views with their images, and with all sensor depth that fits."""
        sensor = read_sensor_depth(self.scene, most_samples=ALL_SAMPLES)
        if sensor.refused:
            self.ctx.notice(f"sensor depth is not used for the mesh: {sensor.refused}")
        scaled = {name: dataclasses.replace(depth, depths=np.float32(self.scale) * depth.depths)
                  for name, depth in sensor.depths.items()}
        return [dataclasses.replace(
            view, camera=self._similarity.camera(view.camera), depth=scaled.get(view.name))
            for view in self._load_views()]

    def _load_views(self) -> list[ReferenceView]:
        return load_views(self.scene.train, self._trained.config, self.ctx)

    def load_photos(self, most_pixels: int) -> list[TrainView]:
        """Returns the training views as large as they are, or as `most_pixels` in all allow."""
        views = self.scene.train
        pixels = sum(view.camera.width * view.camera.height for view in views)
        longest = max(max(view.camera.width, view.camera.height) for view in views)
        size = max(int(longest * min(1.0, (most_pixels / pixels) ** 0.5)), 16)
        config = dataclasses.replace(self._trained.config, max_size=size)
        return [dataclasses.replace(view, camera=self._similarity.camera(view.camera))
                for view in load_views(views, config, self.ctx)]

    def place(self, views: Sequence[View]) -> list[tuple[str, Camera]]:
        """Returns views by name, with their cameras in the world of the files."""
        return [(view.name, self._similarity.camera(view.camera))
                for view in sorted(views, key=lambda view: view.name)]

    @property
    def points(self) -> NDArray[np.float64]:
        """The points [P, 3]."""
        return self._similarity.points(self.scene.points)

    @property
    def scale(self) -> float:
        """Units of the files in one unit of the training."""
        return self._similarity.scale

    @cached_property
    def in_metres(self) -> bool:
        """Whether the capture came with metres, and the scene of the training is in metres."""
        if self.capture is None or self.capture.world is None:
            return False
        poses = self.capture.ingest / POSES
        return (self.capture.world.evidence.metres and poses.exists()
                and read_poses(poses).metric)

    @property
    def known_up(self) -> NDArray[np.float64] | None:
        """Up [3] in the world of the files, None where it is a guess."""
        return self.frame.up if self.capture is not None and self.capture.z_up else None

    def bound(self, splats: Splats) -> Splats:
        """Returns a scene of the files that reaches little farther than the room that views show.
        """
        record = self._trained.import_record
        if not self.has_views or (record and record.doubt):  # its room is not known
            return splats
        cameras = np.stack([camera.center for _, camera in self.place(self.scene.train)])
        views = [fit_camera(self._similarity.camera(view.camera), SIZE)
                 for view in evenly_spread(self.scene.train, VIEWS)]
        return bound_scene(splats, Room.from_points(self.points, cameras), views, self.ctx)

    @property
    def room(self) -> tuple[list[float], float]:
        """Middle [3] and radius of the room, outside which lies only the view from its windows."""
        center = self._similarity.points(self.scene.center)
        return center.tolist(), self._similarity.scale * self.scene.reach

    @cached_property
    def settings(self) -> WriteSettings:
        """Facts that a file can hold, without the options of its format."""
        record = self._trained.import_record
        title = (self.capture.frames.groups[0].name if self.capture is not None else
                 record.file if record is not None else "")
        return WriteSettings(
            up=self.frame.up, antialiased=self._antialiased, title=title,
            views=self.place(views_ahead(self.scene.train)), guide=self._guide)

    def _guide(self, splats: Splats) -> Guide | None:
        if not self.has_views:
            return None
        cameras = [camera for _, camera in self.place(views_ahead(self.scene.train))]
        return make_guide(splats, cameras, self.ctx)
