"""The content of a splat file of any program: its Gaussians, and its statements about them."""

from __future__ import annotations

from dataclasses import dataclass

from recon_cli.scene.splats import Splats


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

    splats: Splats
    up: str | None = None  # axis that the file says is up: z, -y or y; None if it does not
    antialiased: bool = False  # the file says: trained with antialiasing (Mip-Splatting)
    origin: Origin | None = None  # subtracted from all positions; None if nothing was
