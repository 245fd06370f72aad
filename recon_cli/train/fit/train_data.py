"""The views that a run trains on, the memory that it takes, and the options it was started with."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from recon_cli.config.stages import RunConfig
from recon_cli.context import StageContext
from recon_cli.errors import (
    ConfigError,
    FormatError,
    Hint,
    TrainingError,
    format_count,
    name_command,
)
from recon_cli.io import views as view_files
from recon_cli.io.colmap import read_visibility
from recon_cli.io.images import fit_camera
from recon_cli.machine import free_memory_bytes
from recon_cli.render.contract import NEAR
from recon_cli.scene.image_file import SEGMENT, ImageFile
from recon_cli.scene.scene import Scene, View
from recon_cli.scene.splats import TERMS
from recon_cli.scene.train_view import TrainView
from recon_cli.train.fit.schedule import Schedule
from recon_cli.train.fit.task import Evidence, Task, Tracks
from recon_cli.train.parts.depth import depth_bytes, load_sensor_depth
from recon_cli.workspace.atomic import read_json, write_bytes

logger = logging.getLogger("recon")

# Memory is counted from what the code allocates and rounded up; `recon bench` measures a step.
_FLOATS = (3, 4, 3, 1, 3)  # of a Gaussian: mean, quaternion, scales, opacity, colour
# values, gradients and two moments, and a copy of the values while densification rebuilds them
_COPIES = 4 + 1
_BUFFERS_PER_GAUSSIAN = 128 + 6 * 72  # a record, indices and the gradient sums of about six tiles
_BUFFERS_PER_PIXEL = 96  # image, its gradient, three maps of the loss, transmittance
_PROGRAM = 350 << 20  # Python, torch and the kernels
_REDUCED = 1.25  # of the images: full ones and those of half the size
_IN_MEMORY = 0.5  # of the memory; images that take more lie in a file
_TORCH_FACTOR = 4  # autograd keeps what the fused kernels compute again


def load_task(scene: Scene, config: RunConfig, ctx: StageContext) -> Task:
    """Returns the training task at the training size, images as uint8 in memory or in a file.

    Raises:
        TrainingError: fewer than two views are left to train on, or memory is short.
    """
    refuse_few_views(scene)
    _refuse_tiny_units(scene)
    file = image_file(ctx) if check_memory(scene, config, ctx).in_file else None
    views = load_views(scene.train, config, ctx, file)
    sensor = load_sensor_depth(scene, config)
    train: list[TrainView] = [
        dataclasses.replace(view, depth=sensor.depths.get(view.name)) for view in views]
    if len(train) < 2:
        raise TrainingError(
            f"The masks leave only {format_count(len(train), 'view')} to train on; at least 2 are "
            "needed.",
            hint=view_files.MASK_HINT)
    if ctx.device == "cuda":
        train = [view.page_locked() for view in train]
    nearness = scene.nearness if len(scene.points) else None
    validation = load_views(scene.validation, config, ctx, file)
    return Task(
        train, [*validation], Schedule(config), scene.extent,
        ctx.backend, torch.device(ctx.device), nearness=nearness, cell=scene.cell,
        evidence=Evidence(
            train, scene.points, scene.extent,
            lambda: _read_tracks(scene, [view.name for view in views]), ctx.progress),
        depth_refused=sensor.refused)


def _read_tracks(scene: Scene, names: Sequence[str]) -> Tracks:
    """Returns the rows of the points that the views of these names see."""
    seen = {} if scene.sparse is None else read_visibility(scene.sparse)
    nothing = np.empty(0, np.int64)
    return [seen.get(name, nothing) for name in names]


def _refuse_tiny_units(scene: Scene) -> None:
    """Raises TrainingError where half of the scene lies in front of the rasterizer's near plane."""
    if scene.nearness < NEAR:
        raise TrainingError(
            f"Half of the points are nearer than {scene.nearness:.2g} units to a camera, but "
            f"Gaussians nearer than {NEAR:g} are not drawn: the units of this scene are too large.",
            hint=f"Give it a scale with {name_command('sfm --scale-between A B METRES')}, or "
            "scale the poses of the data set.")


def load_views(
    views: Sequence[View], config: RunConfig, ctx: StageContext, file: ImageFile | None = None
) -> list[view_files.ReferenceView]:
    """Returns the views at the training size, without those whose mask leaves next to nothing."""
    return [*view_files.load_views(
        views, config.max_size, "not trained on", ctx.notice, denoised=config.images == "denoised",
        threads=ctx.threads, file=file)]


def image_file(ctx: StageContext) -> ImageFile:
    """Returns a file for images that would take too much memory."""
    if ctx.scratch is not None:
        ctx.scratch.mkdir(parents=True, exist_ok=True)
    return ImageFile(ctx.scratch, SEGMENT)


def write_config(folder: Path, config: RunConfig) -> None:
    """Writes the options of a run beside its checkpoints."""
    write_bytes(folder / "config.json", json.dumps(config.hashed_fields(), indent=1).encode())


def read_config(folder: Path) -> RunConfig:
    """Returns the options that `write_config` wrote.

    Raises:
        FormatError: a version before this one wrote a value that this one does not know.
    """
    path = folder / "config.json"
    values = RunConfig.rename(read_json(path, dict, hint=Hint("train", again=True)))
    names = {item.name for item in dataclasses.fields(RunConfig)}
    try:
        return RunConfig(**{name: value for name, value in values.items() if name in names})
    except (ConfigError, AttributeError) as error:
        raise FormatError(
            f"{path} is of another version of recon: {error}",
            hint=Hint("train", again=True)) from error


