"""Who looks on while Gaussians are trained: a protocol, and nobody."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:  # importing torch takes seconds, which status must not pay
    from recon_cli.scene.camera import Camera
    from recon_cli.scene.splats import Splats


class Watcher(Protocol):
    """Is told how a training goes. It may read what it is given and change nothing.

    Its methods are called between steps, so what takes long belongs elsewhere; they raise nothing.
    """

    def begin(
        self, label: str, until: int, cameras: Sequence[Camera], splats: Splats
    ) -> None:
        """Hears of a training that begins or goes on.

        Args:
            label: what is trained, as the progress bar calls it.
            until: steps at its end.
            cameras: of the training views.
            splats: to begin with.
        """

    def step(self, iteration: int, splats: Splats) -> None:
        """Is called after each step with the Gaussians as they are; the next step changes them."""

    def report(self, iteration: int, validation_psnr_db: float | None) -> None:
        """Hears the mean PSNR of the validation views, None where there are none."""


class Nobody:
    """Looks away."""

    def begin(self, label: str, until: int, cameras: Sequence[Camera], splats: Splats) -> None:
        """Ignores the training."""

    def step(self, iteration: int, splats: Splats) -> None:
        """Ignores the step."""

    def report(self, iteration: int, validation_psnr_db: float | None) -> None:
        """Ignores the report."""
