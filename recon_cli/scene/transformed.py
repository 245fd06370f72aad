"""Gaussians in another world frame."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from recon_cli.scene.harmonics_rotation import rotated
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats


def transformed(splats: Splats, similarity: Similarity) -> Splats:
    """Returns the same Gaussians in the new world: a moved camera sees the same image.

    Computed in float64. Parameters that the similarity leaves alone keep their bits: a change of
    scale touches neither rotations nor colours.

    Args:
        splats: raw parameters of any float dtype.
        similarity: from the old world to the new one.

    Returns:
        Gaussians of the same dtype and device. Quaternions keep their length, except zeros, which
        stand for no rotation and become unit quaternions.
    """
    device = splats.means.device
    rotation = torch.from_numpy(np.asarray(similarity.rotation, np.float64)).to(device)
    translation = torch.from_numpy(np.asarray(similarity.translation, np.float64)).to(device)
    means = similarity.scale * (splats.means.double() @ rotation.T) + translation
    log_scales = splats.log_scales.double() + math.log(similarity.scale)
    quats, sh_rest = splats.quats, splats.sh_rest
    if not np.array_equal(similarity.rotation, np.eye(3)):
        quats = _turned(quats, similarity.rotation)
        sh_rest = rotated(sh_rest, similarity.rotation)
    return Splats(
        means.to(splats.means.dtype), quats, log_scales.to(splats.log_scales.dtype),
        splats.logit_opacities, splats.sh_dc, sh_rest)


def _turned(quats: Tensor, rotation: NDArray[np.float64]) -> Tensor:
    """Returns quaternions [N, 4] wxyz after a rotation: the product q(rotation) * quats."""
    w, *vector = quaternion(rotation)
    turn = torch.tensor([w, *vector], dtype=torch.float64, device=quats.device)
    none = quats.new_tensor([1.0, 0, 0, 0])
    given = torch.where((quats == 0).all(-1, keepdim=True), none, quats).double()
    axis, own = turn[1:].expand(len(quats), 3), given[:, 1:]
    real = turn[0] * given[:, :1] - (axis * own).sum(-1, keepdim=True)
    imaginary = turn[0] * own + given[:, :1] * axis + torch.linalg.cross(axis, own)
    return torch.cat([real, imaginary], dim=-1).to(quats.dtype)


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the unit quaternion [4], wxyz with w >= 0, of a rotation [3, 3].

    Bar-Itzhack 2000, "New Method for Extracting the Quaternion from a Rotation Matrix": the
    eigenvector of the greatest eigenvalue, which is as exact for half turns as for none.
    """
    r = np.asarray(rotation, np.float64)
    trace = np.trace(r)
    k = np.empty((4, 4))
    k[0, 0] = trace
    k[0, 1:] = k[1:, 0] = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    k[1:, 1:] = r + r.T - trace * np.eye(3)
    vector: NDArray[np.float64] = np.linalg.eigh(k)[1][:, -1]
    return vector if vector[0] >= 0 else -vector
