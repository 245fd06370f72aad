"""The loops over triangles, pixels and texels of a textured mesh.

As in `room.kernels`: compiled at first use, and the result does not depend on the threads.
"""

from __future__ import annotations

import math

from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.kernels.simd_functions import fetch_add
from recon_cli.kernels.thread_pool import AT_ONCE
from recon_cli.stereo.depths import CAMERA_NUMBERS

MOST_CANDIDATES = 4096  # views of a triangle; a float of each lies in the scratch of a thread
_LEAST_COSINE = 0.05  # between ray and normal
_LARGE = 6.0  # pixels; of smaller triangles a few places tell whether a view shows them
# columns of a row of the table of views: as `stereo.depths.camera_row`, then the weight of the view
# and its gains of red, green and blue
WEIGHT = CAMERA_NUMBERS
GAIN = WEIGHT + 1
COLUMNS = GAIN + 3


@kernel
def draw(counter, places, faces, nearness, owners):
    """Draws triangles into one view: what lies nearest to the camera in every pixel.

    Args:
        counter: [1] shared; rows already taken.
        places: [V, 3] float64 column and row in pixels, and 1 / depth; 0 for what is not drawn.
        faces: [F, 3] int64.
        nearness: [H, W] float32 in and out, 1 / depth, 0 where there is nothing.
        owners: [H, W] int32 in and out, the triangle, -1 where there is none.
    """
    height, width = nearness.shape
    while True:
        first = fetch_add(counter, 0, AT_ONCE)
        if first >= height:
            break
        last = min(first + AT_ONCE, height)
        for f in range(len(faces)):
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            ya, yb, yc = places[a, 1], places[b, 1], places[c, 1]
            low, high = min(ya, yb, yc), max(ya, yb, yc)
            if high < first + 0.5 or low > last - 0.5:
                continue
            xa, xb, xc = places[a, 0], places[b, 0], places[c, 0]
            left, right = min(xa, xb, xc), max(xa, xb, xc)
            if right < 0.5 or left > width - 0.5:
                continue
            na, nb, nc = places[a, 2], places[b, 2], places[c, 2]
            area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
            if na <= 0 or nb <= 0 or nc <= 0 or area == 0:
                continue
            # weights of b and c, linear in column x and row y
            bx, by = (yc - ya) / area, (xa - xc) / area
            cx, cy = (ya - yb) / area, (xb - xa) / area
            for y in range(max(first, math.ceil(low - 0.5)), min(last, math.floor(high + 0.5))):
                dy = y + 0.5 - ya
                for x in range(max(0, math.ceil(left - 0.5)),
                               min(width, math.floor(right + 0.5))):
                    dx = x + 0.5 - xa
                    wb, wc = dx * bx + dy * by, dx * cx + dy * cy
                    if wb < 0 or wc < 0 or wb + wc > 1:
                        continue
                    near = na + wb * (nb - na) + wc * (nc - na)
                    if near > nearness[y, x]:
                        nearness[y, x] = near
                        owners[y, x] = f


