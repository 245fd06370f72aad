"""The machine that a stage runs on: threads, memory, the packages' versions, the cache folder."""

from __future__ import annotations

import errno
import importlib.metadata
import importlib.util
import os
import platform
import re
import shlex
import sys
import threading
import time
from functools import cache
from pathlib import Path
from types import TracebackType

import psutil

from recon_cli import __version__, cgroups
from recon_cli.errors import ConfigError, ReconError, ReconstructionError, causes

DISTRIBUTION = "recon-gs"  # `recon-cli` on PyPI is somebody else's, with a command `recon` too
_PACKAGES = {
    "torch": "torch",
    "pycolmap": "pycolmap",
    "opencv": "opencv-contrib-python-headless",
    "numba": "numba",
    "numpy": "numpy",
    "av": "av",
    "rawpy": "rawpy",
    "scikit-image": "scikit-image",
}
# What numpy, OpenCV and torch map when they are imported, and OpenBLAS for each thread: where that
# is refused, it ends the process by itself, without an exception.
_LIBRARIES_BYTES, _BLAS_BYTES = 512 << 20, 32 << 20
_MEMORY_WORDS = (
    os.strerror(errno.ENOMEM), "failed to map segment", "can't start new thread",
    "can't allocate memory", "out of memory", "bad_alloc", "bad allocation")
_CPUINFO = Path("/proc/cpuinfo")
_LOW_PRIORITY = 5  # of POSIX: a third of the share of others; more, and who waits for it waits long
POLL_SECONDS = 0.25  # between two looks at what another process or native code has done
_SAMPLE_SECONDS = 2 * POLL_SECONDS  # a sample of all children takes about 5 ms


def versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that a result depends on."""
    return {"python": platform.python_version(), "recon": __version__,
            **{name: _version(package) for name, package in _PACKAGES.items()}}


@cache  # all take 12 ms, and a process runs several stages
def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"


def install_command(extra: str) -> str:
    """Returns the command that adds an extra of pyproject.toml to the environment of this process.

    In a clone that is the clone with the extra. A wheel may lie anywhere by now, so elsewhere the
    command names the packages of the extra.
    """
    clone = Path(__file__).parents[1]
    if (clone / "pyproject.toml").is_file():
        wanted = ["-e", f"{_relative(clone)}[{extra}]"]
    else:
        wanted = _requirements(extra)
    words = [*_installer(), *wanted]
    return shlex.join(words)


def _requirements(extra: str) -> list[str]:
    """Returns what an extra adds, as its wheel says."""
    marker = re.compile(rf"""extra\s*==\s*['"]{re.escape(extra)}['"]""")
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        lines = []
    return [line.partition(";")[0].strip() for line in lines if marker.search(line)] or [extra]


def _installer() -> list[str]:
    """Returns the words that install packages into this environment."""
    prefix, python = Path(sys.prefix), Path(sys.executable)
    if (prefix / "pipx_metadata.json").is_file():
        return ["pipx", "inject", DISTRIBUTION]
    if importlib.util.find_spec("pip") is None:  # uv makes environments without it
        return ["uv", "pip", "install", "--python", str(python)]
    pip = python.with_name("pip.exe" if sys.platform == "win32" else "pip")
    if pip.is_file():
        return [_relative(pip), "install"]
    return [str(python), "-m", "pip", "install"]


def _relative(path: Path) -> str:
    """Returns a path as one types it here: short where it lies below the current folder."""
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, OSError):  # elsewhere; or the current folder is gone
        return str(path)


def usable_threads() -> int:
    """Returns how many CPU cores this process may use."""
    process = psutil.Process()
    if hasattr(process, "cpu_affinity"):  # macOS has none
        cores = len(process.cpu_affinity())
    else:
        cores = psutil.cpu_count() or 1
    return min(cores, cgroups.most_cpus() or cores)


