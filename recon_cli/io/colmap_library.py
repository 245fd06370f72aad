"""pycolmap, which everything here imports from: its own import takes over SIGTERM.

The logging library in it then prints thirty lines of C++ stack where a command is asked to end.
"""

from recon_cli.signals import keeping_handlers

with keeping_handlers():
    import pycolmap

__all__ = ["pycolmap"]
