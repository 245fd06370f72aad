"""A scene on its way out: what options take from it, the formats it is written in, their checks."""

from __future__ import annotations

import dataclasses
import logging
import shutil
import tempfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from recon_cli.config.stages import ExportConfig, RunConfig
from recon_cli.context import StageContext, StageInputs, Summary
from recon_cli.errors import ConfigError, ReconstructionError
from recon_cli.evaluation.reference_views import load_scene
from recon_cli.export.cleanup import without_floaters, without_islands
from recon_cli.export.coordinate_frame import Frame
from recon_cli.export.reduce import Change, changed, cropped, of_size
from recon_cli.export.synthetic_cameras import Likeness, has_views, viewless_scene
from recon_cli.export.verify import Fidelity, fidelity
from recon_cli.io.colmap import write_colmap
from recon_cli.io.import_record import Origin
from recon_cli.io.splats.glb import nearest_axes, write_glb
from recon_cli.io.splats.html import write_html
from recon_cli.io.splats.points import write_points
from recon_cli.io.splats.registry import FORMATS
from recon_cli.io.splats.spz import write_spz
from recon_cli.io.transforms_writer import write_transforms
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import Splats, transformed
from recon_cli.scene.train_view import TrainView
from recon_cli.train.importance import Importance, add_views
from recon_cli.train.runner import load_views, read_config
from recon_cli.workspace.atomic import read_json

# dB on the validation views, where --max-loss says nothing; .splat has no harmonics
MOST_LOSS_DB = {"splat": 3.0}
_MOST_LOSS_DB = 0.3
_IMAGES = "images"
_SCORE = "loo"  # by which Gaussians go where a size is asked for; docs/pruning.md

logger = logging.getLogger("recon")


