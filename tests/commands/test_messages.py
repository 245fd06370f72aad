"""Messages during a progress bar stand on a line of their own."""

import os
import pty
import re
import subprocess
import sys
import termios

import pytest

SAYS = """
import logging
from recon_cli.commands import console
from recon_cli.progress import TqdmProgress
with console.show_log(console.Style()), TqdmProgress().bar("train", 10) as bar:
    bar.advance(3)
    logging.getLogger("recon").warning("a frame is dark")
    bar.advance(7)
"""


def shown(*, terminal):
    """The lines of stderr, each as a terminal would show it in the end."""
    reader, writer = pty.openpty() if terminal else os.pipe()
    if terminal:
        termios.tcsetwinsize(writer, (24, 80))
    subprocess.run([sys.executable, "-c", SAYS], stderr=writer, check=True)
    os.close(writer)
    parts = []
    try:
        while part := os.read(reader, 4096):
            parts.append(part)
    except OSError:  # how a terminal says that nobody writes any more
        pass
    os.close(reader)
    lines = b"".join(parts).decode().replace("\r\n", "\n").split("\n")
    return [line.rstrip().rsplit("\r", 1)[-1] for line in lines]


@pytest.mark.integration
def test_a_message_takes_the_bars_place_on_a_terminal_and_the_bar_goes_on_below():
    lines = shown(terminal=True)
    place = lines.index("notice: a frame is dark")
    assert "10/10" in lines[place + 1]


@pytest.mark.integration
def test_without_a_terminal_nothing_is_drawn_over():
    text = "\n".join(shown(terminal=False))
    assert re.search(r"^[-\d]{10} [:\d]{8} notice: a frame is dark$", text, re.MULTILINE)
    assert re.search(r"^[-\d]{10} [:\d]{8} train 0/10 \(0%\)$", text, re.MULTILINE)
