"""How the leader hands a fit to the other processes: JSON for what is said, plain bytes for arrays.

The state travels as the checkpoint that it would be saved as, so that whoever takes it goes on as
one who resumes: with the very same bits.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.config.stages import RunConfig
from recon_cli.context import ProcessGroup
from recon_cli.scene.camera import Camera
from recon_cli.scene.train_view import TrainView
from recon_cli.train.importance import Importance
from recon_cli.train.initialize import saved_state
from recon_cli.train.schedule import RecoverySchedule, Schedule
from recon_cli.train.state import TrainState, save_state
from recon_cli.train.task import Task

_LENS = ("width", "height", "fx", "fy", "cx", "cy")
_STATE = "state.safetensors"


@dataclass(frozen=True, eq=False)
class Fit:
    """What a process needs to take part in a fit.

    Attributes:
        state: to begin with.
        task: views and plan; the validation views and the jump are the leader's alone.
        importance: where scores are gathered, None where they are not.
        threads: of the CPU.
    """

    state: TrainState
    task: Task
    importance: Importance | None
    threads: int


def pack_fit(fit: Fit) -> dict[str, NDArray[Any]]:
    """Returns arrays that say all about a fit; the first one is JSON.

    Views that all processes hold already are left out.

    Raises:
        TrainingError: a parameter is not finite.
        OSError: there is no room for the state in the folder of temporary files.
    """
    task, schedule, importance = fit.task, fit.task.schedule, fit.importance
    assert schedule.recipe == Schedule(schedule.config).recipe, "only trials have one of their own"
    views = () if task.ranks.views is task.train else task.train
    recovery = [schedule.first, schedule.until] if isinstance(schedule, RecoverySchedule) else None
    said = {
        "config": dataclasses.asdict(schedule.config), "recovery": recovery,
        "extent": task.extent, "backend": task.backend, "device": task.device.type,
        "camera_error": task.camera_error, "threads": fit.threads,
        "scores": importance and [importance.weighs, importance.leaves_out],
        "cameras": [{name: getattr(view.camera, name) for name in _LENS} for view in views],
    }
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
    said = json.loads(arrays["said"].tobytes())
    if said["cameras"]:
        ranks.views = [
            TrainView(Camera(**lens, viewmat=arrays[f"viewmat.{i}"]), arrays[f"image.{i}"],
                      arrays.get(f"mask.{i}"))
            for i, lens in enumerate(said["cameras"])]
    config = RunConfig(**said["config"])
    schedule = Schedule(config)
    if said["recovery"]:
        first, until = said["recovery"]
        schedule = RecoverySchedule(config, first=first, until=until)
    task = Task(
        list(ranks.views), [], schedule, said["extent"], said["backend"],
        torch.device(said["device"]), camera_error=said["camera_error"], ranks=ranks)
    with tempfile.TemporaryDirectory() as folder:
        arrays["state"].tofile(Path(folder) / _STATE)
        state = saved_state(Path(folder) / _STATE, task)
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
    arrays = {
        name: np.zeros(shape, dtype) for name, dtype, shape in json.loads(names.tobytes())}
    for array in arrays.values():
        ranks.broadcast(torch.from_numpy(array))
    return arrays
