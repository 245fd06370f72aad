"""How every kernel is compiled, and where the machine code is kept.

Compiling takes seconds, so the machine code is kept in the user's cache folder. numba stores it by
pickle, which executes code from the file: the folder must belong to the user alone. Each file
begins with its digest: a bit that a disk turned would end every command by a signal. Its name holds
a digest of the CPU, the versions and all sources of kernels/ and render/numba (numba checks only
the file that a kernel stands in, not inlined functions), so that other code is never loaded. Where
and when the sources were installed counts too: numba compiles again for another place or time.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import platform
import stat
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
from numba.core import config
from numba.core.caching import IndexDataCacheFile

from recon_cli import machine

logger = logging.getLogger("recon")
_DIGEST_BYTES = hashlib.sha256().digest_size
_OPTIONS = {"nogil": True, "error_model": "numpy", "boundscheck": False, "no_cfunc_wrapper": True}
Compiled = Callable[..., Any]
CODE = ".nbc"  # end of the name of a file of machine code
READY = "ready"  # file in the cache folder once every kernel is there
_SCIPY = "scipy.linalg"
unsaved: list[OSError] = []  # why kernels were not kept


def kernel(function: Compiled) -> Compiled:
    """Compiles a function that runs without the GIL and is called from Python; kept on disk."""
    dispatcher = numba.njit(**_OPTIONS)(function)
    folder = cache_folder()
    if folder:
        before, config.CACHE_DIR = config.CACHE_DIR, str(folder)
        try:
            dispatcher.enable_caching()
        finally:
            config.CACHE_DIR = before
        cache = dispatcher._cache
        cache._cache_file = _CheckedFiles(
            cache._cache_path, cache._impl.filename_base, cache._impl.locator.get_source_stamp())
        cache.save_overload = partial(_save, cache.save_overload)
    return dispatcher  # type: ignore[no-any-return]


class _CheckedFiles(IndexDataCacheFile):  # type: ignore[misc]
    """The machine code of a kernel: a file a signature, named by it, that begins with its digest.

    numba's own files have none, and an index that two processes may write at once.
    """

    def save(self, key: Any, data: Any) -> None:
        """Writes machine code, whole or not at all."""
        code = self._dump(data)
        with self._open_for_write(str(self._path(key))) as file:
            file.write(self._digest(key, code) + code)

    def load(self, key: Any) -> Any:
        """Returns machine code; None where there is none, or it is damaged."""
        path = self._path(key)
        try:
            found = path.read_bytes()
        except OSError:
            return None
        digest, code = found[:_DIGEST_BYTES], found[_DIGEST_BYTES:]
        if self._digest(key, code) != digest:
            logger.warning("the compiled kernel %s is damaged; compiling it again", path)
            return None
        return pickle.loads(code)

    def _digest(self, key: Any, code: bytes = b"") -> bytes:
        """Returns the digest of a signature and its machine code: that of another one is damage."""
        return hashlib.sha256(repr((key, self._source_stamp)).encode() + b"\0" + code).digest()

    def _path(self, key: Any) -> Path:
        name = f"{Path(self._index_name).stem}.{self._digest(key).hex()[:16]}{CODE}"
        return Path(self._cache_path) / name


def _save(save: Callable[..., None], signature: Any, machine_code: Any) -> None:
    """Keeps machine code where there is room for it; without, it serves this run alone."""
    try:
        save(signature, machine_code)
    except OSError as error:
        if not unsaved:
            logger.warning(
                "compiled kernels cannot be kept (%s); they are compiled in every run. Free some "
                "space, or set RECON_CACHE_DIR to a folder on another disk.", error)
        unsaved.append(error)


def inlined(function: Compiled) -> Compiled:
    """Compiles a function into every kernel that calls it."""
    return numba.njit(  # type: ignore[no-any-return]
        **_OPTIONS, forceinline=True, no_cpython_wrapper=True)(function)


@cache
def cache_folder() -> Path | None:
    """Returns the folder of the machine code; None if none can be written."""
    folder = machine.cache_root() / "kernels" / fingerprint()
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        probe = folder / f".probe-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        logger.warning(
            "compiled kernels cannot be kept (%s); they are compiled in every run. Set "
            "RECON_CACHE_DIR to a folder that can be written.", error)
        return None
    if not _ours_alone(folder):
        logger.warning(
            "%s can be written by others and is not used; kernels are compiled in every run. Set "
            "RECON_CACHE_DIR to a folder of your own.", folder)
        return None
    return folder


def is_warm() -> bool:
    """Tells whether machine code for this CPU is there."""
    folder = cache_folder()
    return folder is not None and (folder / READY).exists()


@contextmanager
def without_scipy() -> Iterator[None]:
    """Keeps numba from importing scipy.linalg, slowly, for a BLAS that no kernel needs."""
    if _SCIPY in sys.modules:
        yield
        return
    sys.modules[_SCIPY] = None  # type: ignore[assignment]  # an import of it fails at once
    try:
        yield
    finally:
        del sys.modules[_SCIPY]


def fingerprint() -> str:
    """Returns a digest of all that machine code depends on."""
    digest = hashlib.sha256()
    features = config.CPU_FEATURES
    if features is None:
        features = llvm.get_host_cpu_features().flatten()
    for text in (platform.machine(), config.CPU_NAME or llvm.get_host_cpu_name(), features,
                 sys.version, numba.__version__, llvmlite.__version__):
        digest.update(text.encode() + b"\0")
    package = Path(__file__).parents[1]
    for path in sorted([*package.glob("kernels/*.py"), *package.glob("render/numba/*.py"),
                        package / "render" / "contract.py"]):
        digest.update(f"{path}\0{path.stat().st_mtime_ns}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _ours_alone(folder: Path) -> bool:
    if not hasattr(os, "getuid"):  # Windows keeps the folder inside the user's profile
        return True
    status = folder.stat()
    return status.st_uid == os.getuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
