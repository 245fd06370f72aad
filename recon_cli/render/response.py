"""How a camera answers to the light of a view: vignette and gain of its photograph.

    y = g v(s) x,   v = exp(a s + b s^2)

of a rendered value x; s is the squared distance of a pixel from the principal point over that of
the farthest corner.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.scene.camera import Camera

_DIGITS = 2  # of a lens in widths: rounded sizes move them by a pixel
_SIZES = 64  # of images whose distances stay in memory


@dataclass(frozen=True, eq=False)
class Response:
    """The response of one photograph; each part may do nothing."""

    gain: NDArray[np.float32]  # [3] factors of the channels
    vignette: tuple[float, float] | None = None  # a and b; None for no vignette


@dataclass(frozen=True, eq=False)
class ResponseGradient:
    """The gradients of a loss by the parameters of a `Response`."""

    log_gain: NDArray[np.float64]  # [3]
    vignette: NDArray[np.float64]  # [2], by a and b

    @staticmethod
    def zeros() -> ResponseGradient:
        """Returns the gradient of what has no influence."""
        return ResponseGradient(np.zeros(3), np.zeros(2))


def squared_distances(camera: Camera) -> NDArray[np.float32]:
    """Returns s of each pixel, [H, W]: 0 at the principal point, 1 at the farthest corner."""
    return _squares(camera.width, camera.height, camera.cx, camera.cy)


@lru_cache(_SIZES)
def _squares(width: int, height: int, cx: float, cy: float) -> NDArray[np.float32]:
    across = (np.arange(width) + 0.5 - cx) ** 2
    down = (np.arange(height) + 0.5 - cy) ** 2
    corner = max(cx, width - cx) ** 2 + max(cy, height - cy) ** 2
    squares = ((down[:, None] + across) / corner).astype(np.float32)
    squares.setflags(write=False)
    return squares


def transmission(camera: Camera, vignette: tuple[float, float]) -> NDArray[np.float32]:
    """Returns the share of the light that a vignette leaves of each pixel, [H, W]."""
    a, b = (np.float32(value) for value in vignette)
    squares = squared_distances(camera)
    return np.asarray(np.exp(squares * (a + b * squares)), np.float32)


@dataclass(frozen=True)
class LensFalloffs:
    """The vignettes of some lenses, for renders that are compared with their photographs."""

    exponents: Mapping[tuple[float, ...], tuple[float, float]]  # a and b by `lens`

    def shade(self, image: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
        """Returns a render [H, W, 3] as the lens of a camera shows it; as it is for other lenses.
        """
        found = self.exponents.get(lens(camera))
        return image if found is None else image * transmission(camera, found)[..., None]

    def shade_tensor(self, image: Tensor, camera: Camera) -> Tensor:
        """Returns the same of a tensor on any device."""
        found = self.exponents.get(lens(camera))
        if found is None:
            return image
        return image * torch.from_numpy(transmission(camera, found)).to(image)[..., None]


def lens(camera: Camera) -> tuple[float, ...]:
    """Returns what views of one camera with one setting of its lens share, at any size."""
    return tuple(round(value / camera.width, _DIGITS) for value in (
        camera.height, camera.fx, camera.fy, camera.cx, camera.cy))


class ResponseTensors:
    """The parameters of a response as leaves of autograd, for any device."""

    def __init__(self, response: Response, camera: Camera, like: Tensor) -> None:
        self._log_gain = torch.from_numpy(response.gain).to(like).log().requires_grad_()
        self._vignette: Tensor | None = None
        if response.vignette is not None:
            self._vignette = like.new_tensor(response.vignette).requires_grad_()
            self._squares = torch.from_numpy(squared_distances(camera).copy()).to(like)[..., None]

    def apply(self, rgb: Tensor) -> Tensor:
        """Returns the photograph of a render [H, W, 3]."""
        exponent = self._log_gain
        if self._vignette is not None:
            a, b = self._vignette
            exponent = exponent + self._squares * (a + b * self._squares)
        return rgb * exponent.exp()

    def gradient(self) -> ResponseGradient:
        """Returns the gradients that a backward pass left."""
        def found(leaf: Tensor | None, size: int) -> NDArray[np.float64]:
            if leaf is None or leaf.grad is None:
                return np.zeros(size)
            return np.asarray(leaf.grad.cpu().double().numpy()).reshape(size)

        return ResponseGradient(found(self._log_gain, 3), found(self._vignette, 2))


class ResponsePass:
    """Forward and backward pass of a response in closed form, in place, on the CPU."""

    def __init__(self, response: Response, camera: Camera) -> None:
        self._response, self._camera = response, camera
        if response.vignette is None:
            self._factor = np.tile(response.gain, camera.width)  # whole rows: ten times faster
        else:
            left = transmission(camera, response.vignette)
            self._factor = (left[..., None] * response.gain).reshape(camera.height, -1)

    def forward(self, image: NDArray[np.float32]) -> None:
        """Turns a render [H, W * 3] into its photograph."""
        image *= self._factor

    def backward(
        self, image: NDArray[np.float32], gradient: NDArray[np.float32]
    ) -> ResponseGradient:
        """Carries the gradient of the photograph `image` back to the render, in place.

        With q = y dL/dy: dL/dlog g is the sum of q over the pixels of a channel, dL/da that of s q,
        dL/db that of s^2 q. Where a mask replaced y by the truth dL/dy is 0.
        """
        product = np.multiply(image, gradient)
        columns = product.sum(axis=0, dtype=np.float64)
        vignette = np.zeros(2)
        if self._response.vignette is not None:
            squares = squared_distances(self._camera).astype(np.float64)
            pixels = product.reshape(*squares.shape, 3).sum(axis=2, dtype=np.float64) * squares
            vignette[:] = pixels.sum(), (pixels * squares).sum()
        gradient *= self._factor
        return ResponseGradient(columns.reshape(-1, 3).sum(axis=0), vignette)
