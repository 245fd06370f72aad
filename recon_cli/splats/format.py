"""The functions of a splat format: every module that a row of the table names has a `FORMAT`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.splats.loaded import LoadedScene

SHARING = 16


@dataclass(frozen=True, eq=False)
class WriteSettings:
    """Facts about a scene that a file can hold, and options; each format takes those it knows."""

    up: NDArray[np.float64] | None = None  # [3] unit vector; None where it is not known
    antialiased: bool = False  # the scene was trained with antialiasing (Mip-Splatting)
    title: str = "scene"
    views: Sequence[tuple[str, Camera]] = ()  # training views by name
    options: Mapping[str, Any] = field(default_factory=dict)  # those that the format's row names
    sharing: int = SHARING  # Gaussians per entry of a palette of colours, on the mean


@dataclass(frozen=True)
class SplatFormat:
    """How files of one format are read and written."""

    load: Callable[[Path], LoadedScene]  # raises FormatError
    # Writes a file, whole or not at all, with the backdrop as Gaussians where the format has no
    # room for one; raises FormatError or InputError if a value does not fit.
    write_with: Callable[[Path, Splats, WriteSettings], None]
    # loads a scene without the turn that the file asks for; None where it cannot ask for any
    load_unturned: Callable[[Path], LoadedScene] | None = None

    def read(self, path: Path) -> Splats:
        """Returns the Gaussians of a file; FormatError if it is damaged."""
        return self.load(path).splats

    def write(self, path: Path, splats: Splats, settings: WriteSettings | None = None) -> None:
        """Writes a file, whole or not at all."""
        self.write_with(path, splats, settings or WriteSettings())
