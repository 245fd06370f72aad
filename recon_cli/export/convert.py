"""Splat files made of others: placed, merged, reduced, written in any format, and checked.

No workspace and no views are needed: a file is checked on synthetic cameras, against renders of the
scene that was to be written. Whatever fails, the file that it would have replaced stays.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recon_cli.context import StageContext
from recon_cli.errors import ConfigError, FormatError, InputError, ReconstructionError
from recon_cli.export.synthetic_cameras import ASSUMED_DB, VIEW_SIZE, SelfPsnr, synthetic_scene
from recon_cli.export.verify import file_size, measure_size, verify_ply, write_until_good
from recon_cli.scene.scene import Scene
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splat_arrays import SplatArrays
from recon_cli.splats.axes import UP, nearest_up
from recon_cli.splats.format import LoadedScene, WriteSettings
from recon_cli.splats.lod import discard_levels
from recon_cli.splats.registry import FORMATS, check_writable, load_splats
from recon_cli.workspace import durable
from recon_cli.workspace.atomic import sync_folder
from recon_cli.workspace.export_formats import ExportFormat, LossLimit

if TYPE_CHECKING:  # where nothing is reduced, `recon convert` does without torch
    from recon_cli.export.reduce import Box
    from recon_cli.scene.splats import Splats

_GUESSED_UP = "-y"  # of a file that does not say, as in viewers
_NO_VIEWS = (
    "--drop-floaters has no views here: it finds Gaussians that are too faint to be drawn, faint "
    "and large, or alone. What hides a surface from the camera's path, or was seen by nobody, "
    "`recon export --drop-floaters` finds in a workspace.")

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class ConvertRequest:
    """Which files become which one, and the changes on the way, in the order in which they run."""

    inputs: tuple[Path, ...]
    out: Path
    transforms: tuple[Similarity, ...] = ()  # one for each input; empty: all stay where they are
    scale: float = 1.0
    up: str | None = None  # z, y or -y
    drop_floaters: bool = False
    drop_islands: bool = False
    crop: Box | None = None  # in units of the file that is written
    sh_degree: int | None = None
    max_gaussians: int | None = None
    max_mb: float | None = None
    max_loss: float | None = None  # dB; None for that of the format
    force: bool = False  # an existing file is replaced

    @property
    def reduces(self) -> bool:
        """Whether an option removes something."""
        return self.drop_floaters or self.drop_islands or any(
            limit is not None
            for limit in (self.crop, self.sh_degree, self.max_gaussians, self.max_mb))


@dataclass(frozen=True)
class Converted:
    """A file that was written."""

    file: str
    gaussians: int
    sh_degree: int
    bytes: int
    psnr_change_db: float  # on the scale of photos, see `SelfPsnr`

    def describe(self) -> str:
        """Returns one line about it."""
        change = "written exactly" if not self.psnr_change_db and self.file.endswith(".ply") else (
            f"{self.psnr_change_db:+.2f} dB")
        return (f"{self.file}: {self.gaussians:,} Gaussians of degree {self.sh_degree}, "
                f"{self.bytes / 1e6:.1f} MB, {change}")


def convert(request: ConvertRequest, ctx: StageContext) -> Converted:
    """Writes the file of a request and returns what it holds.

    Raises:
        ConfigError: an option does not fit the inputs, or would leave nothing.
        InputError: the file to write exists already, or has no folder.
        FormatError: an input is damaged, or of an unknown format.
        ReconstructionError: the file would lose more than it may.
    """
    row = _check_out(request)
    whole, settings = _merge(request, ctx)
    assert settings.up is not None, "of a merged scene it is known, or taken to be -y"
    reducer = _Reducer(whole, settings.up, ctx)
    splats = reducer.reduce(
        request, lambda changed: measure_size(row, changed, settings)) if request.reduces else whole
    checked = reducer if splats is whole else _Reducer(splats, settings.up, ctx)
    folder = request.out.parent
    with tempfile.TemporaryDirectory(dir=folder, prefix=".recon-convert-") as scratch:
        path = Path(scratch) / request.out.name
        gain = _write(row, path, splats, settings, request, checked)
        # formats hold the backdrop as Gaussians, as many as their greatest scale needs
        size = file_size(row, path)
        count = len(FORMATS[row.name].load(path).arrays.with_sphere())
        if row.name == "lod":
            discard_levels(request.out)
            for part in path.parent.iterdir():
                if part != path:  # it names the others, and is the last
                    durable.rename(part, folder / part.name)
        durable.replace(path, request.out)
    sync_folder(folder)
    return Converted(str(request.out), count, splats.sh_degree, size, round(gain, 4))


def _check_out(request: ConvertRequest) -> ExportFormat:
    """Returns the format of the file to write; InputError or FormatError if it cannot be made."""
    out, row = request.out, check_writable(request.out)
    if out.exists() and not request.force:
        raise InputError(f"{out} exists already.", hint="Give another name, or add --force.")
    if request.transforms and len(request.transforms) != len(request.inputs):
        raise ConfigError(
            f"{len(request.transforms)} times --transform for {len(request.inputs)} files.",
            hint="Give one for each file, in their order; `--transform -` leaves one in place.")
    return row


def _write(
    row: ExportFormat, path: Path, splats: SplatArrays, settings: WriteSettings,
    request: ConvertRequest, reducer: _Reducer,
) -> float:
    """Writes and checks a file, and returns its gain in dB; ReconstructionError if it is bad."""
    if row.name == "ply":
        FORMATS[row.name].write(path, splats, settings)
        verify_ply(path, splats, again="convert again")
        return 0.0
    limit = LossLimit.from_option(row, request.max_loss)
    gain = write_until_good(
        row, path, reducer.at_degree(splats, row.sh_degree), settings, reducer.psnr,
        reference_db=ASSUMED_DB, limit=limit,
        max_bytes=None if request.max_mb is None else int(1e6 * request.max_mb))
    if not limit.allows(gain, ASSUMED_DB + gain):
        raise ReconstructionError(
            f"{request.out} would lose {-gain:.2f} dB on {reducer.psnr.describe()}; "
            f"{limit.most_db:g} dB are allowed.",
            hint="Write another format, or allow more with --max-loss.")
    logger.info("checked on %s", reducer.psnr.describe())
    return gain


def _merge(
    request: ConvertRequest, ctx: StageContext
) -> tuple[SplatArrays, WriteSettings]:
    """Returns the scene of all inputs, each in its place, and the facts that a file can hold.

    Up and scale are those of the request. Each position is rounded to float32 once.
    """
    scenes = [load_splats(path) for path in request.inputs]
    for path, scene in zip(request.inputs, scenes, strict=True):
        if not len(scene.arrays):
            raise FormatError(f"{path} holds no Gaussians.", hint="Leave it out.")
    transforms = request.transforms or (Similarity(),) * len(scenes)
    # The first far scene that stays where it is takes the origin of the result with it.
    origin = next((scene.origin for scene, transform in zip(scenes, transforms, strict=True)
                   if scene.origin and transform.is_identity), None)
    if origin is not None:
        ctx.notice(f"{origin.describe()}, in the written file too")
    placed = [
        transform.after(_moved(scene.origin.point if scene.origin else (0.0, 0.0, 0.0)))
        for scene, transform in zip(scenes, transforms, strict=True)]
    ups = [transform.rotation @ UP[scene.up or _GUESSED_UP]
           for scene, transform in zip(scenes, transforms, strict=True)]
    world = _world(request, ups[0], known=scenes[0].up is not None, ctx=ctx)
    if origin is not None:
        x, y, z = origin.point
        world = world.after(_moved((-x, -y, -z)))
    _tell_differences(request.inputs, scenes, ups, ctx)
    return _join(scenes, [world.after(similarity) for similarity in placed]), WriteSettings(
        up=world.rotation @ ups[0], antialiased=all(scene.antialiased for scene in scenes),
        title=request.out.name)


def _join(scenes: Sequence[LoadedScene], similarities: Sequence[Similarity]) -> SplatArrays:
    """Returns all scenes as one, each in its place."""
    if len(scenes) == 1 and similarities[0].is_identity:
        return scenes[0].arrays
    from recon_cli.scene.splats import joined, transformed

    degree = max(scene.arrays.sh_degree for scene in scenes)
    parts = []
    for scene, similarity in zip(scenes, similarities, strict=True):
        part = scene.splats if similarity.is_identity else transformed(scene.splats, similarity)
        parts.append(part.with_degree(degree) if part.sh_degree < degree else part)
    return (parts[0] if len(parts) == 1 else joined(parts)[0]).as_arrays()


def _moved(by: tuple[float, float, float]) -> Similarity:
    return Similarity(translation=np.array(by, np.float64))


def _world(
    request: ConvertRequest, up: NDArray[np.float64], *, known: bool, ctx: StageContext
) -> Similarity:
    """Returns the similarity of --scale and --up; `up` [3] is that of the first input."""
    if request.up is None:
        return Similarity(scale=request.scale)
    from recon_cli.scene.gravity import turn_onto

    if not known:
        ctx.notice(f"{request.inputs[0].name} does not say where up is: --up takes {_GUESSED_UP}, "
                   "as viewers do")
    return Similarity(scale=request.scale, rotation=turn_onto(up, np.array(UP[request.up])))


def _tell_differences(
    paths: Sequence[Path], scenes: Sequence[LoadedScene], ups: Sequence[NDArray[np.float64]],
    ctx: StageContext,
) -> None:
    """Gives notice of all in which merged scenes differ."""
    names = [path.name for path in paths]
    marked = [name for name, scene in zip(names, scenes, strict=True) if scene.antialiased]
    if marked and len(marked) < len(names):
        ctx.notice(f"trained for antialiased rendering: {', '.join(marked)}; the others were not, "
                   "so the written file does not say it")
    backdrops = [name for name, scene in zip(names, scenes, strict=True) if scene.arrays.backdrop]
    if len(backdrops) > 1:
        ctx.notice(f"{len(backdrops)} scenes have a backdrop: that of {backdrops[0]} is kept")
    for name, scene, up in zip(names, scenes, ups, strict=True):
        if scene.up is not None and scenes[0].up is not None and not np.allclose(
                up, ups[0], atol=0.1):
            ctx.notice(f"{name} has another axis up than {names[0]}; turn one with --transform")


class _Reducer:
    """A scene with the views that reductions and files of it are judged by."""

    def __init__(self, splats: SplatArrays, up: NDArray[np.float64], ctx: StageContext) -> None:
        self._splats, self._up, self._ctx = splats, up, ctx

    @cached_property
    def _scene(self) -> Scene:
        up = np.array(UP[nearest_up(self._up)])
        return synthetic_scene(self._splats, up=up, max_size=VIEW_SIZE)

    @property
    def _room(self) -> tuple[list[float], float]:
        """Middle [3] and radius, outside which lies only the view from windows."""
        return self._scene.center.tolist(), self._scene.reach

    @cached_property
    def psnr(self) -> SelfPsnr:
        """The measure of its files."""
        return SelfPsnr.from_renders(
            self._splats, [view.camera for view in self._scene.train], self._ctx)

    def at_degree(self, splats: SplatArrays, degree: int) -> SplatArrays:
        """Returns a version of the scene in at most this degree, as the views see it."""
        if degree >= splats.sh_degree:
            return splats
        from recon_cli.export.reduce import LowerDegrees

        cameras = [view.camera for view in self._scene.train]
        return LowerDegrees(splats.as_tensors(), cameras, backend=self._ctx.backend,
                            device=self._ctx.device).at(degree).as_arrays()

    def reduce(
        self, request: ConvertRequest, size_of: Callable[[Splats], int]
    ) -> SplatArrays:
        """Returns the scene after the options that remove something."""
        from recon_cli.export.cleanup import drop_floaters_without_views, drop_islands
        from recon_cli.export.reduce import crop, fit_to_size, measure_change

        splats = self._splats.as_tensors()

        def step(option: str, after: Splats) -> Splats:
            measure_change(option, splats, after, self.psnr.psnr_db)
            return after

        if request.drop_floaters:
            self._ctx.notice(_NO_VIEWS)
            splats = step("drop_floaters", drop_floaters_without_views(splats, self._room))
        if request.drop_islands:
            splats = step("drop_islands", drop_islands(splats, self._room, None, self._ctx))
        if request.crop is not None:
            splats = step("crop", crop(splats, request.crop))
        if request.sh_degree is not None and request.sh_degree < splats.sh_degree:
            splats = step(
                "sh_degree", self.at_degree(splats.as_arrays(), request.sh_degree).as_tensors())
        if request.max_gaussians is not None and request.max_gaussians < len(splats):
            splats = step("max_gaussians", _coarsened(splats, request.max_gaussians))
        if request.max_mb is not None:
            whole = splats
            splats = step("max_mb", fit_to_size(
                splats, int(1e6 * request.max_mb), size_of=size_of, fewer=_coarsened,
                at_degree=lambda degree: self.at_degree(whole.as_arrays(), degree).as_tensors(),
                psnr_db=self.psnr.psnr_db))
        return splats.as_arrays()


def _coarsened(splats: Splats, count: int) -> Splats:
    """Returns at most `count` Gaussians that stand for all; the backdrop stays.

    Without views, merging neighbours keeps more than dropping those that seem to matter least:
    docs/convert.md.
    """
    from recon_cli.splats.coarsen import coarsen

    return replace(coarsen(splats, count), backdrop=splats.backdrop)