@dataclass(frozen=True)
class MemoryEstimate:
    """The bytes that a run needs at its peak."""

    images: int  # all views as uint8, their masks and sensor depth
    pixel_buffers: int  # of one step, for each pixel of a view
    gaussians: int  # parameters, gradients, moments at the largest count
    gaussian_buffers: int  # of one step, for each Gaussian
    program: int  # everything else
    in_file: bool  # whether the images lie in a file, and few of them in memory

    @property
    def total(self) -> int:
        """Sum of all parts."""
        return (self.images + self.pixel_buffers + self.gaussians + self.gaussian_buffers
                + self.program)

    def describe(self) -> str:
        """Returns the estimate in words."""
        buffers = self.pixel_buffers + self.gaussian_buffers
        images = f"images {_megabytes(self.images)}{' at a time' if self.in_file else ''}"
        return (f"about {_megabytes(self.total)} ({images}, Gaussians "
                f"{_megabytes(self.gaussians)}, buffers {_megabytes(buffers)})")


def estimate_memory(
    *, views: int, width: int, height: int, gaussians: int, fused: bool, sh_degree: int = 3,
    masks: int = 0, free: int | None = None,
) -> MemoryEstimate:
    """Returns the memory for views of at most width x height; `fused` means without autograd.

    Images that take too much of `free` bytes lie in a file.
    """
    pixels = width * height
    images = int(_REDUCED * pixels * (3 * views + masks))
    in_file = free is not None and images > _IN_MEMORY * free
    if in_file:
        images = min(images, SEGMENT + int(_REDUCED * pixels * masks))
    rest = 3 * TERMS[sh_degree]
    # and of one moment of one parameter at a time
    per_gaussian = 4 * (_COPIES * (sum(_FLOATS) + rest) + max(*_FLOATS, rest))
    factor = 1 if fused else _TORCH_FACTOR
    return MemoryEstimate(
        images=images, pixel_buffers=factor * pixels * _BUFFERS_PER_PIXEL,
        gaussians=gaussians * per_gaussian,
        gaussian_buffers=factor * gaussians * _BUFFERS_PER_GAUSSIAN, program=_PROGRAM,
        in_file=in_file)


def gaussians_within(one: MemoryEstimate, free: int) -> int:
    """Returns how many Gaussians fit into `free` bytes; `one` is the estimate for a single one."""
    each = one.gaussians + one.gaussian_buffers
    return max(0, (free - one.total + each) // each)


def refuse_what_does_not_fit(
    needed: MemoryEstimate, free: int, *, limited: bool = False
) -> None:
    """Raises TrainingError, naming an option to lower, unless the estimate fits into `free` bytes.

    `limited` says that more are free, but not to be used.
    """
    if needed.total <= free:
        return
    by_size = needed.images + needed.pixel_buffers
    by_count = needed.gaussians + needed.gaussian_buffers
    lower = "--max-size" if by_size > by_count else "--max-gaussians"
    raise TrainingError(
        f"Training needs {needed.describe()}, but {_megabytes(free)} "
        f"{'may be used' if limited else 'are free'}.",
        hint=f"Lower {lower}, or {'raise --max-memory' if limited else 'close other programs'}.")


def _megabytes(count: int) -> str:
    return f"{count / 1e6:,.0f} MB"


def gaussians_that_fit(scene: Scene, config: RunConfig, ctx: StageContext) -> int:
    """Returns how many Gaussians memory has room for, before the images are loaded.

    Raises:
        TrainingError: fewer than two views are left to train on.
    """
    refuse_few_views(scene)
    return gaussians_within(_memory(scene, config, ctx, gaussians=1), _free_bytes(ctx))


def refuse_few_views(scene: Scene) -> None:
    """Raises TrainingError unless there are two views to train on."""
    if len(scene.train) < 2:
        raise TrainingError(
            f"Only {format_count(len(scene.train), 'view')} can be trained on; at least 2 are "
            "needed.",
            hint=Hint("ingest", then=" with a smaller --holdout, such as every:8"))


def _memory(
    scene: Scene, config: RunConfig, ctx: StageContext, *, gaussians: int
) -> MemoryEstimate:
    views = (*scene.train, *scene.validation)
    width, height = view_files.sizes_of(
        [fit_camera(view.camera, config.max_size) for view in views])[0]
    needed = estimate_memory(
        views=len(views), width=width, height=height, gaussians=gaussians,
        fused=ctx.backend == "numba", sh_degree=config.sh_degree,
        masks=sum(view.mask is not None for view in views), free=_host_bytes(ctx))
    return dataclasses.replace(needed, images=needed.images + depth_bytes(scene, config))


def _free_bytes(ctx: StageContext) -> int:
    return torch.cuda.mem_get_info()[0] if ctx.device == "cuda" else _host_bytes(ctx)


def _host_bytes(ctx: StageContext) -> int:
    """Returns the memory beside the CPU that this process may take."""
    free = free_memory_bytes()
    return free if ctx.max_memory_bytes is None else min(free, ctx.max_memory_bytes)


def check_memory(scene: Scene, config: RunConfig, ctx: StageContext) -> MemoryEstimate:
    """Returns and logs the memory that the run will take; TrainingError where that is not free."""
    needed = _memory(scene, config, ctx, gaussians=config.max_gaussians)
    free = _free_bytes(ctx)
    logger.info("training takes %s at most; %.0f MB may be used", needed.describe(), free / 1e6)
    refuse_what_does_not_fit(needed, free, limited=free == ctx.max_memory_bytes)
    return needed
