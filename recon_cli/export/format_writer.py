"""Writing of the exported scene in the formats of the table, and the check of each file."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np

from recon_cli.config.export import ExportConfig
from recon_cli.errors import ConfigError, ReconstructionError
from recon_cli.export.camera_files import write_cameras
from recon_cli.export.reduce import ReducedScene, lower_degrees
from recon_cli.export.source import ExportSource
from recon_cli.export.verify import file_size, measure_size, write_until_good
from recon_cli.io.mesh_data import Mesh, joined
from recon_cli.room.files import write_mesh_file, write_plan
from recon_cli.room.measures import RoomFrame
from recon_cli.room.mesh import MeshResult, build_mesh
from recon_cli.room.texture import MOST_PIXELS, add_texture
from recon_cli.scene.splats import Splats
from recon_cli.splats.format import WriteSettings
from recon_cli.splats.ply import write_points
from recon_cli.workspace.export_formats import EXPORT_FORMATS, ExportFormat, LossLimit
from recon_cli.workspace.summaries import ExportedFile

logger = logging.getLogger("recon")


def measure_first(splats: Splats, config: ExportConfig, source: ExportSource) -> int:
    """Returns the bytes that a scene takes in the first format that is asked for.

    ConfigError if the format does not hold Gaussians.
    """
    row = EXPORT_FORMATS[config.formats[0]]
    if row.kind != "gaussians":
        raise ConfigError(
            f"--max-mb limits the first format, but {row.name} does not hold Gaussians.",
            hint="Name ply, spz or another one of Gaussians first in --format.")
    return measure_size(row, splats, _settings(row, config, source))


def _settings(row: ExportFormat, config: ExportConfig, source: ExportSource) -> WriteSettings:
    return dataclasses.replace(source.settings, options={
        name: getattr(config, name) for name in row.options})


class FormatWriter:
    """Writes a scene, whose .ply exists already, in one format after the other."""

    def __init__(
        self, reduce: Callable[[], ReducedScene], config: ExportConfig, source: ExportSource,
        room_frame: RoomFrame | None,
    ) -> None:
        self._reduce, self._config = reduce, config
        self._source, self._room_frame = source, room_frame
        self._known_db: dict[bool, float] = {}  # of the bounded scene and the other one

    def write(self, row: ExportFormat, out: Path, ply: Path) -> ExportedFile:
        """Writes one format into `out`; ReconstructionError if it loses more than it may."""
        match row.kind:
            case "gaussians":
                return self._write_gaussians(row, out, ply)
            case "points":
                trained = self._scene.trained
                inside = trained.within(*self._source.room)
                write_points(out / row.file, trained.select(inside))
            case "cameras":
                write_cameras(out, row, self._source)
            case "mesh":
                return self._write_mesh(row, out)
            case "plan":
                assert self._room_frame is not None
                centers = [camera.center for _, camera in self._source.place(
                    self._source.scene.train)]
                write_plan(out, self._mesh, np.stack(centers), self._room_frame)
        path = out / row.file
        return ExportedFile(file=row.file, bytes=path.stat().st_size if path.is_file() else None)

    @cached_property
    def _scene(self) -> ReducedScene:
        return self._reduce()

    def _write_gaussians(self, row: ExportFormat, out: Path, ply: Path) -> ExportedFile:
        path, scene = out / row.file, self._scene
        splats = scene.bounded if row.bounded else scene.trained
        before = self._psnr_db(splats, bounded=row.bounded)
        limit = LossLimit.from_option(row, self._config.max_loss)
        limited = self._config.max_mb is not None and row.name == self._config.formats[0]
        gain = write_until_good(
            row, path, lower_degrees(splats, self._source).at(row.sh_degree),
            _settings(row, self._config, self._source), self._source.psnr,
            reference_db=before, limit=limit,
            max_bytes=int(1e6 * (self._config.max_mb or 0)) if limited else None)
        size, ply_size = file_size(row, path), ply.stat().st_size
        text = f"{row.name}: {ply_size / size:.1f}x smaller, {gain:+.2f} dB"
        if not limit.allows(gain, before + gain):
            raise ReconstructionError(
                f"{text} on {self._source.psnr.describe()}, but it may lose {limit.most_db:g} dB "
                "at most.",
                hint="Leave this format out, or allow more with --max-loss.")
        logger.info("%s", text)
        return ExportedFile(
            file=row.file, bytes=size, smaller=round(ply_size / size, 3),
            psnr_change_db=round(gain, 4), psnr_db=round(before + gain, 4))

    def _write_mesh(self, row: ExportFormat, out: Path) -> ExportedFile:
        mesh = self._textured if "texture" in row.options and self._config.texture else (
            self._surface)
        path = write_mesh_file(out / row.file, mesh, self._source.frame.up,
                               tint=self._config.inferred == "tint")
        share = (mesh.area(mesh.inferred_faces) / max(mesh.area(), 1e-30)
                 if mesh.inferred is not None else None)
        text = self._mesh.describe()
        logger.info("%s: %s", row.file, text if not share else
                    f"{text}; {share:.1%} of the area is inferred from planes")
        return ExportedFile(file=row.file, bytes=path.stat().st_size, inferred_share=share)

    def _psnr_db(self, splats: Splats, *, bounded: bool) -> float:
        """Returns the PSNR of one of both scenes, which that of its files is compared with."""
        if bounded not in self._known_db:
            self._known_db[bounded] = self._source.psnr.psnr_db(splats)
        return self._known_db[bounded]

    @cached_property
    def _mesh(self) -> MeshResult:
        """The mesh of all formats that have it, measured if there is a plan."""
        source, measured = self._source, self._room_frame is not None
        return build_mesh(
            self._scene.trained.map(lambda tensor: tensor.to(source.ctx.device)),
            source.load_training_with_depth(), source.points if measured else None, source.ctx,
            max_triangles=self._config.max_triangles, voxel=self._config.voxel,
            infer=self._config.inferred != "off")

    @cached_property
    def _surface(self) -> Mesh:
        """The mesh with what is inferred, if that is asked for."""
        result = self._mesh
        return result.mesh if result.inferred is None else joined(result.mesh, result.inferred)

    @cached_property
    def _textured(self) -> Mesh:
        """The same with a texture."""
        return add_texture(
            self._surface, self._source.load_photos(MOST_PIXELS), self._config.texture,
            self._config.texture_format, self._source.ctx.progress)
