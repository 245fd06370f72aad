"""How the log appears on stderr: plain, with what must not be missed marked as a notice."""

from __future__ import annotations

import logging
from collections.abc import Callable

logger = logging.getLogger("recon")


class _Plain(logging.Formatter):
    """Marks what must not be missed; everything else is told as it is."""

    def format(self, record: logging.LogRecord) -> str:
        """Returns the message, after `notice:` where it is a warning."""
        text = super().format(record)
        return f"notice: {text}" if record.levelno >= logging.WARNING else text


def show_log(*, detailed: Callable[[], bool]) -> logging.Handler:
    """Shows the log on stderr and returns the handler, to be removed at the end.

    Args:
        detailed: whether debug messages are shown too; asked anew for each of them, because the
            log is there before the command line has been read.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(_Plain())
    handler.addFilter(lambda record: record.levelno >= logging.INFO or detailed())
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    return handler