@kernel
def bake(counter, vertices, normals, colors, faces, corners, views, starts, pixels, nearness,
         quality, tolerance, texture, covered, scratch):
    """Paints the texels of all triangles with what the views show there.

    Args:
        counter: [1] shared; triangles already taken.
        vertices: [V, 3] float64; normals: [V, 3] float64 unit vectors, outwards.
        colors: [V, 3] uint8, taken where no view shows a texel.
        faces: [F, 3] int64.
        corners: [V, 2] float64 column and row in the texture, in texels.
        views: [C, COLUMNS] float64.
        starts: [C] int64, of the pixels of each view in the next three.
        pixels: [P, 3] uint8; nearness: [P] float32, 1 / depth of the mesh, 0 for nothing.
        quality: [P] uint8, how well a pixel may be used, 0 where it may not.
        tolerance: of a depth, within which a view shows a texel.
        texture: [T, T, 3] uint8 out.
        covered: [T, T] uint8 out: 1 painted from views, 2 from `colors`.

    A texel is the mean of the views that show it, weighted by the pixels that they have for an area
    of the surface, by their own weight and the quality of the pixel. As quality fades towards the
    border of what a view shows, there are no edges between views.
    """
    size = len(texture)
    while True:
        first = fetch_add(counter, 0, AT_ONCE)
        if first >= len(faces):
            break
        for f in range(first, min(first + AT_ONCE, len(faces))):
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            xa, ya = corners[a, 0], corners[a, 1]
            xb, yb, xc, yc = corners[b, 0], corners[b, 1], corners[c, 0], corners[c, 1]
            area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
            if area == 0:
                continue
            left, right = min(xa, xb, xc), max(xa, xb, xc)
            low, high = min(ya, yb, yc), max(ya, yb, yc)
            top, bottom = max(0, math.ceil(low - 0.5)), min(size, math.floor(high + 0.5))
            start, end = max(0, math.ceil(left - 0.5)), min(size, math.floor(right + 0.5))
            if top >= bottom or start >= end:
                continue
            count = 0
            for v in range(len(views)):
                if count < MOST_CANDIDATES and _may_show(
                        vertices, normals, a, b, c, views[v], starts[v], nearness, quality,
                        2 * tolerance):
                    scratch[count] = v
                    count += 1
            bx, by = (yc - ya) / area, (xa - xc) / area
            cx, cy = (ya - yb) / area, (xb - xa) / area
            for y in range(top, bottom):
                dy = y + 0.5 - ya
                for x in range(start, end):
                    dx = x + 0.5 - xa
                    wb, wc = dx * bx + dy * by, dx * cx + dy * cy
                    wa = 1 - wb - wc
                    if wb < 0 or wc < 0 or wa < 0:
                        continue
                    px = wa * vertices[a, 0] + wb * vertices[b, 0] + wc * vertices[c, 0]
                    py = wa * vertices[a, 1] + wb * vertices[b, 1] + wc * vertices[c, 1]
                    pz = wa * vertices[a, 2] + wb * vertices[b, 2] + wc * vertices[c, 2]
                    nx = wa * normals[a, 0] + wb * normals[b, 0] + wc * normals[c, 0]
                    ny = wa * normals[a, 1] + wb * normals[b, 1] + wc * normals[c, 1]
                    nz = wa * normals[a, 2] + wb * normals[b, 2] + wc * normals[c, 2]
                    red, green, blue, total = 0.0, 0.0, 0.0, 0.0
                    for i in range(count):
                        v = int(scratch[i])
                        P = views[v]
                        z = P[6] * px + P[7] * py + P[8] * pz + P[11]
                        if z <= 1e-9:
                            continue
                        cu = P[0] * px + P[1] * py + P[2] * pz + P[9]
                        cv = P[3] * px + P[4] * py + P[5] * pz + P[10]
                        u, w = P[12] * cu / z + P[14], P[13] * cv / z + P[15]
                        if u < 0 or w < 0 or u >= P[16] or w >= P[17]:
                            continue
                        width, height = int(P[16]), int(P[17])
                        at = starts[v] + int(w) * width + int(u)
                        if quality[at] == 0 or abs(nearness[at] * z - 1) > tolerance:
                            continue
                        # the transpose of the rotation turns the ray into the axes of the world
                        facing = -((P[0] * cu + P[3] * cv + P[6] * z) * nx
                                   + (P[1] * cu + P[4] * cv + P[7] * z) * ny
                                   + (P[2] * cu + P[5] * cv + P[8] * z) * nz)
                        ray = cu * cu + cv * cv + z * z
                        if facing <= _LEAST_COSINE * math.sqrt(ray):
                            continue
                        weight = P[WEIGHT] * quality[at] * facing * facing / ray * (
                            P[12] * P[13] / (z * z))
                        u, w = u - 0.5, w - 0.5
                        column, row = math.floor(u), math.floor(w)
                        su, sw = u - column, w - row
                        lefts, rights = max(column, 0), min(column + 1, width - 1)
                        upper = starts[v] + max(row, 0) * width
                        lower = starts[v] + min(row + 1, height - 1) * width
                        p, q = upper + lefts, upper + rights
                        r, s = lower + lefts, lower + rights
                        wp, wq = (1 - sw) * (1 - su) * weight, (1 - sw) * su * weight
                        wr, ws = sw * (1 - su) * weight, sw * su * weight
                        red += P[GAIN] * (wp * pixels[p, 0] + wq * pixels[q, 0]
                                          + wr * pixels[r, 0] + ws * pixels[s, 0])
                        green += P[GAIN + 1] * (wp * pixels[p, 1] + wq * pixels[q, 1]
                                                + wr * pixels[r, 1] + ws * pixels[s, 1])
                        blue += P[GAIN + 2] * (wp * pixels[p, 2] + wq * pixels[q, 2]
                                               + wr * pixels[r, 2] + ws * pixels[s, 2])
                        total += weight
                    if total > 0:
                        covered[y, x] = 1
                        red, green, blue = red / total, green / total, blue / total
                    else:
                        covered[y, x] = 2
                        red = wa * colors[a, 0] + wb * colors[b, 0] + wc * colors[c, 0]
                        green = wa * colors[a, 1] + wb * colors[b, 1] + wc * colors[c, 1]
                        blue = wa * colors[a, 2] + wb * colors[b, 2] + wc * colors[c, 2]
                    texture[y, x, 0] = min(255.0, red + 0.5)
                    texture[y, x, 1] = min(255.0, green + 0.5)
                    texture[y, x, 2] = min(255.0, blue + 0.5)