def free_memory_bytes() -> int:
    """Returns how much memory this process may still take, the limits of its groups included."""
    free, left = int(psutil.virtual_memory().available), cgroups.free_memory_bytes()
    return free if left is None else min(free, left)


def _address_limit_bytes() -> int | None:
    """Returns how much memory this process may map (`ulimit -v`); None without a limit."""
    if not hasattr(psutil, "RLIMIT_AS"):  # other systems than Linux have or obey none
        return None
    limit = psutil.Process().rlimit(psutil.RLIMIT_AS)[0]
    return None if limit == psutil.RLIM_INFINITY else limit


def refuse_low_limit() -> None:
    """Raises ReconstructionError where this process may not map what the libraries need."""
    limit = _address_limit_bytes()
    least = _LIBRARIES_BYTES + _BLAS_BYTES * usable_threads()
    if limit is not None and limit < least:
        raise _memory_error(f"{least >> 20} MB of address space are needed at least")


def explain_memory(error: BaseException) -> ReconError | None:
    """Returns the error for a want of memory or threads, whoever met it; None for any other.

    Where most of the address space is taken, a library that cannot be loaded may not say why.
    """
    for each in causes(error):
        if isinstance(each, MemoryError) or any(word in str(each) for word in _MEMORY_WORDS):
            return _memory_error(str(each) or "none is free")
    limit = _address_limit_bytes()
    if limit is not None and isinstance(error, (ImportError, OSError, RuntimeError)) and (
            psutil.Process().memory_info().vms > limit / 2):
        return _memory_error(str(error))
    return None


def _memory_error(reason: str) -> ReconError:
    limit = _address_limit_bytes()
    return ReconstructionError(
        f"There is not enough memory: {reason.splitlines()[0].rstrip('.')}.",
        hint="Close other programs, or lower --max-gaussians, --max-size or --frames." if (
            limit is None) else
        f"This shell allows a process {limit >> 20} MB of address space: raise `ulimit -v`.")


def cpu_model(cpuinfo: Path = _CPUINFO) -> str:
    """Returns the CPU's model name from Linux's /proc/cpuinfo, or from Python elsewhere."""
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


def cache_root() -> Path:
    """Returns the folder of recon's caches: RECON_CACHE_DIR, or the platform's.

    ConfigError for a user without a home, as containers and services have: a folder that anybody
    can write is no place for code.
    """
    folder = os.environ.get("RECON_CACHE_DIR")
    if folder:
        return Path(folder)
    if os.path.expanduser("~") == "~" and not os.environ.get("XDG_CACHE_HOME"):
        raise ConfigError(
            "There is no place for compiled kernels: HOME is not set, and the system does not know "
            "this user.", hint="Set HOME, or RECON_CACHE_DIR, to a folder that only you can write.")
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "recon"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", str(Path.home()))) / "recon" / "cache"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "recon"


def yield_to_others() -> None:
    """Lowers the priority of this process, so that it uses idle cores only."""
    process = psutil.Process()
    process.nice(psutil.BELOW_NORMAL_PRIORITY_CLASS if sys.platform == "win32" else _LOW_PRIORITY)


class Meter:
    """Measures the time and the peak memory in bytes of a block of work.

    Memory is the resident set of this process and its children, sampled twice a second.
    """

    def __init__(self) -> None:
        self.peak_memory_bytes = 0
        self._start = time.monotonic()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    @property
    def seconds(self) -> float:
        """Seconds since the block was entered."""
        return time.monotonic() - self._start

    def __enter__(self) -> Meter:
        self._start = time.monotonic()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._done.set()
        self._thread.join()
        self._sample()

    def _watch(self) -> None:
        while not self._done.wait(_SAMPLE_SECONDS):
            self._sample()

    def _sample(self) -> None:
        process, total = psutil.Process(), 0
        for each in [process, *process.children(recursive=True)]:
            try:
                total += each.memory_info().rss
            except psutil.Error:  # it ended meanwhile
                continue
        self.peak_memory_bytes = max(self.peak_memory_bytes, total)
