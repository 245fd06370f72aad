"""The two functions of a splat format, and all that goes into a file and comes out of it.

Every module that a row of `workspace.export_formats` names has a `FORMAT`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.splat_arrays import SplatArrays
from recon_cli.splats.axes import nearest_up

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

SHARING = 16


@dataclass(frozen=True)
class Origin:
    """The point that positions are from, since float32 would round them by more than they need."""

    point: tuple[float, float, float]
    rounding: float  # units, at most, by which float32 rounds the positions of the file
    size: float  # of the median Gaussian, units
    rounded: bool  # the file has them in float32 already

    def __str__(self) -> str:
        return " ".join(f"{value:.12g}" for value in self.point)

    def describe(self) -> str:
        """Returns the change and its reason, as the end of a sentence that begins with the file."""
        done = (f"float32 rounds its positions by up to {self.rounding:.2g} units, where Gaussians "
                f"have {self.size:.2g}, so {self} is subtracted from all of them")
        if not self.rounded:
            return done
        return f"{done}; it has them rounded already: write doubles where it comes from"


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene in the axes of recon."""

    arrays: SplatArrays
    up: str | None = None  # axis that the file says is up: z, -y or y; None if it does not
    antialiased: bool = False  # the file says: trained with antialiasing (Mip-Splatting)
    origin: Origin | None = None  # subtracted from all positions; None if nothing was
    writer: str = ""  # what the file says of the program that wrote it; empty if nothing

    @cached_property
    def splats(self) -> Splats:
        """The Gaussians as tensors."""
        return self.arrays.as_tensors()


@dataclass(frozen=True, eq=False)
class Tour:
    """A way through the scene that the page shows by itself."""

    cameras: Sequence[Camera]  # at equal times, at least two; a spline joins them
    # [C, 4] how far left, right, up and down of its middle each may show; its borders are at 1
    margins: NDArray[np.float64]
    seconds: float
    start: int  # number of the camera that the page opens with


@dataclass(frozen=True, eq=False)
class Guide:
    """What a page shows by itself."""

    tour: Tour
    poster: bytes  # a .jpg of the view that it opens with


@dataclass(frozen=True, eq=False)
class WriteSettings:
    """Facts about a scene that a file can hold, and options; each format takes those it knows."""

    up: NDArray[np.float64] | None = None  # [3] unit vector; None where it is not known
    antialiased: bool = False  # the scene was trained with antialiasing (Mip-Splatting)
    title: str = "scene"
    views: Sequence[tuple[str, Camera]] = ()  # training views by name
    guide: Callable[[Splats], Guide | None] | None = None  # makes it, which takes seconds
    options: Mapping[str, Any] = field(default_factory=dict)  # those that the format's row names
    sharing: int = SHARING  # Gaussians per entry of a palette of colours, on the mean

    @property
    def up_axis(self) -> str | None:
        """The axis that is nearest to up: z, -y or y; None where up is not known."""
        return None if self.up is None else nearest_up(self.up)


@dataclass(frozen=True)
class SplatFormat:
    """How files of one format are read and written."""

    load: Callable[[Path], LoadedScene]  # raises FormatError
    # Writes a file, whole or not at all, with the backdrop as Gaussians where the format has no
    # room for one; raises FormatError or InputError if a value does not fit. None: it is only read.
    write_with: Callable[[Path, SplatArrays, WriteSettings], None] | None = None
    # loads a scene without the turn that the file asks for; None where it cannot ask for any
    load_unturned: Callable[[Path], LoadedScene] | None = None

    def read(self, path: Path) -> Splats:
        """Returns the Gaussians of a file; FormatError if it is damaged."""
        return self.load(path).splats

    def write(
        self, path: Path, splats: Splats | SplatArrays, settings: WriteSettings | None = None
    ) -> None:
        """Writes a file, whole or not at all."""
        assert self.write_with is not None, "a format that is only read"
        self.write_with(path, splats.as_arrays(), settings or WriteSettings())
