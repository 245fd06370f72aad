"""A picture whose truth is known, and the same with noise."""

import numpy as np


def plain_room():
    """Smooth shading with a few edges and a textured corner, [180, 240, 3]."""
    y, x = np.mgrid[:180, :240]
    room = np.stack([90 + 0.3 * x, 110 + 0.2 * y, 140 - 0.1 * x - 0.1 * y], axis=-1)
    room[100:, 60:130] = (60, 90, 160)
    blocks = np.random.default_rng(3).integers(40, 200, (20, 30, 3))
    room[:60, :90] = np.kron(blocks, np.ones((3, 3, 1)))
    return np.round(room).astype(np.uint8)


def noisy(rgb, sigma, seed=0):
    noise = np.random.default_rng(seed).normal(0, sigma, rgb.shape)
    return np.clip(np.round(rgb + noise), 0, 255).astype(np.uint8)


def psnr(rgb, truth):
    return 10 * np.log10(255**2 / np.mean((rgb.astype(float) - truth) ** 2))
