"""A fit by several processes: what the leader sends, and what the others do.

The leader sends a fit (JSON, plain bytes for arrays, and the state as the checkpoint that it would
be saved as, so that the others resume with the same bits). Before every step it sends the iteration
at which it begins, which also tells of a jump; other words are below zero. Whatever ends the fit
between two steps, the leader says so and the others wait for the next fit; in the middle of a step
nothing can be said, and it leaves.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.config.stages import RunConfig
from recon_cli.context import ProcessGroup, TrainCallback, TrainReport
from recon_cli.errors import LostError, TrainingError
from recon_cli.render import registry
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.scene.train_view import TrainView
from recon_cli.train.cost import EXCHANGE, join_exchange
from recon_cli.train.fit import fit
from recon_cli.train.importance import Importance
from recon_cli.train.initialize import restore_state
from recon_cli.train.schedule import (
    ContinuedSchedule,
    RecoverySchedule,
    Schedule,
    make_schedule,
)
from recon_cli.train.state import TrainState, save_state, tensors_of
from recon_cli.train.stepper import Stepper
from recon_cli.train.task import Task
from recon_cli.workspace.atomic import parse_json

_DONE, _FIT = 0, 1  # between fits, and EXCHANGE
_STOP, _END, _COMPARE = -1, -2, -3  # in a fit
_LENS = ("width", "height", "fx", "fy", "cx", "cy")
_STATE = "state.safetensors"


def fit_together(
    state: TrainState, task: Task, until: int, callbacks: Sequence[TrainCallback] = (),
    importance: Importance | None = None, threads: int = 1,
) -> None:
    """Runs `state` on like `fit`, with all processes of `task.ranks`; `callbacks` see every step.

    Raises:
        TrainingError: as `fit`, or the processes no longer hold the same Gaussians.
        LostError: a process is gone.
    """
    ranks = task.ranks
    if ranks.alone or state.iteration >= until:
        fit(state, task, until, callbacks, importance)
        return
    arrays = pack_fit(Fit(state, task, importance, threads))
    leader = _Leader(state, task, until, callbacks)
    try:
        ranks.broadcast_int(_FIT)
        send_arrays(arrays, ranks)
        ranks.views = task.train
        del arrays
        leader.start_step()
        fit(state, task, until, (leader,), importance)
        ranks.broadcast_int(_END)
        if importance is not None:
            importance.over(ranks)
    except BaseException as error:
        # what a step raises about the training, it raises in every process
        alike = leader.between_steps or isinstance(error, TrainingError)
        if alike and not isinstance(error, LostError):
            ranks.broadcast_int(_STOP)
        else:
            ranks.leave()
        raise


class _Leader(TrainCallback):
    """Calls callbacks while the other processes wait, then has them take the next step."""

    def __init__(
        self, state: TrainState, task: Task, until: int, callbacks: Sequence[TrainCallback]
    ) -> None:
        self._state, self._task, self._until, self._callbacks = state, task, until, callbacks
        self.between_steps = False  # the others wait for a word

    def start_step(self) -> None:
        self._task.ranks.broadcast_int(self._state.iteration)
        self.between_steps = False

    def on_step(self, iteration: int, splats: Splats) -> None:
        self.between_steps = True
        if self._task.schedule.densifies(iteration):
            _say_and_compare(self._state, self._task.ranks)
        for callback in self._callbacks:
            callback.on_step(iteration, splats)
        if iteration < self._until:
            self.start_step()

    def on_report(self, report: TrainReport) -> None:
        self.between_steps = True
        _say_and_compare(self._state, self._task.ranks)
        for callback in self._callbacks:
            callback.on_report(report)

    def needs_step(self, iteration: int) -> bool:  # noqa: ARG002
        return True


def dismiss(ranks: ProcessGroup) -> None:
    """Tells the other processes that there is nothing more to do, and leaves them."""
    with suppress(LostError):  # who is gone need not be told
        ranks.broadcast_int(_DONE)
    ranks.leave()


def follow(ranks: ProcessGroup) -> None:
    """Takes part in the leader's work until it is done; raises LostError where it is gone."""
    ready: set[str] = set()
    try:
        while (word := ranks.broadcast_int(_DONE)) != _DONE:
            if word == EXCHANGE:
                join_exchange(ranks)
                continue
            shared = unpack_fit(receive_arrays(ranks), ranks)
            if shared.task.backend not in ready:
                registry.use_threads(shared.task.backend, shared.threads)
                registry.prepare(shared.task.backend, lambda: None)
                ready.add(shared.task.backend)
            _take_part(shared)
            del shared  # the next one needs the room
    finally:  # gloo's threads let go of tensors, which they must not while Python ends
        ranks.leave()


def _take_part(shared: Fit) -> None:
    """Takes the steps that the leader takes."""
    state, ranks = shared.state, shared.task.ranks
    stepper = Stepper(state, shared.task, shared.importance)
    while (word := ranks.broadcast_int(_STOP)) not in (_STOP, _END):
        try:
            if word == _COMPARE:
                _compare(state, ranks)
            else:
                state.iteration = word
                stepper.step()
        except LostError:
            raise
        except TrainingError:
            if ranks.broadcast_int(_STOP) != _STOP:  # the leader met nothing of the kind
                raise
            return
    if word == _END and shared.importance is not None:
        shared.importance.over(ranks)


