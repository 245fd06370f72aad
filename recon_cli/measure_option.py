"""What --scale-between says, and what is refused of it."""

from __future__ import annotations

from recon_cli.errors import ConfigError

SCALE_BETWEEN = (
    "Make one unit a metre: A and B are METRES apart. Each is a frame's name (where its camera "
    "was), x,y,z (a point of the scene as it is without this option) or FRAME:u,v (what the "
    "undistorted frame shows at that pixel).")
_MEASURE = "For example --scale-between 000003.png:120,200 000003.png:480,210 1.5"


def check_scale_between(value: tuple[str, str, float] | None) -> None:
    """Raises ConfigError where --scale-between measures nothing."""
    if value is None:
        return
    a, b, metres = value
    if a.strip() == b.strip() or not a.strip() or not b.strip():
        raise ConfigError(
            f"scale_between goes from {a!r} to {b!r}, but it must name two different places.",
            hint=_MEASURE)
    if metres <= 0:
        raise ConfigError(
            f"scale_between says {metres:g} metres, but it must be more than 0.", hint=_MEASURE)
