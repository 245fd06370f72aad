"""The program `recon`: minds the signals from its first moment on, then runs the command line."""

from __future__ import annotations

import io
import os
import sys
from typing import Any

from recon_cli import signals
from recon_cli.errors import WorkspaceError
from recon_cli.processes import CHILD, end_with_parent, forget_options, protect_children


class _StandardOutput(io.FileIO):
    """Standard output; what it cannot take is no fault of the disk of the workspace."""

    def write(self, data: Any, /) -> int:
        """Writes bytes; WorkspaceError where they cannot be written, but to a closed pipe.

        What comes later is dropped, for the buffer would try it once more at the end.
        """
        try:
            return super().write(data)
        except OSError as error:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self.fileno())
            os.close(nowhere)
            if isinstance(error, BrokenPipeError):
                raise
            raise WorkspaceError(
                f"Standard output cannot be written: {error.strerror}.",
                hint="Give it a terminal, a program, or a file on a disk with free space; results "
                "are kept in the workspace.") from error


def open_streams() -> None:
    """Opens stdout anew, and what is closed of the standard streams on nothing.

    Else the next file that is opened gets the number of a stream that was closed by `2>&-`, and
    with it all that libraries print.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest free number
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stdout = io.TextIOWrapper(
        io.BufferedWriter(_StandardOutput(1, "w", closefd=False)),
        encoding=sys.stdout.encoding if sys.stdout else "utf-8",
        errors="backslashreplace",  # a file name need not be UTF-8
        line_buffering=os.isatty(1))


def main() -> int:
    """Runs the command line and returns its exit code."""
    with signals.raising(restore=False):
        try:
            if os.environ.pop(CHILD, ""):
                end_with_parent()
                forget_options()
            protect_children()
            open_streams()
            from recon_cli import cli

            code = cli.main()
        except KeyboardInterrupt as error:  # while modules were imported
            sys.stderr.write(f"{signals.describe_end(error)}\n")
            code = signals.exit_code(error)
    return code


if __name__ == "__main__":
    raise SystemExit(main())
