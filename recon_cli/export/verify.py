"""Checks of written files: the .ply bit for bit, every other format by its PSNR on known views."""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from recon_cli.context import StageContext
from recon_cli.errors import ReconstructionError, WorkspaceError, name_command
from recon_cli.scene.scene import Scene
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splat_arrays import SplatArrays
from recon_cli.splats.axes import flip
from recon_cli.splats.format import LoadedScene, WriteSettings
from recon_cli.splats.ply import read_arrays
from recon_cli.splats.registry import FORMATS
from recon_cli.splats.values import trim_zero_rows
from recon_cli.workspace.export_formats import ExportFormat, LossLimit

if TYPE_CHECKING:  # `recon convert` starts without torch and readers of images
    from recon_cli.io.views import ReferenceView
    from recon_cli.scene.splats import Splats

_VIEWS = 8  # rendered for each file, at most


class Psnr(Protocol):
    """A measure of scenes: PSNR on known views."""

    def psnr_db(self, splats: Splats | SplatArrays) -> float:
        """Returns the mean over the views in dB."""
        ...


def write_until_good(
    row: ExportFormat, path: Path, splats: Splats | SplatArrays, settings: WriteSettings,
    psnr: Psnr, *,
    reference_db: float, limit: LossLimit, max_bytes: int | None = None,
) -> float:
    """Writes a file with ever less sharing, and returns its gain in dB over `reference_db`.

    It stops where the loss is allowed, or the file is larger than `max_bytes`.
    """
    form, gain = FORMATS[row.name], -math.inf
    for sharing in row.sharing:
        form.write(path, splats, dataclasses.replace(settings, sharing=sharing))
        if max_bytes is not None and file_size(row, path) > max_bytes:
            break
        psnr_db = psnr.psnr_db(_as_written(form.load(path), settings))
        gain = psnr_db - reference_db
        if limit.allows(gain, psnr_db):
            break
    return gain


def _as_written(scene: LoadedScene, settings: WriteSettings) -> SplatArrays:
    """Returns a scene in the axes that it was written in.

    Of a file that says that y is up, reading turns it half round x, to -y.
    """
    turned = (scene.up, settings.up_axis) == ("-y", "y")
    return flip(scene.arrays, [1, -1, -1]) if turned else scene.arrays


def measure_size(row: ExportFormat, splats: Splats, settings: WriteSettings) -> int:
    """Returns the bytes that a scene takes in a format of Gaussians."""
    with tempfile.TemporaryDirectory(prefix="recon-size-") as folder:
        path = Path(folder) / row.file
        cut = splats.with_degree(min(row.sh_degree, splats.sh_degree))
        FORMATS[row.name].write(path, cut, settings)
        return file_size(row, path)


def file_size(row: ExportFormat, path: Path) -> int:
    """Returns the bytes of a scene: of its file, or of all beside a lod-meta.json."""
    if "/" not in row.file:
        return path.stat().st_size
    return sum(file.stat().st_size for file in path.parent.rglob("*") if file.is_file())


def verify_ply(path: Path, splats: Splats | SplatArrays, *, again: str = "") -> None:
    """Raises WorkspaceError unless a .ply reads back as exactly these Gaussians."""
    back = read_arrays(path).parameters()
    for name, value in splats.as_arrays().parameters().items():
        read = back[name]
        if name == "sh_rest":  # trailing rows of zeros are not stored
            value, read = trim_zero_rows(value), trim_zero_rows(read)
        if not (np.array_equal(read, value) or value.size == read.size == 0):
            raise WorkspaceError(
                f"{path} reads back with a different {name} than was written.",
                hint=f"Check the disk, then {again or 'run ' + name_command('export --again')}.")


@dataclass(frozen=True, eq=False)
class ReferencePsnr:
    """PSNR of a scene and its files on reference views, none of which is a test view."""

    views: Sequence[ReferenceView]  # with cameras in the world of the files
    ctx: StageContext  # backend and device

    def describe(self) -> str:
        """Returns the views as part of a sentence."""
        return f"{len(self.views)} views"

    def psnr_db(self, splats: Splats | SplatArrays) -> float:
        """Returns the mean PSNR of a scene over the views in dB."""
        from recon_cli.evaluation.reference_views import mean_psnr

        on_device = splats.as_tensors().map(lambda tensor: tensor.to(self.ctx.device))
        return mean_psnr(on_device, self.views, on_device.sh_degree, self.ctx.backend)


def load_reference_psnr(
    scene: Scene, similarity: Similarity, max_size: int, ctx: StageContext
) -> ReferencePsnr:
    """Loads the validation views, or some training views if there are none.

    `similarity` leads from the world of the training to that of the files. ReconstructionError if
    masks leave nothing of any view.
    """
    from recon_cli.evaluation.reference_views import load_reference_views
    from recon_cli.io.views import MASK_HINT, evenly_spread

    chosen = evenly_spread(scene.validation or scene.train, _VIEWS)
    views = [dataclasses.replace(view, camera=similarity.camera(view.camera))
             for view in load_reference_views(chosen, max_size)]
    if not views:
        raise ReconstructionError(
            f"The masks leave nothing of {len(chosen)} views to check the export on.",
            hint=MASK_HINT)
    return ReferencePsnr(views, ctx)
