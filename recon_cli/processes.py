"""Processes of Python that recon starts: of its own code alone, never of files beside the data.

`python -m` and `python -c` look for modules in the current folder first, which is often one with
data of others: a numpy.py there would be run. Nothing else in the package starts a program.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import IO

SAFE_PATH = "PYTHONSAFEPATH"
CHILD = "RECON_JOB"  # environment variable of a command that ends with the one that started it
# Variables that a child keeps; those of options are the parent's, which types what a child needs.
_KEPT = ("RECON_IN_USE", "RECON_CACHE_DIR", "RECON_GPU", "RECON_RUN_BY_RAY", "RECON_WORKSPACE")
# Of Windows, where a session is a group of processes; elsewhere the flag is 0.
_OWN_GROUP: int = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
_END: int = getattr(signal, "CTRL_BREAK_EVENT", signal.SIGTERM)


def protect_children() -> None:
    """Keeps every process of Python that starts from here on from importing the current folder.

    Libraries start some too, such as the resource tracker of `multiprocessing`.
    """
    os.environ[SAFE_PATH] = "1"


def forget_options() -> None:
    """Removes the environment variables that stand for options, RECON_TRAIN_ITERATIONS and so."""
    for name in [name for name in os.environ if name.startswith("RECON_")]:
        if name not in _KEPT:
            del os.environ[name]


def python_command(*arguments: str) -> list[str]:
    """Returns the command line of this Python without the current folder on its path."""
    return [sys.executable, "-P", *arguments]


def child_environment(**more: str) -> dict[str, str]:
    """Returns the environment of a child; its own children are protected as well.

    An empty entry of PYTHONPATH is the current folder, and a relative one would be looked for in
    that of the child.
    """
    environment = {**os.environ, **more, SAFE_PATH: "1"}
    paths = [str(Path(entry).absolute())
             for entry in environment.pop("PYTHONPATH", "").split(os.pathsep) if entry]
    return {**environment, "PYTHONPATH": os.pathsep.join(paths)} if paths else environment


def start_module(
    module: str, *arguments: str, folder: Path, out: int | IO[bytes], errors: int | IO[bytes],
    session: bool = False, **environment: str,
) -> subprocess.Popen[bytes]:
    """Starts `python -m module` in a folder; the end of its standard input is that of its parent.

    With `session` it is in a session of its own, where Ctrl-C in a terminal does not reach it.
    """
    return subprocess.Popen(
        python_command("-m", module, *arguments), cwd=folder, stdin=subprocess.PIPE, stdout=out,
        stderr=errors, start_new_session=session, creationflags=_OWN_GROUP if session else 0,
        env=child_environment(**environment))


def ask_to_end(process: subprocess.Popen[bytes]) -> None:
    """Asks a child with a session of its own to save what it has and end.

    Not by SIGINT, which may be ignored in the background. `terminate` of Windows kills; children
    there understand Ctrl-Break, which needs a console.
    """
    try:
        process.send_signal(_END)
    except ProcessLookupError:  # it has ended
        pass
    except OSError:
        process.terminate()


def end_with_parent() -> None:
    """Ends this process when its standard input does, which is when its parent is gone."""

    def watch() -> None:
        while os.read(0, 1):  # not sys.stdin, whose lock the interpreter wants at its own end
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
