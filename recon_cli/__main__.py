"""Runs the command line as `python -m recon_cli`."""

from recon_cli.cli import main

raise SystemExit(main())
