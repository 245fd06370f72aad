"""A view in memory, as training and scoring read it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.scene.camera import Camera


@dataclass(frozen=True, eq=False)
class TrainView:
    """One view in the form that training reads."""

    camera: Camera  # at the size of the image
    image: NDArray[np.uint8]  # [H, W, 3]; one colour under the mask (`io.images.fill_masked`)
    mask: NDArray[np.bool_] | None = None  # [H, W], True where a pixel counts; None where all do

    def __post_init__(self) -> None:
        if self.mask is not None and self.mask.shape != self.image.shape[:2]:
            raise ValueError(f"a mask of {self.mask.shape} for an image of {self.image.shape}")

    def page_locked(self) -> TrainView:
        """Returns the view in memory that a GPU reads by itself while the host goes on."""
        mask = None if self.mask is None else torch.from_numpy(self.mask).pin_memory().numpy()
        return TrainView(self.camera, torch.from_numpy(self.image).pin_memory().numpy(), mask)

    def pixels(self, device: torch.device) -> Tensor:
        """Returns the image as float32 in [0, 1], [H, W, 3]."""
        return torch.from_numpy(self.image).to(device).float() / 255

    def counting(self, device: torch.device) -> Tensor | None:
        """Returns the mask, [H, W] bool."""
        return None if self.mask is None else torch.from_numpy(self.mask).to(device)
