"""Takes from every process of Python what Windows lacks; put its folder on PYTHONPATH.

Handles of folders, flushing what is open for reading, and names that Python has on POSIX alone are
refused. What subprocess itself needs stays, so files remain those of this system.
"""

import mmap
import os
import signal
import sys

_MISSING = {
    os: ("fork", "forkpty", "getuid", "geteuid", "getgid", "getegid", "getpgid", "setsid", "killpg",
         "mkfifo", "chown", "nice", "getloadavg", "sched_getscheduler", "sched_getparam",
         "sched_setscheduler", "sched_getaffinity", "sched_setaffinity"),
    signal: ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGALRM", "SIGPIPE", "SIGQUIT", "alarm", "setitimer",
             "pthread_sigmask", "pthread_kill"),
    mmap: ("MADV_DONTNEED",),
}
_WRITABLE = os.O_WRONLY | os.O_RDWR
_fsync, _open, _link = os.fsync, os.open, os.link


def _own(depth: int = 2) -> bool:
    """Whether the call is from recon's code; the standard library's POSIX branches stay as is."""
    return str(sys._getframe(depth).f_globals.get("__name__", "")).startswith("recon_cli")


def fsync(file) -> None:
    """Flushes only what is open for writing."""
    import fcntl

    number = file if isinstance(file, int) else file.fileno()
    if not fcntl.fcntl(number, fcntl.F_GETFL) & _WRITABLE:
        raise OSError(9, "Bad file descriptor")
    _fsync(number)


def open_file(path, flags, *rest, **more) -> int:
    """Opens files; recon gets no handle of a folder."""
    if _own() and not isinstance(path, int) and os.path.isdir(path):
        raise PermissionError(13, "Permission denied", str(path))
    return _open(path, flags, *rest, **more)


def link(*arguments, **more) -> None:
    """Makes hard links of all but symbolic links."""
    if more.pop("follow_symlinks", True) is False:
        raise NotImplementedError("follow_symlinks unavailable on this platform")
    _link(*arguments, **more)


for _module, _names in _MISSING.items():
    for _name in _names:
        if hasattr(_module, _name):
            delattr(_module, _name)
os.fsync, os.open, os.link = fsync, open_file, link


class _SetOnImport:
    """Has `recon_cli.workspace.durable` take this system for Windows."""

    def find_spec(self, name, _path=None, _target=None):
        if name != "recon_cli.workspace.durable":
            return None
        sys.meta_path.remove(self)
        from importlib.util import find_spec

        spec = find_spec(name)
        execute = spec.loader.exec_module

        def exec_module(module):
            execute(module)
            module.ON_WINDOWS = True

        spec.loader.exec_module = exec_module
        return spec


sys.meta_path.insert(0, _SetOnImport())
