"""A view in memory, as training and scoring read it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.scene.camera import Camera
from recon_cli.scene.image_file import ImageFile

if TYPE_CHECKING:  # ingest and denoise handle images without it: it takes a second to import
    import torch
    from torch import Tensor

# Of SSIM (Wang et al. 2004) of images in [0, 1]: standard deviation of its window, in pixels, and
# what keeps its quotients finite.
SSIM_SIGMA, SSIM_C1, SSIM_C2 = 1.5, 0.01**2, 0.03**2
BORDER = 5  # pixels from the middle of the window to its side, which scores leave out
MIN_SIDE = 2 * BORDER + 1  # pixels; the window
MIN_PIXELS = MIN_SIDE**2  # that a mask must leave: one window of SSIM


@dataclass(frozen=True, eq=False)
class SensorDepth:
    """Depth that a sensor measured in a view, where it is sure: K samples of its map."""

    rays: NDArray[np.float32]  # [K, 2] x / z and y / z in the axes of the camera
    depths: NDArray[np.float32]  # [K] z, world units
    noise: float  # relative standard deviation of the depths
    cells: int  # samples of the map that lie in the image, known or not

    def image(
        self, camera: Camera, mask: NDArray[np.bool_] | None = None
    ) -> NDArray[np.float32]:
        """Returns the depths at their pixels in an image of the view, [H, W], else 0.

        `camera` may have any size; of several samples in a pixel one is taken, and none where
        `mask` [H, W] is False.
        """
        column = np.floor(self.rays[:, 0] * camera.fx + camera.cx).astype(np.int64)
        row = np.floor(self.rays[:, 1] * camera.fy + camera.cy).astype(np.int64)
        inside = (column >= 0) & (row >= 0) & (column < camera.width) & (row < camera.height)
        image = np.zeros((camera.height, camera.width), np.float32)
        image[row[inside], column[inside]] = self.depths[inside]
        if mask is not None:
            image[~mask] = 0
        return image


@dataclass(frozen=True, eq=False)
class TrainView:
    """One view in the form that training reads."""

    camera: Camera  # at the size of the image
    stored: NDArray[np.uint8]  # the image, [H, W, 3]; one colour under the mask (`fill_masked`)
    mask: NDArray[np.bool_] | None = None  # [H, W], True where a pixel counts; None where all do
    file: ImageFile | None = field(default=None, kw_only=True)  # in which the image lies, if in any
    depth: SensorDepth | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.mask is not None and self.mask.shape != self.stored.shape[:2]:
            raise ValueError(f"a mask of {self.mask.shape} for an image of {self.stored.shape}")

    @property
    def image(self) -> NDArray[np.uint8]:
        """The image, to be read now: others in its file may be let out of memory."""
        if self.file is not None:
            self.file.look(self.stored.nbytes)
        return self.stored

    def page_locked(self) -> TrainView:
        """Returns the view in memory that a GPU reads by itself while the host continues.

        One that lies in a file stays there.
        """
        if self.file is not None:
            return self
        import torch

        mask = None if self.mask is None else torch.from_numpy(self.mask).pin_memory().numpy()
        return TrainView(
            self.camera, torch.from_numpy(self.image).pin_memory().numpy(), mask, depth=self.depth)

    def pixels(self, device: torch.device) -> Tensor:
        """Returns the image as float32 in [0, 1], [H, W, 3]."""
        import torch

        return torch.from_numpy(self.image).to(device).float() / 255

    def counting(self, device: torch.device) -> Tensor | None:
        """Returns the mask, [H, W] bool."""
        import torch

        return None if self.mask is None else torch.from_numpy(self.mask).to(device)


def leaves_enough(mask: NDArray[np.bool_] | None) -> bool:
    """Returns whether a mask [H, W] leaves MIN_PIXELS pixels off the border; None leaves all."""
    return mask is None or int(np.count_nonzero(without_border(mask))) >= MIN_PIXELS


def without_border(pixels: NDArray[Any]) -> NDArray[Any]:
    """Returns [H, W, ...] without the border that SSIM leaves out."""
    return pixels[BORDER:-BORDER, BORDER:-BORDER]
