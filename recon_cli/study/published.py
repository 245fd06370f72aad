"""The paper's own figures: "3D Reconstruction of Indoor Scenes Based on 3DGS Models", Table I."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Published:
    """One row of Table I (Replica).

    Attributes:
        reference_psnr_db: of 3DGS.
        reference_ssim: of 3DGS.
        paper_psnr_db: of the paper's method.
        paper_ssim: of the paper's method.
    """

    reference_psnr_db: float
    reference_ssim: float
    paper_psnr_db: float
    paper_ssim: float

    @property
    def gain_db(self) -> float:
        """What the paper reports to gain."""
        return self.paper_psnr_db - self.reference_psnr_db

    @property
    def gain_ssim(self) -> float:
        """What the paper reports to gain."""
        return self.paper_ssim - self.reference_ssim


TABLE_I = {
    "office0": Published(38.45, 0.925, 39.05, 0.934),
    "office1": Published(36.97, 0.938, 37.17, 0.954),
    "office2": Published(36.39, 0.945, 36.68, 0.962),
    "office3": Published(35.85, 0.941, 36.35, 0.958),
    "office4": Published(36.54, 0.939, 36.66, 0.941),
    "room0": Published(37.26, 0.915, 38.06, 0.923),
    "room1": Published(36.28, 0.929, 37.75, 0.935),
    "room2": Published(34.98, 0.913, 35.14, 0.927),
}


def published(scene: str) -> Published | None:
    """Returns the paper's figures for a scene of that name, None where it has none."""
    return TABLE_I.get(scene.lower())
