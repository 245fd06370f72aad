"""Gaussians for the tests of splat files: a room with materials, extremes, and comparisons."""

import numpy as np
import torch

from recon_cli.scene.splats import Splats, with_rows

TERMS = {0: 0, 1: 3, 2: 8, 3: 15}


def splats_of(**values):
    return Splats(**{name: torch.tensor(value, dtype=torch.float32)
                     for name, value in values.items()})


def room(n, *, seed=0, degree=3, materials=40):
    """Gaussians on the walls of a room in front of `scenes.camera_at`, in textured materials.

    Coefficients follow the material and vary by a fifth of that from one Gaussian to the next.
    """
    rng = np.random.default_rng(seed)
    means = rng.uniform(-1, 1, (n, 3)) * [2, 1.5, 2] + [0, 0, 3]
    wall = rng.integers(0, 3, n)
    means[wall == 0, 0] = rng.choice([-2, 2], (wall == 0).sum())
    means[wall == 1, 1] = rng.choice([-1.5, 1.5], (wall == 1).sum())
    means[wall == 2, 2] = 5
    means += rng.normal(0, 0.01, (n, 3))  # of one depth, the order of the file would show
    waves = np.sin(means @ rng.normal(size=(3, 3)) * 2)
    material = ((means @ rng.normal(size=3) * 3).astype(int) * 3 + wall) % materials
    strength = np.repeat([0.1, 0.05, 0.03], [3, 5, 7])[None, :, None]
    sh = strength * (rng.normal(size=(materials, 15, 3))[material]
                     + 0.2 * rng.normal(size=(n, 15, 3)))
    return splats_of(
        means=means, quats=rng.normal(size=(n, 4)), log_scales=rng.normal(-3, 0.5, (n, 3)),
        logit_opacities=rng.normal(1, 2, n), sh_dc=waves + rng.normal(0, 0.1, (n, 3)),
        sh_rest=sh[:, :TERMS[degree]])


def extremes(degree=3, colored=9):
    """Twelve Gaussians with what files have trouble with, all at different places."""
    rng = np.random.default_rng(5)
    means = rng.normal(size=(12, 3))
    means[:6] = [[0, 0, 0], [1e4, -1e4, 1e4], [-1e-7, 1e-7, 7], [-3e3, 2, 1], [5, 5, -9e3],
                 [1e-3, -1e-3, 1e-3]]
    quats = rng.normal(size=(12, 4))
    quats[:7] = [[0, 0, 0, 0], [1, 0, 0, 0], [0, -2, 0, 0], [0, 0, 1e-20, 0], [1, 1, 1, 1],
                 [-1e15, 1e15, -1e15, 1e15], [0.5, -0.5, 0.5, -0.5001]]
    logits = rng.normal(size=12)
    logits[:6] = [-80, 80, 16, -16, 0, 1e4]
    scales = rng.normal(-3, 1, (12, 3))
    scales[:3] = [[-30, 5, 0], [-80, -80, -80], [8, 8, 8]]
    colors = rng.normal(size=(12, 3))
    colors[0] = [50, -50, 0]
    return splats_of(
        means=means, quats=quats, log_scales=scales, logit_opacities=logits, sh_dc=colors,
        sh_rest=rng.normal(size=(colored, TERMS[degree], 3)))


def unit(quats):
    """Returns quaternions of unit length with w >= 0; zeros stand for no rotation."""
    quats = quats.double()
    quats = torch.where((quats == 0).all(1, keepdim=True), torch.tensor([1.0, 0, 0, 0]), quats)
    quats = quats / quats.abs().amax(1, keepdim=True)
    return quats / quats.norm(dim=1, keepdim=True)


def apart(quats, others):
    """Returns how far rotations are apart, in components of unit quaternions [N]."""
    one, other = unit(quats), unit(others)
    return torch.minimum((one - other).abs().amax(1), (one + other).abs().amax(1))


def all_rows(splats):
    return with_rows(splats.sh_rest, len(splats))


def matched(splats, back):
    """Returns the row of `splats` [N] that each of `back` is, by their places in logarithms."""
    logs = [torch.sign(one.means.double()) * torch.log1p(one.means.double().abs())
            for one in (back, splats)]
    rows = torch.cdist(*logs).argmin(1)
    assert sorted(rows.tolist()) == list(range(len(splats)))
    return rows
