"""All that a run needs to resume with the very same bytes, and its checkpoint (safetensors)."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from recon_cli.config.stages import RunConfig
from recon_cli.errors import FormatError, TrainingError, name_command
from recon_cli.render import Statistics
from recon_cli.scene.backdrop import Backdrop
from recon_cli.scene.splats import Splats
from recon_cli.train.fit.optimizer import SplatOptimizer
from recon_cli.train.parts.photometry import Photometry
from recon_cli.workspace.atomic import parse_json, replacing

LONG_SAVE = 0.25  # seconds; a checkpoint that takes longer is written less often
SAVE_SHARE = 0.1  # of the time, that such checkpoints may take
_VERSION = 5


@dataclass(eq=False)
class DensificationStats:
    """Gradient statistics of each Gaussian since the last densification."""

    # [N] sum over steps of |gradient of the projected mean|, in normalised device coordinates
    pull: Tensor
    count: Tensor  # [N] steps in which the Gaussian was seen
    radius: Tensor  # [N] largest radius on the screen, pixels
    # [N] sum over steps of sum ds^2 - (sum ds)^2 / n over the n pixels of the Gaussian, with ds = o
    # dL/do: how much its pixels disagree about what it should be
    variance: Tensor

    @staticmethod
    def zeros(n: int, device: torch.device) -> DensificationStats:
        """Returns the statistics of n Gaussians before any step."""
        return DensificationStats(*(torch.zeros(n, device=device) for _ in range(4)))

    def add(self, statistics: Statistics, width: int, height: int, *, variance: bool) -> None:
        """Adds the statistics of a backward pass over an image of width x height.

        With `variance` that alone, else all others: no strategy needs both, and over all Gaussians
        they would take a tenth of a step.
        """
        if variance:
            self.variance += statistics.variance
            return
        # numbers and not a tensor of them: a copy to a GPU would wait for it
        across, down = statistics.means2d_grad.unbind(-1)
        self.pull += torch.stack((across * (width / 2), down * (height / 2)), -1).norm(dim=-1)
        self.count += statistics.radii > 0
        self.radius = torch.maximum(self.radius, statistics.radii)

    def times(self, factor: Tensor) -> DensificationStats:
        """Returns all of it times a factor, a number on the device."""
        return DensificationStats(*(value * factor for value in vars(self).values()))

    def join(self, other: DensificationStats) -> None:
        """Adds the statistics of other views."""
        self.pull += other.pull
        self.count += other.count
        self.radius = torch.maximum(self.radius, other.radius)
        self.variance += other.variance

    @property
    def mean_grad2d(self) -> Tensor:
        """Mean length per step in which the Gaussian was seen, [N]; 0 where it never was."""
        return self.pull / self.count.clamp_min(1)


@dataclass(eq=False)
class TrainState:
    """A run after `iteration` steps."""

    optimizer: SplatOptimizer  # holds the splats and their moments
    gathered: DensificationStats  # gathered by steps, for densification
    generator: torch.Generator  # source of every random choice; always on the CPU
    iteration: int = 0  # steps done
    # indices of the views still to come in this epoch, last first
    queue: list[int] = field(default_factory=list)
    first_count: int = 0  # Gaussians before the first step; budgets grow from there
    skipped: int = 0  # steps whose loss was not finite, and that changed nothing
    # (iteration, validation PSNR in dB) at each regular report so far
    validation_history: list[tuple[int, float]] = field(default_factory=list)
    # iterations of an early stop, and at which it continued
    skipped_phase: tuple[int, int] | None = None
    photometry: Photometry | None = None  # of the training images; None where no part is fitted

    @property
    def steps(self) -> int:
        """Steps really taken."""
        begin, end = self.skipped_phase or (0, 0)
        return self.iteration - (end - begin)

    @property
    def splats(self) -> Splats:
        """The Gaussians as they are now; leaves of the optimizer."""
        return self.optimizer.splats


def new_state(
    splats: Splats, config: RunConfig, means_unit: float, *, backend: str = "torch",
    photometry: Photometry | None = None,
) -> TrainState:
    """Returns the state before the first step."""
    generator = torch.Generator().manual_seed(config.seed)
    gathered = DensificationStats.zeros(len(splats), splats.means.device)
    return TrainState(
        SplatOptimizer(splats, config, means_unit, backend=backend), gathered, generator,
        first_count=len(splats), photometry=photometry)


def save_state(path: Path, state: TrainState) -> None:
    """Writes a checkpoint atomically.

    Raises:
        TrainingError: a parameter is not finite; the checkpoint before it stays.
    """
    tensors = tensors_of(state)
    check_finite(tensors, "Training diverged")
    scalars = {"version": _VERSION, "iteration": state.iteration, "queue": state.queue,
               "first_count": state.first_count, "skipped": state.skipped,
               "looks": state.validation_history, "jump": state.skipped_phase,
               "backdrop": state.splats.backdrop and state.splats.backdrop.numbers}
    with replacing(path) as temporary:
        save_file({name: value.contiguous().cpu() for name, value in tensors.items()},
                  temporary, metadata={"state": json.dumps(scalars)})


def tensors_of(state: TrainState) -> dict[str, Tensor]:
    """Returns all tensors of a state by name."""
    tensors = state.optimizer.tensors()
    for name, value in vars(state.gathered).items():
        tensors[f"gathered.{name}"] = value
    tensors["generator"] = state.generator.get_state()
    return tensors if state.photometry is None else tensors | state.photometry.tensors()


def load_state(
    path: Path, config: RunConfig, means_unit: float, device: torch.device, *,
    backend: str = "torch", photometry: Photometry | None = None,
) -> TrainState:
    """Returns the state that `save_state` wrote; `photometry` takes its part back.

    Raises:
        FormatError: the file is truncated or of another version.
        TrainingError: it holds values that are not finite.
    """
    try:
        with safe_open(path, framework="pt") as file:
            scalars = parse_json((file.metadata() or {})["state"], dict, finite=False)
            # copies, for views keep the file open, which Windows then refuses to replace
            tensors = {
                name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        if scalars["version"] != _VERSION:
            raise KeyError("version")
        generator = torch.Generator()
        generator.set_state(tensors.pop("generator"))
        tensors = {name: value.to(device) for name, value in tensors.items()}
        backdrop = scalars.get("backdrop")
        splats = Splats.from_parameters(
            _under("splats.", tensors), backdrop and Backdrop.from_numbers(backdrop))
        state = TrainState(
            SplatOptimizer(splats, config, means_unit, backend=backend),
            DensificationStats(**_under("gathered.", tensors)), generator,
            int(scalars["iteration"]),
            [int(i) for i in scalars["queue"]], int(scalars["first_count"]),
            int(scalars["skipped"]), [(int(at), float(psnr)) for at, psnr in scalars["looks"]],
            (int(scalars["jump"][0]), int(scalars["jump"][1])) if scalars["jump"] else None)
        state.optimizer.restore(tensors)
        if photometry is not None:
            photometry.restore(tensors)
        state.photometry = photometry
    except (SafetensorError, OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise _unreadable(path, error) from error
    check_finite(tensors, f"The checkpoint {path} is damaged")
    return state


def read_progress(path: Path) -> tuple[int, int]:
    """Returns the steps taken and the count of Gaussians in a checkpoint, without loading it.

    Raises:
        FormatError: the file is truncated or of another version.
    """
    try:
        with safe_open(path, framework="pt") as file:
            scalars = parse_json((file.metadata() or {})["state"], dict, finite=False)
            begin, end = scalars["jump"] or (0, 0)
            return (int(scalars["iteration"]) - (end - begin),
                    file.get_slice("splats.means").get_shape()[0])
    except (SafetensorError, OSError, KeyError, ValueError, TypeError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> FormatError:
    return FormatError(
        f"The checkpoint {path} cannot be read: {error}.",
        hint=f"Run {name_command(f'{path.parent.name} --again')}; it starts from the beginning.")


def check_finite(tensors: dict[str, Tensor], where: str) -> None:
    """Raises TrainingError, opening with `where`, unless every value is finite."""
    for name, value in tensors.items():
        if value.is_floating_point() and not torch.isfinite(value).all():
            raise TrainingError(
                f"{where}: {name} holds values that are not finite.",
                hint="Run the stage again with --again; if it recurs, lower the learning rates.")


def _under(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value
            for name, value in tensors.items() if name.startswith(prefix)}