def _say_and_compare(state: TrainState, ranks: ProcessGroup) -> None:
    ranks.broadcast_int(_COMPARE)
    _compare(state, ranks)


def _compare(state: TrainState, ranks: ProcessGroup) -> None:
    """Raises TrainingError, in every process, unless all hold the same state."""
    digests = torch.tensor([_digest(tensor) for tensor in tensors_of(state).values()])
    most = torch.stack([digests, ~digests])
    ranks.all_reduce_max(most)
    if not torch.equal(most[0], ~most[1]):
        raise TrainingError(
            f"The processes hold different Gaussians after step {state.iteration}.",
            hint="Use machines of one kind, with the same versions of recon and torch; or train "
            "with one process.")


def _digest(tensor: Tensor) -> int:
    """Returns the sum of a tensor's bits, in words: cheap, and what differs soon differs widely."""
    flat = tensor.contiguous().reshape(-1)
    return int((flat if flat.dtype == torch.uint8 else flat.view(torch.int32)).sum())


@dataclass(frozen=True, eq=False)
class Fit:
    """What a process needs to take part in a fit."""

    state: TrainState  # to begin with
    task: Task  # views and plan; the validation views and the jump are the leader's alone
    importance: Importance | None  # where scores are gathered, None where they are not
    threads: int  # of the CPU


def pack_fit(fit: Fit) -> dict[str, NDArray[Any]]:
    """Returns arrays that say all about a fit, JSON first, without views that all processes hold.

    Raises:
        TrainingError: a parameter is not finite.
        OSError: there is no room for the state in the folder of temporary files.
    """
    task, schedule, importance = fit.task, fit.task.schedule, fit.importance
    assert schedule.recipe == Schedule(schedule.config).recipe, "only trials have one of their own"
    views = () if task.ranks.views is task.train else task.train
    recovery = [schedule.first, schedule.until] if isinstance(schedule, RecoverySchedule) else None
    continues_at = schedule.first if isinstance(schedule, ContinuedSchedule) else None
    said = {
        "config": dataclasses.asdict(schedule.config), "recovery": recovery,
        "continues_at": continues_at,
        "extent": task.extent, "nearness": task.nearness, "backend": task.backend,
        "device": task.device.type, "threads": fit.threads,
        "scores": importance and [importance.weighs, importance.leaves_out],
        "cameras": [{name: getattr(view.camera, name) for name in _LENS} for view in views]}
    arrays: dict[str, NDArray[Any]] = {
        "said": np.frombuffer(json.dumps(said).encode(), np.uint8).copy()}
    with tempfile.TemporaryDirectory() as folder:
        save_state(Path(folder) / _STATE, fit.state)
        arrays["state"] = np.fromfile(Path(folder) / _STATE, np.uint8)
    for i, view in enumerate(views):
        arrays[f"viewmat.{i}"] = view.camera.viewmat
        arrays[f"image.{i}"] = view.image
        if view.mask is not None:
            arrays[f"mask.{i}"] = view.mask
    return arrays


def unpack_fit(arrays: dict[str, NDArray[Any]], ranks: ProcessGroup) -> Fit:
    """Returns the fit that `packed` took apart, for the process that `ranks` is."""
    said = parse_json(arrays["said"].tobytes(), finite=False)
    if said["cameras"]:
        ranks.views = [
            TrainView(Camera(**lens, viewmat=arrays[f"viewmat.{i}"]), arrays[f"image.{i}"],
                      arrays.get(f"mask.{i}"))
            for i, lens in enumerate(said["cameras"])]
    config = RunConfig(**said["config"])
    schedule = make_schedule(config, said["continues_at"])
    if said["recovery"]:
        first, until = said["recovery"]
        schedule = RecoverySchedule(config, first=first, until=until)
    task = Task(
        list(ranks.views), [], schedule, said["extent"], said["backend"],
        torch.device(said["device"]), nearness=said["nearness"], ranks=ranks)
    with tempfile.TemporaryDirectory() as folder:
        arrays["state"].tofile(Path(folder) / _STATE)
        state = restore_state(Path(folder) / _STATE, task)
    importance = None
    if said["scores"]:
        importance = Importance.zeros(len(state.splats), task.device)
        importance.weighs, importance.leaves_out = said["scores"]
    return Fit(state, task, importance, said["threads"])


def send_arrays(arrays: dict[str, NDArray[Any]], ranks: ProcessGroup) -> None:
    """Sends arrays to all other processes, which call `receive_arrays`."""
    listed = [[name, str(array.dtype), array.shape] for name, array in arrays.items()]
    names = np.frombuffer(json.dumps(listed).encode(), np.uint8).copy()
    ranks.broadcast_int(len(names))
    for array in (names, *arrays.values()):
        ranks.broadcast(torch.from_numpy(np.ascontiguousarray(array)))


def receive_arrays(ranks: ProcessGroup) -> dict[str, NDArray[Any]]:
    """Returns the arrays that the leader sends."""
    names = np.zeros(ranks.broadcast_int(0), np.uint8)
    ranks.broadcast(torch.from_numpy(names))
    arrays = {name: np.zeros(shape, dtype) for name, dtype, shape in parse_json(names.tobytes())}
    for array in arrays.values():
        ranks.broadcast(torch.from_numpy(array))
    return arrays
