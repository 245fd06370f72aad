"""What the gradients of the Gaussians say about the camera, in one sweep over them.

The derivation stands in recon_cli.train.poses, with a reference in torch. Here the colours are
turned by their coefficients: torque_i(sh) = sum (G_i sh_rest) . dL/dsh_rest with the generators
G_i, which needs no direction and no derivative of the basis. Reading the coefficients is what takes
time: 6 ms for 100,000 Gaussians of which 31,000 are seen, where the step before takes 21 (one
thread); .6 ms in degree 0.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.render.numba.kernel import kernel
from recon_cli.render.numba.simd_memory import fetch_add
from recon_cli.render.numba.thread_pool import crew
from recon_cli.render.numba.view_pass import flat
from recon_cli.scene.camera import Camera
from recon_cli.scene.harmonics import generators
from recon_cli.scene.splats import Splats

_BLOCK = 1 << 11  # Gaussians whose sums belong together, whichever thread takes them


def pull_of_scene(
    splats: Splats, gradients: Splats, camera: Camera, sh_degree: int
) -> NDArray[np.float64]:
    """Returns the gradient [6] of turning the scene about the camera's centre, and of moving it.

    The same bits whatever the number of threads: each block of Gaussians has its own sums.

    Args:
        splats: float32 on the CPU.
        gradients: of the same shapes; sh_rest is not looked at in degree 0.
        camera: that they were rendered with.
        sh_degree: in use.
    """
    sums = np.zeros((-(-len(splats) // _BLOCK), 6))
    sh_degree = min(sh_degree, splats.sh_degree)
    axes, rows, columns, factors = _entries((sh_degree + 1) ** 2 - 1)
    values, pulls = (
        [flat(getattr(held, name)) for name in ("means", "quats", "sh_rest")]
        for held in (splats, gradients))
    crew.run(pull_on_camera, np.ascontiguousarray(camera.center, np.float64), axes, rows, columns,
             factors, *values, *pulls, flat(gradients.sh_dc), 3 * splats.sh_rest.shape[1], sums,
             scratch=False)
    return np.asarray(sums.sum(axis=0))


@cache
def _entries(terms: int) -> tuple[NDArray[np.int64], ...]:
    """Returns axis, row, column and value of the generators above the diagonal, of some terms."""
    matrices = torch.triu(generators()[:, :terms, :terms]).numpy()
    axes, rows, columns = np.nonzero(matrices)
    return axes, 3 * rows, 3 * columns, matrices[axes, rows, columns]


@kernel
def pull_on_camera(counter, center, axes, rows, columns, factors, means, quats, sh_rest, g_means,
                   g_quats, g_sh_rest, g_sh_dc, stride, sums):
    """Adds up torque and force of each block of Gaussians.

    Args:
        counter: [1] shared; blocks already taken.
        center: [3] of the camera.
        axes: [E] of the generators' entries above the diagonal; E = 0 in degree 0.
        rows: [E] number of the coefficient in sh_rest of a Gaussian.
        columns: [E] likewise.
        factors: [E] their values; those below the diagonal are the negatives.
        means: [N * 3].
        quats: [N * 4].
        sh_rest: [M * stride] of the first M Gaussians.
        g_means: [N * 3] gradients of them, and so on.
        g_quats: [N * 4].
        g_sh_rest: [M * stride].
        g_sh_dc: [N * 3].
        stride: numbers of a Gaussian in sh_rest; 0 where none has any.
        sums: [blocks, 6] float64 out, zeros before.
    """
    n = len(means) // 3
    torque = np.empty(3)
    while True:
        block = fetch_add(counter, 0, 1)
        if block >= len(sums):
            break
        for i in range(block * _BLOCK, min((block + 1) * _BLOCK, n)):
            a, b, c = 3 * i, 3 * i + 1, 3 * i + 2
            gx, gy, gz = (np.float64(g_means[a]), np.float64(g_means[b]), np.float64(g_means[c]))
            dark = g_sh_dc[a] == 0 and g_sh_dc[b] == 0 and g_sh_dc[c] == 0
            if dark and gx == 0 and gy == 0 and gz == 0:
                continue
            x, y, z = means[a] - center[0], means[b] - center[1], means[c] - center[2]
            q = 4 * i
            s, u, v, w = (np.float64(quats[q]), np.float64(quats[q + 1]),
                          np.float64(quats[q + 2]), np.float64(quats[q + 3]))
            gs, gu, gv, gw = g_quats[q], g_quats[q + 1], g_quats[q + 2], g_quats[q + 3]
            torque[0] = y * gz - z * gy + 0.5 * (s * gu - gs * u + v * gw - w * gv)
            torque[1] = z * gx - x * gz + 0.5 * (s * gv - gs * v + w * gu - u * gw)
            torque[2] = x * gy - y * gx + 0.5 * (s * gw - gs * w + u * gv - v * gu)
            if not dark and stride * (i + 1) <= len(sh_rest):
                for e in range(len(axes)):
                    row, column = stride * i + rows[e], stride * i + columns[e]
                    turned = np.float64(0)
                    for channel in range(3):
                        turned += (
                            np.float64(g_sh_rest[row + channel]) * sh_rest[column + channel]
                            - np.float64(g_sh_rest[column + channel]) * sh_rest[row + channel])
                    torque[axes[e]] += factors[e] * turned
            for axis in range(3):
                sums[block, axis] += torque[axis]
            sums[block, 3] += gx
            sums[block, 4] += gy
            sums[block, 5] += gz