@inlined
def _may_show(vertices, normals, a, b, c, P, start, nearness, quality, tolerance):
    """Returns whether a view may show a triangle, by its corners and its middle.

    A large one may be seen between them: it counts wherever the view looks at it.
    """
    mx = (vertices[a, 0] + vertices[b, 0] + vertices[c, 0]) / 3
    my = (vertices[a, 1] + vertices[b, 1] + vertices[c, 1]) / 3
    mz = (vertices[a, 2] + vertices[b, 2] + vertices[c, 2]) / 3
    nx = normals[a, 0] + normals[b, 0] + normals[c, 0]
    ny = normals[a, 1] + normals[b, 1] + normals[c, 1]
    nz = normals[a, 2] + normals[b, 2] + normals[c, 2]
    radius = 0.0
    for corner in (a, b, c):
        radius = max(radius, (vertices[corner, 0] - mx) ** 2 + (vertices[corner, 1] - my) ** 2
                     + (vertices[corner, 2] - mz) ** 2)
    radius = math.sqrt(radius)
    z = P[6] * mx + P[7] * my + P[8] * mz + P[11]
    if z + radius <= 0:
        return False
    if z <= 2 * radius:
        return True
    cu = P[0] * mx + P[1] * my + P[2] * mz + P[9]
    cv = P[3] * mx + P[4] * my + P[5] * mz + P[10]
    u, w = P[12] * cu / z + P[14], P[13] * cv / z + P[15]
    reach = max(P[12], P[13]) * radius / (z - radius)
    if u < -1.5 * reach or w < -1.5 * reach or u > P[16] + 1.5 * reach or w > P[17] + 1.5 * reach:
        return False
    if reach > _LARGE:
        return True
    facing = -((P[0] * cu + P[3] * cv + P[6] * z) * nx + (P[1] * cu + P[4] * cv + P[7] * z) * ny
               + (P[2] * cu + P[5] * cv + P[8] * z) * nz)
    if facing < -0.5 * math.sqrt(cu * cu + cv * cv + z * z):  # of a sum of three normals
        return False
    for k in range(4):
        if k == 0:
            x, y, d = mx, my, mz
        else:
            corner = a if k == 1 else b if k == 2 else c
            x, y, d = vertices[corner, 0], vertices[corner, 1], vertices[corner, 2]
        z = P[6] * x + P[7] * y + P[8] * d + P[11]
        if z <= 1e-9:
            continue
        u = P[12] * (P[0] * x + P[1] * y + P[2] * d + P[9]) / z + P[14]
        w = P[13] * (P[3] * x + P[4] * y + P[5] * d + P[10]) / z + P[15]
        if u < 0 or w < 0 or u >= P[16] or w >= P[17]:
            continue
        at = start + int(w) * int(P[16]) + int(u)
        if quality[at] > 0 and abs(nearness[at] * z - 1) <= tolerance:
            return True
    return False


