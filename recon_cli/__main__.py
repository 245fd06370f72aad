"""Runs the command line as `python -m recon_cli`."""

import os

from recon_cli.cli import main
from recon_cli.executors.executor import CHILD
from recon_cli.machine import end_with_parent

if os.environ.pop(CHILD, ""):
    end_with_parent()
raise SystemExit(main())
