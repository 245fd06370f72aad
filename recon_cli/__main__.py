"""The program `recon`: minds the signals from its first moment on, then runs the command line."""

from __future__ import annotations

import io
import os
import sys

from recon_cli import signals
from recon_cli.processes import CHILD, end_with_parent, forget_options, protect_children


def main() -> int:
    """Runs the command line and returns its exit code."""
    with signals.raising(restore=False):
        try:
            if os.environ.pop(CHILD, ""):
                end_with_parent()
                forget_options()
            protect_children()
            if isinstance(sys.stdout, io.TextIOWrapper):  # a file name need not be UTF-8
                sys.stdout.reconfigure(errors="backslashreplace")
            from recon_cli import cli

            code = cli.main()
        except KeyboardInterrupt as error:  # while modules were imported
            sys.stderr.write(f"{signals.describe_end(error)}\n")
            code = signals.exit_code(error)
    return code


if __name__ == "__main__":
    raise SystemExit(main())
