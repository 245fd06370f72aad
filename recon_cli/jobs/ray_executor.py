"""Runs recon commands on a Ray cluster: that of RAY_ADDRESS, or one on this machine for the run.

Only words and paths travel. Every machine has recon installed and sees the same folders, which is
checked at the start. A command whose machine is lost runs again on another one and resumes.
"""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
import threading
import uuid
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

try:
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ImportError:  # `connect` says so
    ray = None

from recon_cli import __version__
from recon_cli.errors import BackendError, ExitCode, ReconError, WorkspaceError, list_names
from recon_cli.jobs.executor import CORES, PATIENCE_SECONDS, TRIES, Command, RunningCommand
from recon_cli.machine import install_command
from recon_cli.signals import keeping_handlers
from recon_cli.workspace.atomic import write_bytes

_STORE_BYTES = 100 << 20  # of objects that travel; ours are words
_HEAD_SECONDS = 2.0  # between two looks at the head
_HEAD_TRIES = 5  # looks in a row that find no head, before it is given up
_INSIDE = "RECON_RUN_BY_RAY"  # environment variable of what Ray runs


class RayExecutor:
    """Runs commands wherever a cluster has `cores` CPUs (and `gpus` GPUs) free."""

    def __init__(self, *, cores: int, gpus: int, slots: int) -> None:
        self.slots, self.cores = slots, cores
        self._needs = {"num_cpus": cores, "num_gpus": gpus}
        self._running: set[Any] = set()
        self._lock = threading.Lock()
        self._stopped = False
        self._head_lost = threading.Event()
        threading.Thread(target=self._watch_head, daemon=True).start()

    @staticmethod
    def connect(
        *, cores: int | None, gpu: bool | None, slots: int | None, folder: Path,
        inputs: Sequence[Path],
    ) -> RayExecutor:
        """Connects to a cluster and checks each machine; None: as many as suit the cluster.

        Raises:
            BackendError: Ray is missing or runs this very command, no cluster was found, a machine
                lacks recon or has another version, or none has what a command needs.
            WorkspaceError: a machine does not see `folder` or one of `inputs`.
        """
        if ray is None:
            raise BackendError(
                "Ray is not installed.", hint=f"Run `{install_command('ray')}`.")
        if os.environ.get(_INSIDE):  # it would wait for CPUs that whoever waits for it holds
            raise BackendError(
                "A command that Ray runs cannot share out its work on Ray again.",
                hint="Give --on local, or leave `on` out of recon.toml and --set.")
        address = os.environ.get("RAY_ADDRESS")
        own = {} if address else {"include_dashboard": False, "object_store_memory": _STORE_BYTES}
        try:
            with keeping_handlers(), _in_empty_folder():
                ray.init(address=address, log_to_driver=False, logging_level="ERROR", **own)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise BackendError(
                f"No Ray cluster answers at {address or 'this machine'}: {error}",
                hint="Start one by `ray start --head`, set RAY_ADDRESS to its address, or unset "
                     "it.") from error
        nodes = [node for node in ray.nodes() if node["Alive"]]
        with _shut_down_on_failure():
            _check_nodes(nodes, folder, inputs)
            cores, gpus = _choose_resources(nodes, cores, gpu)
            total = int(sum(node["Resources"].get("CPU", 0) for node in nodes))
            return RayExecutor(
                cores=cores, gpus=gpus, slots=slots or max(1, total // cores))

    def run(self, command: Command) -> int:
        """Runs a command until it ends and returns its exit code; see `Executor`."""
        words = list(command.words), str(command.workspace), str(command.log)
        with self._lock:
            if self._stopped:
                return ExitCode.INTERRUPTED
            reference = ray.remote(max_retries=TRIES - 1, max_calls=1, **self._needs)(
                _run_command).remote(*words)
            self._running.add(reference)
        try:
            return self._wait(reference)
        finally:
            with self._lock:
                self._running.discard(reference)

    def _wait(self, reference: Any) -> int:
        while not self._head_lost.is_set():
            ready, _ = ray.wait([reference], timeout=1.0)
            if ready:
                try:
                    return int(ray.get(reference))
                except ray.exceptions.TaskCancelledError:
                    return ExitCode.INTERRUPTED
                except ray.exceptions.RayError:
                    if self._stopped:
                        return ExitCode.INTERRUPTED
                    return ExitCode.KILLED  # no process is left to tell a code
        raise BackendError(
            "The head of the Ray cluster is lost.",
            hint="Start the cluster again and repeat the same command: finished work is kept.")

    def stop(self) -> None:
        """Interrupts the commands; see `Executor`."""
        with self._lock:
            self._stopped = True
            for reference in self._running:
                ray.cancel(reference, force=False)

    def close(self) -> None:
        """Leaves the cluster; one that was started for the run ends."""
        ray.shutdown()

    def _watch_head(self) -> None:
        """Notices that the head is gone: Ray itself waits a minute and then ends the process."""
        host, port = ray.get_runtime_context().gcs_address.rsplit(":", 1)
        misses = 0
        while misses < _HEAD_TRIES:
            try:
                socket.create_connection((host, int(port)), timeout=_HEAD_SECONDS).close()
                misses = 0
            except OSError:
                misses += 1
            threading.Event().wait(_HEAD_SECONDS)
        self._head_lost.set()


@contextlib.contextmanager
def _in_empty_folder() -> Iterator[None]:
    """Changes to an empty folder: Ray's workers import modules from that of `ray.init` first."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory(prefix="recon-ray-") as folder:
        os.chdir(folder)
        try:
            yield
        finally:
            os.chdir(before)


@contextlib.contextmanager
def _shut_down_on_failure() -> Any:
    try:
        yield
    except ReconError:
        ray.shutdown()
        raise


def _run_command(words: list[str], workspace: str, log: str) -> int:
    """Runs a command on the machine that Ray chose; Ray interrupts it as Ctrl-C does."""
    os.environ[_INSIDE] = "1"
    running = RunningCommand(Command(tuple(words), Path(workspace), Path(log)))
    thread_code: list[int] = []
    thread = threading.Thread(target=lambda: thread_code.append(running.wait()))
    thread.start()
    try:
        while thread.is_alive():
            thread.join(1.0)
    except KeyboardInterrupt:
        running.interrupt()
        thread.join()
        raise
    return thread_code[0]


def _probe(folder: str, name: str, token: str, inputs: list[str]) -> dict[str, Any]:
    """Returns the resources and files that a machine has."""
    path = Path(folder) / name
    try:
        sees = path.read_text(encoding="utf-8") == token
        path.with_name(f"{name}-{uuid.uuid4().hex}").write_text(token, encoding="utf-8")
    except OSError:
        sees = False
    return {"version": __version__, "sees": sees,
            "missing": [path for path in inputs if not Path(path).exists()]}


def _check_nodes(nodes: Sequence[dict[str, Any]], folder: Path, inputs: Sequence[Path]) -> None:
    """Raises BackendError or WorkspaceError where a machine cannot run a command."""
    token, name = uuid.uuid4().hex, ".batch-probe"
    probe = folder / name
    write_bytes(probe, token.encode())
    try:
        present = [str(path) for path in inputs if path.exists()]
        places = [NodeAffinitySchedulingStrategy(node["NodeID"], soft=False) for node in nodes]
        answers = [
            ray.remote(num_cpus=0, max_retries=0, scheduling_strategy=place)(_probe).remote(
                str(folder), name, token, present) for place in places]
        for node, answer in zip(nodes, answers, strict=True):
            _check_node(node["NodeManagerAddress"], answer, folder)
    finally:
        for path in folder.glob(f"{name}*"):
            path.unlink(missing_ok=True)


def _check_node(address: str, answer: Any, folder: Path) -> None:
    install = (f"Install recon {__version__} with its extra `ray` there, from the clone or wheel "
               "that this machine has, in the environment in which `ray start` was typed.")
    try:
        found = ray.get(answer, timeout=PATIENCE_SECONDS)
    except ray.exceptions.RayError as error:
        if "recon_cli" in str(error):  # a module that the machine could not import
            raise BackendError(
                f"The machine {address} of the Ray cluster has no recon, or an older one.",
                hint=install) from error
        raise BackendError(
            f"The machine {address} of the Ray cluster does not answer: "
            f"{str(error).strip().splitlines()[-1]}",
            hint="Take it out of the cluster by `ray stop` there.") from error
    if found["version"] != __version__:
        raise BackendError(
            f"The machine {address} of the Ray cluster has recon {found['version']}, this one has "
            f"{__version__}.", hint=install)
    if not found["sees"]:
        raise WorkspaceError(
            f"The machine {address} of the Ray cluster does not see {folder}, or cannot write it.",
            hint="Work in a folder that all machines see under the same path (-w, --out).")
    if found["missing"]:
        raise WorkspaceError(
            f"The machine {address} of the Ray cluster does not see "
            f"{list_names(found['missing'])}.",
            hint="Put the inputs where all machines see them under the same path.")


def _choose_resources(
    nodes: Sequence[dict[str, Any]], cores: int | None, gpu: bool | None
) -> tuple[int, int]:
    """Returns the CPUs and GPUs of a command; BackendError where no machine has them."""
    cpus = [int(node["Resources"].get("CPU", 0)) for node in nodes]
    gpus = [int(node["Resources"].get("GPU", 0)) for node in nodes]
    if gpu is None:
        gpu = any(gpus)
    with_gpu = [cpu for cpu, number in zip(cpus, gpus, strict=True) if number >= int(gpu)]
    most = max(with_gpu, default=0)
    if gpu and not with_gpu:
        raise BackendError(
            f"None of the {len(nodes)} machines of the Ray cluster has a GPU, as --device cuda "
            "needs.", hint="Leave out --device, or start the machines with `ray start --num-gpus`.")
    if most < (cores or 1):
        raise BackendError(
            f"No machine of the Ray cluster has {cores or 1} CPUs; the largest has {most}.",
            hint="Give fewer --threads.")
    return cores or min(CORES, most), int(gpu)