class Hand:
    """Hands a scene out. Views are read only where something has to be shown on them.

    Args:
        config: what is wanted.
        inputs: finished folders.
        out: where files go.
        frame: of the files.
        ctx: backend and device.
    """

    def __init__(
        self, config: ExportConfig, inputs: StageInputs, out: Path, frame: Frame, ctx: StageContext,
    ) -> None:
        self._config, self._inputs, self._out, self._ctx = config, inputs, out, ctx
        self._similarity, self._up = frame.similarity, frame.up
        self._last: tuple[Splats, float] | None = None
        self._whole: Splats | None = None

    def lightened(self, splats: Splats) -> tuple[Splats, list[Change]]:
        """Returns the scene after what options take from it, in their order, and what went.

        Floaters and islands come before --crop: it takes away what views show behind the rest.

        Raises:
            ConfigError: nothing would be left.
        """
        config, changes = self._config, []
        self._whole = splats

        def step(option: str, after: Splats) -> Splats:
            changes.append(changed(option, splats, after, self._psnr_db))
            return after

        if config.drop_floaters:
            splats = step("drop_floaters", without_floaters(
                splats, self._training_views(), self._ctx))
        if config.drop_islands:
            views = self._training_views() if has_views(self._inputs) else None
            splats = step("drop_islands", without_islands(
                splats, self._scene, self._similarity, views, self._ctx))
        if config.crop is not None:
            splats = step("crop", cropped(splats, config.crop))
        if config.sh_degree is not None and config.sh_degree < splats.sh_degree:
            splats = step("sh_degree", splats.with_degree(config.sh_degree))
        if config.max_mb is not None:
            splats = step("max_mb", of_size(
                splats, int(1e6 * config.max_mb), size_of=self._size_of(config.formats[0]),
                score_of=self._score, psnr_db=self._psnr_db))
        return splats, changes

    def out_as(self, name: str, splats: Splats) -> Summary:
        """Writes the scene, whose .ply is there already, in one more format.

        Returns:
            Its file, and of Gaussians its size and what became of the PSNR.

        Raises:
            ReconstructionError: it loses more than it may.
        """
        others: dict[str, Callable[[Splats], Path]] = {
            "points.ply": self._points, "colmap": self._colmap, "transforms.json": self._cameras}
        if name in others:
            return {"file": others[name](splats).name}
        path = self._out / f"splats.{name}"
        self._write(name, path, splats)
        return self._told(name, path, splats, FORMATS[name].read(path))

    def _told(self, name: str, path: Path, splats: Splats, back: Splats) -> Summary:
        """Returns size and loss of a file that was read back, and says them."""
        gain = self._psnr_db(back) - self._before_db(splats)
        size, whole = path.stat().st_size, (self._out / "splats.ply").stat().st_size
        text = f"{name}: {whole / size:.1f}x smaller, {gain:+.2f} dB"
        most = self._config.max_loss
        if most is None:
            most = MOST_LOSS_DB.get(name, _MOST_LOSS_DB)
        if not gain >= -most:  # a NaN fails too
            raise ReconstructionError(
                f"{text} on {self._views.described()}, but it may lose {most:g} dB at most.",
                hint="Leave this format out, or allow more with --max-loss.")
        logger.info("%s", text)
        return {"file": path.name, "bytes": size, "smaller": round(whole / size, 3),
                "psnr_change_db": round(gain, 4)}

    def _write(self, name: str, path: Path, splats: Splats) -> None:
        if name == "glb":
            write_glb(path, splats, axes=nearest_axes(self._up))
        elif name == "spz":
            write_spz(path, splats, version=self._config.spz_version)
        elif name == "html":
            write_html(path, splats, title=self._name, up=self._up, views=self._seen)
        else:
            FORMATS[name].write(path, splats)

    def _size_of(self, name: str) -> Callable[[Splats], int]:
        """Returns the function that tells how large a file of a format would be."""
        if name not in FORMATS:
            raise ConfigError(
                f"--max-mb is about the first format, but {name} holds no Gaussians.",
                hint="Name ply, spz or another one of Gaussians first in --format.")

        def size_of(splats: Splats) -> int:
            with tempfile.TemporaryDirectory(prefix="recon-size-") as folder:
                path = Path(folder) / f"splats.{name}"
                self._write(name, path, splats)
                return path.stat().st_size

        return size_of

    def _psnr_db(self, splats: Splats) -> float:
        """Returns the PSNR of a scene on the views that it is held against."""
        return self._views.psnr_db(splats)

    def _before_db(self, splats: Splats) -> float:
        """Returns the same of the scene that all files are made of, rendered once."""
        if self._last is None or self._last[0] is not splats:
            self._last = splats, self._psnr_db(splats)
        return self._last[1]

    def _score(self, splats: Splats) -> Tensor:
        """Returns how much each Gaussian matters to the training views, [N]."""
        there = splats.map(lambda tensor: tensor.to(self._ctx.device))
        found = Importance.of_score(_SCORE, len(there), there.means.device)
        add_views(found, there, self._training_views(), sh_degree=there.sh_degree,
                  backend=self._ctx.backend)
        return found.score(_SCORE, there, beta=0.0, generator=torch.Generator()).cpu()

    def _training_views(self) -> list[TrainView]:
        """Returns the training views with their cameras in the world of the files."""
        return [dataclasses.replace(view, camera=self._similarity.camera(view.camera))
                for view in load_views(self._scene.train, self._train, self._ctx)]

    def _points(self, splats: Splats) -> Path:
        """Writes the points of the room; those seen through its windows would dwarf it."""
        path, scene, similarity = self._out / "points.ply", self._scene, self._similarity
        center = similarity.points(scene.center)
        write_points(path, splats.select(
            splats.within(center.tolist(), similarity.scale * scene.reach)))
        return path

    def _colmap(self, _: Splats) -> Path:
        path, scene = self._out / "colmap", self._scene
        shutil.rmtree(path, ignore_errors=True)  # of a run that was killed
        write_colmap(
            path, [(view.name, self._similarity.camera(view.camera)) for view in _all(scene)],
            self._similarity.points(scene.points), scene.colors)
        self._images()
        return path

    def _cameras(self, _: Splats) -> Path:
        path, scene = self._out / "transforms.json", self._scene
        write_transforms(
            path, [(f"{_IMAGES}/{view.name}", self._similarity.camera(view.camera))
                   for view in _all(scene)],
            held_out={f"{_IMAGES}/{view.name}" for view in scene.test})
        self._images()
        return path

    def _images(self) -> None:
        """Copies the undistorted images, without which cameras are of no use elsewhere."""
        for view in _all(self._scene):
            target = self._out / _IMAGES / view.name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(view.original, target)

    @cached_property
    def _train(self) -> RunConfig:
        return read_config(self._inputs.folders["train"])

    @cached_property
    def _scene(self) -> Scene:
        if has_views(self._inputs):
            return load_scene(self._inputs, validation=self._train.validation)
        assert self._whole is not None
        there = transformed(self._whole, self._similarity.inverse())
        return viewless_scene(there, self._inputs, self._train.max_size)

    @cached_property
    def _views(self) -> Fidelity | Likeness:
        if has_views(self._inputs):
            return fidelity(self._scene, self._similarity, self._train.max_size, self._ctx)
        assert self._whole is not None
        moved = tuple(
            dataclasses.replace(view, camera=self._similarity.camera(view.camera))
            for view in self._scene.train)
        found = Likeness.of(
            self._whole, dataclasses.replace(self._scene, train=moved), self._ctx)
        self._ctx.notice(f"no views: checked on {found.described()}")
        return found

    @property
    def _name(self) -> str:
        """What was captured: the name of its first video or folder, or of the imported file."""
        origin = Origin.of(self._inputs.folders["train"])
        if origin and not has_views(self._inputs):
            return origin.file
        frames = read_json(self._inputs.folders["ingest"] / "frames.json")
        return str(frames["groups"][0]["name"])

    @property
    def _seen(self) -> list[tuple[str, Camera]]:
        """The cameras that the scene was trained on."""
        return [(view.name, self._similarity.camera(view.camera))
                for view in sorted(self._scene.train, key=lambda view: view.name)]


def _all(scene: Scene) -> list[View]:
    return sorted((*scene.train, *scene.validation, *scene.test), key=lambda view: view.name)
