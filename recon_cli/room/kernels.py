"""The loops over voxels, pixels and vertices that NumPy would take minutes for.

They are compiled when the first mesh is made, and kept beside those of the rasterizer. The
result of a block of work does not depend on the thread that takes it.
"""

from __future__ import annotations

import math

from recon_cli.kernels.kernel import kernel
from recon_cli.kernels.simd_functions import fetch_add
from recon_cli.kernels.thread_pool import AT_ONCE

SIDE = 8  # voxels along the side of a block
CELLS = SIDE**3
LEAST_COSINE = 0.1  # between ray and normal, for a view to count as one of this side
# columns of the counts of `observe`
SHOWN, SEEN_THROUGH = range(2)


@kernel
def integrate(counter, blocks, values, weights, depth, gain, view, voxel, band, near):
    """Adds one view to the truncated signed distances (Curless and Levoy 1996).

    Args:
        counter: [1] shared; blocks already taken.
        blocks: [B, 3] int32 places of the blocks, in blocks.
        values: [B * 512] float32 in and out, mean signed distance along the rays over the band.
        weights: [B * 512] float32 in and out.
        depth: [H * W] float32; gain: [H * W] float32, weight of each pixel, 0 for none.
        view: `soa.Viewpoint`.
        voxel: side of a voxel; band: truncation; near: least depth of a voxel, world units.

    Behind half of the band weights fall to zero at its end: there begins another surface.
    """
    R, t = view.R, view.t
    reach = voxel * SIDE * math.sqrt(3) / 2 + band
    widest = 1.5 * max(view.fx, view.fy)
    while True:
        first = fetch_add(counter, 0, AT_ONCE)
        if first >= len(blocks):
            break
        for b in range(first, min(first + AT_ONCE, len(blocks))):
            left, top, low = blocks[b, 0] * SIDE, blocks[b, 1] * SIDE, blocks[b, 2] * SIDE
            wx, wy, wz = ((left + 0.5 * SIDE) * voxel, (top + 0.5 * SIDE) * voxel,
                          (low + 0.5 * SIDE) * voxel)
            z = R[6] * wx + R[7] * wy + R[8] * wz + t[2]
            if z < -reach:
                continue
            if z > reach:  # else the camera is inside or beside it
                u = view.fx * (R[0] * wx + R[1] * wy + R[2] * wz + t[0]) / z + view.cx
                v = view.fy * (R[3] * wx + R[4] * wy + R[5] * wz + t[1]) / z + view.cy
                margin = reach * widest / (z - reach)
                if (u < -margin or u > view.width + margin or v < -margin
                        or v > view.height + margin):
                    continue
            for i in range(CELLS):
                wx = (left + i // (SIDE * SIDE) + 0.5) * voxel
                wy = (top + i // SIDE % SIDE + 0.5) * voxel
                wz = (low + i % SIDE + 0.5) * voxel
                z = R[6] * wx + R[7] * wy + R[8] * wz + t[2]
                if z <= near:
                    continue
                u = view.fx * (R[0] * wx + R[1] * wy + R[2] * wz + t[0]) / z + view.cx
                v = view.fy * (R[3] * wx + R[4] * wy + R[5] * wz + t[1]) / z + view.cy
                if u < 0 or v < 0 or u >= view.width or v >= view.height:
                    continue
                at = int(v) * view.width + int(u)
                weight = gain[at]
                distance = depth[at] - z
                if weight <= 0 or distance < -band:
                    continue
                if distance > band:
                    distance = band
                elif distance < -0.5 * band:
                    weight *= 2 * (distance + band) / band
                j = b * CELLS + i
                total = weights[j] + weight
                if total > 0:
                    values[j] += (distance / band - values[j]) * weight / total
                    weights[j] = total


@kernel
def observe(counter, points, normals, view, depth, image, tolerance, near, counts, colors):
    """Adds to each vertex whether a view shows it or sees through it, and its colour there.

    Args:
        counter: [1] shared; vertices already taken.
        points: [V, 3] float64; normals: [V, 3] float64 unit vectors, outwards.
        view: `soa.Viewpoint`.
        depth: [H * W] float32, 0 for none; image: [H * W * 3] uint8.
        tolerance: of the depth, within which a vertex is on the surface; near: least depth.
        counts: [V, 2] int32 in and out, views that show it and that see through it.
        colors: [V, 4] float64 in and out, sums of weighted red, green, blue, and of weights.
    """
    R, t = view.R, view.t
    while True:
        first = fetch_add(counter, 0, AT_ONCE)
        if first >= len(points):
            break
        for i in range(first, min(first + AT_ONCE, len(points))):
            wx, wy, wz = points[i, 0], points[i, 1], points[i, 2]
            z = R[6] * wx + R[7] * wy + R[8] * wz + t[2]
            if z <= near:
                continue
            u = view.fx * (R[0] * wx + R[1] * wy + R[2] * wz + t[0]) / z + view.cx
            v = view.fy * (R[3] * wx + R[4] * wy + R[5] * wz + t[1]) / z + view.cy
            if u < 0 or v < 0 or u >= view.width or v >= view.height:
                continue
            at = int(v) * view.width + int(u)
            seen = depth[at]
            dx, dy, dz = view.center[0] - wx, view.center[1] - wy, view.center[2] - wz
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            cosine = (dx * normals[i, 0] + dy * normals[i, 1] + dz * normals[i, 2]) / length
            if seen <= 0 or cosine < LEAST_COSINE:
                continue
            if z < seen - tolerance * z:
                counts[i, SEEN_THROUGH] += 1
            elif z <= seen + tolerance * z:
                counts[i, SHOWN] += 1
                weight = (cosine / z) ** 2
                for c in range(3):
                    colors[i, c] += weight * image[3 * at + c]
                colors[i, 3] += weight
