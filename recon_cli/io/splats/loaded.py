"""What a splat file of any program holds: its Gaussians, and what it says about them."""

from __future__ import annotations

from dataclasses import dataclass

from recon_cli.scene.splats import Splats


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene in the axes of recon."""

    splats: Splats
    up: str | None = None  # the axis that is up by what the file says: z, -y or y; None if nothing
    antialiased: bool = False  # it says that it was trained with antialiasing (Mip-Splatting)
    # what was subtracted from all positions, since float32 would round them; None for nothing
    origin: tuple[float, float, float] | None = None
