"""What was asked of `recon bench`, before anything is measured."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from recon_cli.errors import ConfigError, InputError

_ROUNDS, _QUICK_ROUNDS = 7, 2


@dataclass(frozen=True)
class Request:
    """The options of the verb.

    Attributes:
        scene: "room" or "small".
        gaussians: instead of the scene's own number.
        size: "WxH" in pixels, instead of the scene's own.
        sh_degree: 0 to 3.
        backends: by name; empty for all that run on the device.
        device: "auto", "cpu" or "cuda".
        threads: CPU threads; None for all cores.
        rounds: behind each median; None for the usual number.
        quick: a tiny scene and few rounds.
        json_file: where all figures go.
        plot: where the picture goes.
        markdown: the page that the tables go into.
        compare: the figures of an earlier run.

    Raises:
        ConfigError: the size is none.
        InputError: the folder of an output does not exist.
    """

    scene: str
    gaussians: int | None
    size: str | None
    sh_degree: int
    backends: tuple[str, ...]
    device: str
    threads: int | None
    rounds: int | None
    quick: bool
    json_file: Path | None = None
    plot: Path | None = None
    markdown: Path | None = None
    compare: Path | None = None

    def __post_init__(self) -> None:
        if self.size is not None:
            pixels(self.size)
        refuse_missing_folders(self.json_file, self.plot)

    @property
    def count(self) -> int:
        """Rounds behind each median."""
        return self.rounds or (_QUICK_ROUNDS if self.quick else _ROUNDS)


def refuse_missing_folders(*files: Path | None) -> None:
    """Raises InputError where the folder of a file to write does not exist."""
    for path in files:
        if path is not None and not path.absolute().parent.is_dir():
            raise InputError(
                f"The folder of {path} does not exist.", hint=f"mkdir -p {path.parent}")


def pixels(size: str) -> tuple[int, int]:
    """Returns width and height of "640x360".

    Raises:
        ConfigError: the text has another form, or a side is shorter than a pixel.
    """
    found = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", size)
    if not found:
        raise ConfigError(
            f"--size is {size!r}, but it must be WIDTHxHEIGHT in pixels.",
            hint="Try --size 640x360.")
    return int(found[1]), int(found[2])
