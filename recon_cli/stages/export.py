"""export: a .ply that other viewers open, read back and compared before it counts as written.

Other formats lie beside it. Each is read back and rendered, and what it loses on the validation
views must stay under a bound. transform.json says how the scene that was trained became the scene
that is handed out.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path

import torch

from recon_cli.atomic import write_json
from recon_cli.config import ExportConfig
from recon_cli.errors import ReconstructionError, StageError, WorkspaceError
from recon_cli.io.colmap import read_images, read_pinholes, read_points
from recon_cli.io.colmap_writer import write_colmap
from recon_cli.io.ply import read_ply, write_ply
from recon_cli.io.splats.glb import Y_DOWN, Z_UP, write_glb
from recon_cli.io.splats.points import write_points
from recon_cli.io.splats.registry import FORMATS
from recon_cli.io.transforms_writer import write_transforms
from recon_cli.mapping.measure import Measurement, ScaleBetween, measure
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats, with_rows
from recon_cli.scene.transformed import transformed
from recon_cli.stages.context import StageContext, StageInputs, Summary
from recon_cli.stages.fidelity import Fidelity, fidelity
from recon_cli.stages.fitting import load_scene, read_config

TRANSFORM = "transform.json"
# dB on the validation views, where --max-loss says nothing; .splat has no harmonics
MOST_LOSS_DB = {"splat": 3.0}
_MOST_LOSS_DB = 0.3

logger = logging.getLogger("recon")


def run(config: ExportConfig, inputs: StageInputs, out: Path, ctx: StageContext) -> Summary:
    """Writes splats.ply, the other formats and transform.json, and returns what they hold."""
    if config.model == "pruned" and "prune" not in inputs.folders:
        raise StageError(
            "The pruned model was asked for, but there is none that is fresh.",
            hint="Run `recon prune` first, or export with --model base.")
    pruned = "prune" in inputs.folders and config.model != "base"
    measured = _measured(config, inputs)
    similarity = Similarity(scale=measured.scale) if measured else Similarity()
    splats = read_ply(inputs.folders["prune" if pruned else "train"] / "splats.ply")
    if not similarity.is_identity:
        splats = transformed(splats, similarity)
    path = out / "splats.ply"
    others = [name for name in config.formats if name != "ply"]
    files: dict[str, Summary] = {}
    with ctx.progress.bar("export", 2 + len(others), unit="file") as bar:
        write_ply(path, splats)
        bar.advance()
        verify(path, splats)
        bar.advance()
        if others:
            hand = _Hand(config, inputs, out, similarity, splats, ctx)
            for name in others:
                files[name] = hand.out_as(name)
                bar.advance()
    _write_transform(out / TRANSFORM, similarity, measured)
    return {
        "model": "pruned" if pruned else "base", "file": "splats.ply", "gaussians": len(splats),
        "bytes": path.stat().st_size, "transform": similarity.to_json(),
        **({"files": files} if files else {}),
    }


class _Hand:
    """Writes other formats than the .ply, and checks what came out."""

    def __init__(
        self, config: ExportConfig, inputs: StageInputs, out: Path, similarity: Similarity,
        splats: Splats, ctx: StageContext,
    ) -> None:
        train = read_config(inputs.folders["train"])
        self._config, self._out, self._splats, self._ctx = config, out, splats, ctx
        self._scene = load_scene(inputs, validation=train.validation)
        self._similarity = similarity
        self._axes = Z_UP if _up_found(inputs.folders["sfm"]) else Y_DOWN
        self._views: Fidelity = fidelity(self._scene, similarity, train.max_size, ctx)
        self._before_db: float | None = None

    def out_as(self, name: str) -> Summary:
        """Writes one format and returns what became of it."""
        scene: dict[str, Callable[[Scene], Path]] = {
            "points.ply": lambda _: self._points(), "colmap": self._colmap,
            "transforms.json": self._transforms}
        if name in scene:
            path = scene[name](self._scene)
            return {"file": path.name}
        path = self._out / f"splats.{name}"
        if name == "glb":
            write_glb(path, self._splats, axes=self._axes)
        else:
            FORMATS[name].write(path, self._splats)
        return self._told(name, path, FORMATS[name].read(path))

    def _told(self, name: str, path: Path, back: Splats) -> Summary:
        """Returns size and loss of a file that was read back, and says them.

        Raises:
            ReconstructionError: it loses more than it may.
        """
        if self._before_db is None:
            self._before_db = self._views.psnr_db(self._splats)
        gain = self._views.psnr_db(back) - self._before_db
        size, whole = path.stat().st_size, (self._out / "splats.ply").stat().st_size
        text = f"{name}: {whole / size:.1f}x smaller, {gain:+.2f} dB"
        most = self._config.max_loss
        if most is None:
            most = MOST_LOSS_DB.get(name, _MOST_LOSS_DB)
        if not gain >= -most:  # a NaN fails too
            raise ReconstructionError(
                f"{text} on {len(self._views.views)} views, but it may lose {most:g} dB at most.",
                hint="Leave this format out, or allow more with --max-loss.")
        logger.info("%s", text)
        return {"file": path.name, "bytes": size, "smaller": round(whole / size, 3),
                "psnr_change_db": round(gain, 4)}

    def _points(self) -> Path:
        path = self._out / "points.ply"
        write_points(path, self._splats)
        return path

    def _colmap(self, scene: Scene) -> Path:
        path = self._out / "colmap"
        views = [(view.name, self._similarity.camera(view.camera)) for view in _all(scene)]
        write_colmap(path, views, self._similarity.points(scene.points), scene.colors)
        return path

    def _transforms(self, scene: Scene) -> Path:
        path = self._out / "transforms.json"
        views = [(f"images/{view.name}", self._similarity.camera(view.camera))
                 for view in _all(scene)]
        write_transforms(path, views, held_out={f"images/{view.name}" for view in scene.test})
        return path


def _all(scene: Scene) -> list[View]:
    return sorted((*scene.train, *scene.validation, *scene.test), key=lambda view: view.name)


def _up_found(sfm: Path) -> bool:
    """Tells whether z is up in the world of a mapping."""
    world = sfm / "world.json"
    if not world.exists():
        return False
    found = json.loads(world.read_text(encoding="utf-8")).get("evidence") or {}
    return bool(found.get("up_found"))


def _measured(config: ExportConfig, inputs: StageInputs) -> Measurement | None:
    """Returns how long a metre is in the scene that was trained, where the user says so."""
    if config.scale_between is None:
        return None
    sparse = inputs.folders["sfm"] / "undistorted" / "sparse"
    points, _ = read_points(sparse / "points3D.bin")
    viewmats = {name: viewmat for name, _, viewmat in read_images(sparse / "images.bin")}
    return measure(ScaleBetween(*config.scale_between), points, viewmats, read_pinholes(sparse))


def _write_transform(
    path: Path, similarity: Similarity, measured: Measurement | None
) -> None:
    write_json(path, {
        "from": "the world of sfm, in which the scene was trained",
        "to": "splats.ply beside this file",
        "similarity": similarity.to_json(),
        "measurement": measured.to_json() if measured else None,
    })


def verify(path: Path, splats: Splats) -> None:
    """Raises WorkspaceError unless the file reads back as exactly these Gaussians."""
    back = read_ply(path).with_degree(splats.sh_degree)
    for name, value in splats.parameters().items():
        read = getattr(back, name)
        if name == "sh_rest":  # rows of zeros at the end are read as no rows
            value, read = with_rows(value, len(splats)), with_rows(read, len(back))
        if not torch.equal(read, value):
            raise WorkspaceError(
                f"{path} reads back with another {name} than was written.",
                hint="Check the disk, then run `recon export --again`.")
