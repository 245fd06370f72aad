"""Writing of the exported scene: reduction by options, the formats, and the check of each file."""

from __future__ import annotations

import dataclasses
import logging
import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from recon_cli.config.stages import MESH_FORMATS, PLAN, ExportConfig, RunConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.datasets.transforms import write_transforms
from recon_cli.errors import ConfigError, ReconstructionError
from recon_cli.export.cleanup import drop_floaters, drop_islands
from recon_cli.export.coordinate_frame import ExportFrame, find_room_frame
from recon_cli.export.page import draw_poster, find_title, plan_tour
from recon_cli.export.reduce import LowerDegrees, crop, fit_to_size, measure_change
from recon_cli.export.synthetic_cameras import SelfPsnr, synthetic_scene
from recon_cli.export.verify import ReferencePsnr, load_reference_psnr
from recon_cli.io.colmap import write_colmap
from recon_cli.io.images import fit_camera
from recon_cli.io.meshes import write_point_cloud
from recon_cli.io.training_scene import load_scene
from recon_cli.io.views import evenly_spread
from recon_cli.room.files import write_mesh_file, write_plan
from recon_cli.room.mesh import MeshResult, build_mesh
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats, transformed
from recon_cli.scene.train_view import TrainView
from recon_cli.splats.axes import PLY, Z_UP
from recon_cli.splats.compressed_ply import write_compressed_ply
from recon_cli.splats.glb import nearest_axes, nearest_up, write_glb
from recon_cli.splats.html import PageStyle, write_html
from recon_cli.splats.lod import LOD_META, make_levels, write_lod
from recon_cli.splats.ply import describe_scene, write_ply, write_points
from recon_cli.splats.registry import FORMATS, scene_file
from recon_cli.splats.sog import SHARING, write_sog
from recon_cli.splats.splat import write_splat
from recon_cli.splats.spz import LARGEST_SCALE, write_spz
from recon_cli.train.finished_model import FINAL
from recon_cli.train.importance import Importance, add_views
from recon_cli.train.train_data import load_views, read_config
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.export_record import ExportChange, ExportedFile, max_loss_db
from recon_cli.workspace.records import ImportRecord, has_views, read_frame_list

# What an .spz says of its axes, by up. Without a name all programs show it as it is, with y up.
_SPZ_AXES = {"z": Z_UP, "-y": PLY, "y": None}
_IMAGES = "images"
_SPARSE = "sparse_pc.ply"  # as nerfstudio calls it
_COLOR_SIZE, _COLOR_VIEWS = 400, 100  # pixels and views, at most, that colours are fitted to
_ROUNDING_VIEWS = 32  # at most, whose mean colour the rounding of a .compressed.ply leaves alone
_SCORE = "loo"  # which Gaussians --max-mb keeps; docs/pruning.md

logger = logging.getLogger("recon")


