"""LPIPS, where its package and its weights are there. It is an extra and never fetched unasked."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

LPIPS_CONVENTION = "LPIPS 0.1 with AlexNet, of the float render, lower is better"
_WEIGHTS = "alexnet-owt-7be5be79.pth"  # as torchvision names them

Perceptual = Callable[[NDArray[np.float32], NDArray[np.uint8]], float]


def perceptual() -> tuple[Perceptual | None, str]:
    """Returns the distance of an image [H, W, 3] in [0, 1] from a truth, and why there is none.

    (Zhang et al. 2018.) Its backbone's weights lie where torchvision keeps them; without them there
    is no distance, because nothing here goes to the network unasked.
    """
    try:
        lpips: Any = importlib.import_module("lpips")
    except ImportError:
        return None, "the package lpips is not installed (pip install 'recon-cli[lpips]')"
    weights = Path(torch.hub.get_dir()) / "checkpoints" / _WEIGHTS
    if not weights.is_file():
        return None, (f"its weights are not at {weights}; `python -c \"import lpips; "
                      "lpips.LPIPS(net='alex')\"` fetches them once")
    network = lpips.LPIPS(net="alex", verbose=False).eval()

    def distance(image: NDArray[np.float32], truth: NDArray[np.uint8]) -> float:
        with torch.no_grad():
            pair = [_centred(one) for one in (np.clip(image, 0, 1), truth / 255.0)]
            return float(network(*pair))

    return distance, ""


def _centred(image: NDArray[Any]) -> torch.Tensor:
    """Returns an image in [0, 1] as [1, 3, H, W] in [-1, 1], which the network was trained on."""
    return torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None] * 2 - 1
