"""Learned features of an image: XFeat (Potje et al., "XFeat: Accelerated Features for Lightweight
Image Matching", CVPR 2024), its sparse part, written from the paper for torch on the CPU.

They match over changes of view that are too large for SIFT, but half a pixel less exactly. Weights
come from `recon setup bridge`, see `xfeat_weights`; the semi-dense matcher is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

# Convolutions of each block, as (channels in, channels out, kernel, stride); each is followed by a
# normalization with fixed statistics and a ReLU (paper, figure 3 and its supplement).
_BLOCKS = {
    "block1": ((1, 4, 3, 1), (4, 8, 3, 2), (8, 8, 3, 1), (8, 24, 3, 2)),
    "block2": ((24, 24, 3, 1), (24, 24, 3, 1)),
    "block3": ((24, 64, 3, 2), (64, 64, 3, 1), (64, 64, 1, 1)),
    "block4": ((64, 64, 3, 2), (64, 64, 3, 1), (64, 64, 3, 1)),
    "block5": ((64, 128, 3, 2), (128, 128, 3, 1), (128, 128, 3, 1), (128, 64, 1, 1)),
    "block_fusion": ((64, 64, 3, 1), (64, 64, 3, 1)),
    "heatmap_head": ((64, 64, 1, 1), (64, 64, 1, 1)),
    "keypoint_head": ((64, 64, 1, 1), (64, 64, 1, 1), (64, 64, 1, 1)),
}
# Convolutions with a bias and nothing behind them: channels in, channels out.
_LINEAR = {"skip1.1": (1, 24), "block_fusion.2": (64, 64), "heatmap_head.2": (64, 1),
           "keypoint_head.3": (64, 65)}
_CELL = 8  # pixels; of the keypoints in each cell the network gives probabilities
_STRIDE = 32  # pixels; the coarsest level has one cell for so many

# The longer side of the image that the network sees, in pixels, and how much smaller ones are
# enlarged for it: rooms of 600 px gave matches .35 px off so, .43 px as they are.
LONGER_SIDE, MAX_ENLARGED = 1024, 2.0
MIN_HEAT, WINDOW = 0.05, 5  # of a keypoint: its probability, and where it is the maximum (paper)
MOST_KEYPOINTS = 3000
# Descriptors are rounded to so many steps: products of two then sum exactly in float32, in any
# order, as 64 of them stay below 2^24. By rounding the cosine moves by less than .001.
DESCRIPTOR_STEPS = 1024.0


def parameter_shapes() -> dict[str, tuple[int, ...]]:
    """Returns the shape of each tensor that the network reads, by its name in the weights."""
    shapes: dict[str, tuple[int, ...]] = {}
    for block, convolutions in _BLOCKS.items():
        for index, (inner, outer, kernel, _) in enumerate(convolutions):
            shapes[f"{block}.{index}.layer.0.weight"] = outer, inner, kernel, kernel
            shapes[f"{block}.{index}.layer.1.running_mean"] = (outer,)
            shapes[f"{block}.{index}.layer.1.running_var"] = (outer,)
    for name, (inner, outer) in _LINEAR.items():
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = (outer, inner, 1, 1), (outer,)
    return shapes


@dataclass(frozen=True, eq=False)
class LearnedFeatures:
    """Keypoints of one image and their descriptors."""

    xy: NDArray[np.float64]  # [K, 2] pixels, the middle of the first one at .5
    descriptors: NDArray[np.float32]  # [K, 64] whole numbers, DESCRIPTOR_STEPS long


class Network:
    """XFeat's backbone and heads, with the weights of a state dict by name."""

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        self._weights = weights

    def __call__(self, gray: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns features [1, 64, h, w], logits of keypoints [1, 65, h, w], heat [1, 1, h, w].

        `gray` is [1, 1, 8 h, 8 w] with sides that 32 divides.
        """
        normal = F.instance_norm(gray)
        skip = self._linear(F.avg_pool2d(normal, 4), "skip1.1")
        fine = self._block(self._block(self._block(normal, "block1") + skip, "block2"), "block3")
        middle = self._block(fine, "block4")
        coarse = self._block(middle, "block5")
        pyramid = fine + sum(F.interpolate(level, fine.shape[-2:], mode="bilinear")
                             for level in (middle, coarse))
        features = self._linear(self._block(pyramid, "block_fusion"), "block_fusion.2")
        heat = torch.sigmoid(self._linear(self._block(features, "heatmap_head"), "heatmap_head.2"))
        cells = self._block(F.pixel_unshuffle(normal, _CELL), "keypoint_head")
        return features, self._linear(cells, "keypoint_head.3"), heat

    def _block(self, x: Tensor, name: str) -> Tensor:
        for index, (_, _, kernel, stride) in enumerate(_BLOCKS[name]):
            layer = f"{name}.{index}.layer"
            x = F.conv2d(x, self._weights[f"{layer}.0.weight"], stride=stride, padding=kernel // 2)
            x = F.relu(F.batch_norm(x, self._weights[f"{layer}.1.running_mean"],
                                    self._weights[f"{layer}.1.running_var"]))
        return x

    def _linear(self, x: Tensor, name: str) -> Tensor:
        return F.conv2d(x, self._weights[f"{name}.weight"], self._weights[f"{name}.bias"])


@torch.inference_mode()
def find_learned_features(
    network: Network, rgb: NDArray[np.uint8], mask: NDArray[np.uint8] | None = None
) -> LearnedFeatures:
    """Returns the features of an image [H, W, 3] at which its mask [H, W], if any, is 255."""
    with _one_thread():
        return _find(network, rgb, mask)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Lets torch compute in one thread, which gives the same bits whatever it had before."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _find(
    network: Network, rgb: NDArray[np.uint8], mask: NDArray[np.uint8] | None
) -> LearnedFeatures:
    height, width = rgb.shape[:2]
    scale = min(MAX_ENLARGED, LONGER_SIDE / max(height, width))
    rows, columns = (max(_STRIDE, int(side * scale) // _STRIDE * _STRIDE)
                     for side in (height, width))
    small = cv2.resize(rgb, (columns, rows), interpolation=(
        cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC))
    gray = torch.from_numpy(small).to(torch.float32).mean(dim=2)[None, None] / 255
    features, logits, reliability = network(gray)
    heat = F.pixel_shuffle(F.softmax(logits, 1)[:, :-1], _CELL)[0, 0]
    peaks = F.max_pool2d(heat[None, None], WINDOW, 1, WINDOW // 2)[0, 0]
    y, x = torch.nonzero((heat == peaks) & (heat > MIN_HEAT), as_tuple=True)
    # The paper's own sampling, with which the descriptors were trained.
    grid = torch.stack([x / (columns - 1), y / (rows - 1)], dim=1)[None, None] * 2 - 1
    score = heat[y, x] * F.grid_sample(reliability, grid, align_corners=False)[0, 0, 0]
    best = torch.argsort(-score, stable=True)[:MOST_KEYPOINTS]
    x, y = x[best], y[best]
    rows64 = F.normalize(F.grid_sample(
        F.normalize(features, dim=1), grid[:, :, best], mode="bicubic",
        align_corners=False)[0, :, 0].T, dim=1)
    xy = (torch.stack(_refine(heat, x, y), dim=1).double().numpy() + 0.5) * [
        width / columns, height / rows]
    descriptors = np.rint(rows64.numpy() * np.float32(DESCRIPTOR_STEPS))
    if mask is not None:
        column, row = np.clip(xy.astype(int), 0, [width - 1, height - 1]).T
        kept = mask[row, column] == 255
        xy, descriptors = xy[kept], descriptors[kept]
    return LearnedFeatures(xy, descriptors)


def _refine(heat: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the peaks of parabolas through the logarithm of the heat at its maxima.

    In two rooms .43 px of error are left by it for .48.
    """
    tiny = 1e-6
    log = F.pad(torch.log(heat.clamp_min(tiny)), (1, 1, 1, 1), value=float(np.log(tiny)))
    middle = log[y + 1, x + 1]

    def offset(before: Tensor, after: Tensor) -> Tensor:
        bend = (before - 2 * middle + after).clamp_max(-tiny)
        return (0.5 * (before - after) / bend).clamp(-0.5, 0.5)

    return (x + offset(log[y + 1, x], log[y + 1, x + 2]),
            y + offset(log[y, x + 1], log[y + 2, x + 1]))