class Exporter:
    """Reduces a scene and writes it in any format; views are loaded only once they are needed."""

    def __init__(
        self, config: ExportConfig, inputs: StageInputs, out: Path, frame: ExportFrame,
        ctx: StageContext,
    ) -> None:
        self._config, self._inputs, self._out, self._ctx = config, inputs, out, ctx
        self._similarity, self._up, self._frame = frame.similarity, frame.up, frame
        self._last: tuple[Splats, float] | None = None
        self._whole: Splats | None = None
        self._lower: tuple[Splats, LowerDegrees] | None = None
        self._mesh: tuple[Splats, MeshResult] | None = None

    @cached_property
    def _up_axis(self) -> str:
        """The axis that is nearest to up in the files: z, -y or y."""
        return nearest_up(self._up)

    @cached_property
    def _antialiased(self) -> bool:
        """Whether the Gaussians are those of an imported file that says so, not trained here."""
        train = self._inputs.folders["train"]
        record = ImportRecord.read(train)
        pruned = "prune" in self._inputs.folders and self._config.model != "base"
        return bool(record and record.antialiased) and not (pruned or (train / FINAL).exists())

    @property
    def comments(self) -> list[str]:
        """What the header of the .ply says of the scene."""
        return describe_scene(self._up_axis, antialiased=self._antialiased)

    def reduce(self, splats: Splats) -> tuple[Splats, list[ExportChange]]:
        """Returns the scene after the options that remove something, in order, and the changes.

        Floaters and islands come before --crop: it takes away what views show behind the rest.
        ConfigError if nothing would be left.
        """
        config, changes = self._config, []
        self._whole = splats

        def step(option: str, after: Splats) -> Splats:
            changes.append(measure_change(option, splats, after, self._psnr.psnr_db))
            return after

        if config.drop_floaters:
            splats = step("drop_floaters", drop_floaters(
                splats, self._load_training_views(), self._ctx))
        if config.drop_islands:
            views = self._load_training_views() if self._has_views else None
            splats = step("drop_islands", drop_islands(
                splats, self._scene, self._similarity, views, self._ctx))
        if config.drop_backdrop:
            splats = step("drop_backdrop", dataclasses.replace(splats, backdrop=None))
        if config.crop is not None:
            splats = step("crop", crop(splats, config.crop))
        if config.sh_degree is not None and config.sh_degree < splats.sh_degree:
            splats = step("sh_degree", self._at_degree(splats, config.sh_degree))
        if config.max_mb is not None:
            splats = step("max_mb", fit_to_size(
                splats, int(1e6 * config.max_mb), size_of=self._size_of(config.formats[0]),
                score_of=self._score, at_degree=partial(self._at_degree, splats),
                psnr_db=self._psnr.psnr_db))
        return splats, changes

    def write(self, name: str, splats: Splats) -> ExportedFile:
        """Writes the scene, whose .ply exists already, in one more format.

        ReconstructionError if it loses more than it may.
        """
        others: dict[str, Callable[[Splats], Path]] = {
            "points.ply": self._write_points, "colmap": self._write_colmap,
            "transforms.json": self._write_transforms,
            **{mesh: partial(self._write_mesh, mesh) for mesh in MESH_FORMATS}}
        if name in others:
            return ExportedFile(file=others[name](splats).relative_to(self._out).as_posix())
        path = scene_file(self._out, name)
        max_loss = max_loss_db(name, dataclasses.asdict(self._config))
        gain = self._write_format(name, path, splats, max_loss)
        size, whole = _size(path), (self._out / "splats.ply").stat().st_size
        text = f"{name}: {whole / size:.1f}x smaller, {gain:+.2f} dB"
        if not gain >= -max_loss:  # a NaN fails too
            raise ReconstructionError(
                f"{text} on {self._psnr.describe()}, but it may lose {max_loss:g} dB at most.",
                hint="Leave this format out, or allow more with --max-loss.")
        logger.info("%s", text)
        return ExportedFile(
            file=path.relative_to(self._out).as_posix(), bytes=size,
            smaller=round(whole / size, 3), psnr_change_db=round(gain, 4))

    def _write_format(
        self, name: str, path: Path, splats: Splats, max_loss: float
    ) -> float:
        """Writes a file, reads it back, and returns its gain in dB over the scene."""
        def gain() -> float:
            return self._psnr.psnr_db(FORMATS[name].read(path)) - self._psnr_db_before(splats)

        if name not in ("sog", "lod"):
            self._write_file(name, path, splats)
            return gain()
        whole = splats.with_sphere()
        write = partial(
            write_sog, path, whole, antialiased=self._antialiased) if name == "sog" else partial(
            write_lod, path, make_levels(whole))
        limited = self._config.max_mb is not None and name == self._config.formats[0]
        found = -math.inf
        for sharing in SHARING:
            write(sharing=sharing)
            if limited and _size(path) > 1e6 * (self._config.max_mb or 0):
                break
            found = gain()
            if found >= -max_loss:
                break
        return found

    def _write_file(self, name: str, path: Path, splats: Splats) -> None:
        if name == "ply":
            write_ply(path, splats, comments=self.comments)
            return
        whole = splats.with_sphere(LARGEST_SCALE if name in ("spz", "html") else math.inf)
        if name == "glb":
            write_glb(path, whole, axes=nearest_axes(self._up))
        elif name == "spz":
            write_spz(path, whole, version=self._config.spz_version,
                      axes=_SPZ_AXES[self._up_axis], antialiased=self._antialiased)
        elif name == "html":
            self._write_page(path, whole)
        elif name == "splat":
            write_splat(path, self._at_degree(splats, 0).with_sphere())
        elif name == "compressed.ply":
            seen_from = self._place(evenly_spread(self._scene.train, _ROUNDING_VIEWS))
            write_compressed_ply(
                path, whole, centers=np.stack([camera.center for _, camera in seen_from]))
        else:
            FORMATS[name].write(path, whole)

    def _write_page(self, path: Path, splats: Splats) -> None:
        views = self._place(self._scene.train)
        on_device = splats.map(lambda tensor: tensor.to(self._ctx.device))
        tour = plan_tour(on_device, [camera for _, camera in views], self._ctx)
        poster, preview = None, path.with_suffix(".jpg")
        if tour is not None:
            poster = draw_poster(on_device, tour, self._ctx)
            write_bytes(preview, poster)
        write_html(path, splats, up=self._up, views=views, style=PageStyle(
            self._config.title or find_title(self._title), tour, poster,
            preview.name if poster else None, self._config.credits))

    def _size_of(self, name: str) -> Callable[[Splats], int]:
        """Returns the function that measures the size of a file of a format."""
        if name not in FORMATS:
            raise ConfigError(
                f"--max-mb limits the first format, but {name} holds no Gaussians.",
                hint="Name ply, spz or another one of Gaussians first in --format.")

        def size_of(splats: Splats) -> int:
            with tempfile.TemporaryDirectory(prefix="recon-size-") as folder:
                path = scene_file(Path(folder), name)
                self._write_file(name, path, splats)
                return _size(path)

        return size_of

    def _at_degree(self, splats: Splats, degree: int) -> Splats:
        """Returns the scene in a degree, at most its own, as the training views see it."""
        if degree >= splats.sh_degree:
            return splats
        if self._lower is None or self._lower[0] is not splats:
            cameras = [fit_camera(self._similarity.camera(view.camera), _COLOR_SIZE)
                       for view in evenly_spread(self._scene.train, _COLOR_VIEWS)]
            on_device = splats.map(lambda tensor: tensor.to(self._ctx.device))
            self._lower = splats, LowerDegrees(on_device, cameras, backend=self._ctx.backend)
        return self._lower[1].at(degree).map(lambda tensor: tensor.to(splats.means.device))

    def _psnr_db_before(self, splats: Splats) -> float:
        """Returns the PSNR of the scene that all files are made of, rendered once."""
        if self._last is None or self._last[0] is not splats:
            self._last = splats, self._psnr.psnr_db(splats)
        return self._last[1]

    def _score(self, splats: Splats) -> Tensor:
        """Returns how much each Gaussian matters to the training views, [N]."""
        on_device = splats.map(lambda tensor: tensor.to(self._ctx.device))
        importance = Importance.of_score(_SCORE, len(on_device), on_device.means.device)
        add_views(importance, on_device, self._load_training_views(),
                  sh_degree=on_device.sh_degree, backend=self._ctx.backend)
        return importance.score(_SCORE, on_device, beta=0.0, generator=torch.Generator()).cpu()

    def _load_training_views(self) -> list[TrainView]:
        """Returns the training views with their cameras in the world of the files."""
        return [dataclasses.replace(view, camera=self._similarity.camera(view.camera))
                for view in load_views(self._scene.train, self._train, self._ctx)]

    def _write_points(self, splats: Splats) -> Path:
        """Writes the points of the room without those seen through its windows."""
        path, scene, similarity = self._out / "points.ply", self._scene, self._similarity
        center = similarity.points(scene.center)
        write_points(path, splats.select(
            splats.within(center.tolist(), similarity.scale * scene.reach)))
        return path

    def _write_colmap(self, _: Splats) -> Path:
        path, scene = self._out / "sparse" / "0", self._scene
        shutil.rmtree(path, ignore_errors=True)  # of a run that was killed
        write_colmap(path, self._copy_images(), self._similarity.points(scene.points), scene.colors)
        return path

    def _write_transforms(self, _: Splats) -> Path:
        path = self._out / "transforms.json"
        views = [(f"{_IMAGES}/{name}", camera) for name, camera in self._copy_images()]
        scene, points = self._scene, None
        if len(scene.points):
            points = _SPARSE
            write_point_cloud(
                self._out / points, self._similarity.points(scene.points), scene.colors)
        write_transforms(
            path, views, held_out={f"{_IMAGES}/{view.name}" for view in scene.test}, points=points)
        return path

    def _write_mesh(self, name: str, splats: Splats) -> Path:
        """Writes the mesh, made once for all formats, or the plan of its walls."""
        if self._mesh is None or self._mesh[0] is not splats:
            measured = PLAN in self._config.formats
            self._mesh = splats, build_mesh(
                splats.map(lambda tensor: tensor.to(self._ctx.device)),
                self._load_training_views(),
                self._similarity.points(self._scene.points) if measured else None, self._ctx,
                max_triangles=self._config.max_triangles, voxel=self._config.voxel)
        if name == PLAN:
            centers = np.stack([view.camera.center for view in self._scene.train])
            return write_plan(
                self._out, self._mesh[1], self._similarity.points(centers),
                find_room_frame(self._inputs, self._frame))
        return write_mesh_file(self._out / name, self._mesh[1], self._up)

    def _copy_images(self) -> list[tuple[str, Camera]]:
        """Copies the undistorted images, and returns all cameras, which are useless without."""
        scene = self._scene
        views = (*scene.train, *scene.validation, *scene.test)
        for view in views:
            target = self._out / _IMAGES / view.name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(view.original, target)
        return self._place(views)

    def _place(self, views: Sequence[View]) -> list[tuple[str, Camera]]:
        """Returns views by name, with their cameras in the world of the files."""
        return [(view.name, self._similarity.camera(view.camera))
                for view in sorted(views, key=lambda view: view.name)]

    @property
    def _has_views(self) -> bool:
        return has_views(self._inputs.folders)

    @cached_property
    def _train(self) -> RunConfig:
        return read_config(self._inputs.folders["train"])

    @cached_property
    def _scene(self) -> Scene:
        if self._has_views:
            return load_scene(self._inputs.folders, validation=self._train.validation)
        record = ImportRecord.read(self._inputs.folders["train"])
        assert self._whole is not None
        assert record is not None, "trained without views"
        whole = transformed(self._whole, self._similarity.inverse())
        return synthetic_scene(whole, up=record.up(), max_size=self._train.max_size)

    @cached_property
    def _psnr(self) -> ReferencePsnr | SelfPsnr:
        if self._has_views:
            return load_reference_psnr(
                self._scene, self._similarity, self._train.max_size, self._ctx)
        assert self._whole is not None
        moved = tuple(
            dataclasses.replace(view, camera=self._similarity.camera(view.camera))
            for view in self._scene.train)
        self_psnr = SelfPsnr.of(
            self._whole, dataclasses.replace(self._scene, train=moved), self._ctx)
        self._ctx.notice(f"no views: checked on {self_psnr.describe()}")
        return self_psnr

    @property
    def _title(self) -> str:
        """The name of the first video or folder of the capture, or of the imported file."""
        record = ImportRecord.read(self._inputs.folders["train"])
        if record and not self._has_views:
            return record.file
        return read_frame_list(self._inputs.folders["ingest"]).groups[0].name


def _size(path: Path) -> int:
    """Returns the bytes of a scene: of its file, or of all beside a lod-meta.json."""
    if path.name != LOD_META:
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.parent.rglob("*") if file.is_file())