@kernel
def shade(counter, view, vertices, faces, corners, nearness, owners, levels, starts, sizes, image):
    """Draws the texture of a mesh into one view.

    Args:
        counter: [1] shared; rows already taken.
        view: [COLUMNS] float64 row of the table of views, of which the camera is used.
        vertices: [V, 3] float64; faces: [F, 3] int64; corners: [V, 2] float64, in texels.
        nearness, owners: [H, W] as `draw` leaves them.
        levels: [L, 3] uint8, the texture and its halves, one after the other.
        starts: [K] int64 of each level; sizes: [K] int64 texels of its side.
        image: [H, W, 3] float32 in and out; what the mesh does not show stays.
    """
    height, width = owners.shape
    while True:
        first = fetch_add(counter, 0, AT_ONCE)
        if first >= height:
            break
        for row in range(first, min(first + AT_ONCE, height)):
            for column in range(width):
                f = owners[row, column]
                if f < 0:
                    continue
                z = 1.0 / nearness[row, column]
                lx = (column + 0.5 - view[14]) / view[12] * z - view[9]
                ly = (row + 0.5 - view[15]) / view[13] * z - view[10]
                lz = z - view[11]
                a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
                px = view[0] * lx + view[3] * ly + view[6] * lz - vertices[a, 0]
                py = view[1] * lx + view[4] * ly + view[7] * lz - vertices[a, 1]
                pz = view[2] * lx + view[5] * ly + view[8] * lz - vertices[a, 2]
                ex, ey, ez = (vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1],
                              vertices[b, 2] - vertices[a, 2])
                gx, gy, gz = (vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1],
                              vertices[c, 2] - vertices[a, 2])
                ee, gg = ex * ex + ey * ey + ez * ez, gx * gx + gy * gy + gz * gz
                eg = ex * gx + ey * gy + ez * gz
                pe, pg = px * ex + py * ey + pz * ez, px * gx + py * gy + pz * gz
                square = ee * gg - eg * eg
                if square <= 0:
                    continue
                wb = min(1.0, max(0.0, (gg * pe - eg * pg) / square))
                wc = min(1.0 - wb, max(0.0, (ee * pg - eg * pe) / square))
                wa = 1 - wb - wc
                x = wa * corners[a, 0] + wb * corners[b, 0] + wc * corners[c, 0]
                y = wa * corners[a, 1] + wb * corners[b, 1] + wc * corners[c, 1]
                texels = abs((corners[b, 0] - corners[a, 0]) * (corners[c, 1] - corners[a, 1])
                             - (corners[c, 0] - corners[a, 0]) * (corners[b, 1] - corners[a, 1]))
                # texels along a pixel, of a surface that faces the camera
                along = math.sqrt(texels / math.sqrt(square)) * z / view[12]
                level = min(len(sizes) - 1, max(0, round(math.log2(max(along, 1e-6)))))
                side = sizes[level]
                x, y = x * side / sizes[0] - 0.5, y * side / sizes[0] - 0.5
                left, top = math.floor(x), math.floor(y)
                sx, sy = x - left, y - top
                left_one, right_one = min(max(left, 0), side - 1), min(max(left + 1, 0), side - 1)
                upper = starts[level] + min(max(top, 0), side - 1) * side
                lower = starts[level] + min(max(top + 1, 0), side - 1) * side
                for channel in range(3):
                    image[row, column, channel] = (
                        (1 - sy) * ((1 - sx) * levels[upper + left_one, channel]
                                    + sx * levels[upper + right_one, channel])
                        + sy * ((1 - sx) * levels[lower + left_one, channel]
                                + sx * levels[lower + right_one, channel]))
