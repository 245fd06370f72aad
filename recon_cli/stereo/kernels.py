"""The loops over pixels, hypotheses and neighbours of dense stereo (`depths.py`).

What is computed for a view does not depend on the thread that takes it.
"""

from __future__ import annotations

import math

import numpy as np

from recon_cli.kernels.kernel import inlined, kernel
from recon_cli.kernels.simd_functions import fetch_add

# Chosen on the room "living" and checked on "office"; all are flat around:
_NOISE = np.float32(2.0)  # squared grey levels added to variances: blank windows correlate little
_MOST_DIFFERENCE = np.float32(4.0)  # grey levels from which on two pixels differ altogether
_LEAST_SCORE = np.float32(-0.4)  # of a window and another view's; what hides a surface counts so
_LEAST_Z = np.float32(1e-6)
_SMALL_STEP, _LARGE_STEP = 0.1, 0.8  # penalties of a step by one hypothesis, and by more
_EDGE = 8.0  # gradient in grey levels a pixel at which the larger penalty has fallen to 1/e
_LEAST_PENALTY = 0.15  # of the larger one, across any edge
# Of planes through blank regions:
_REACH, _STRIDE = 12, 2  # pixels; every second one is looked at
_GREY = 5.0  # standard deviation of grey levels that belong to a region
_SPREADS = (1.0, 0.6, 0.6)  # hypotheses off a plane, in each round
_UNSURE = 0.01  # weight of a depth that no other view agrees with
_CUT = 8.0  # squared deviations from which on a pixel counts nothing
_SLOPE = 0.5  # squared pixels added to the spread of places: few of them tell no slope
_LEAST_BLANK = 0.05  # of a pixel, for a plane to be looked for


_ZERO, _ONE = np.float32(0), np.float32(1)
_SUMS = 4  # of a window: values, squares, products with the view's own, absolute differences


@kernel
def match(
    counter, rows, images, starts, cameras, others, radius, normal, base, lowest, steps, hypotheses,
    inverse, least,
):
    """Finds the inverse depth of every pixel of some views by semi-global matching.

    A hypothesis is a plane across the view: surfaces along the planes cost no steps, and windows
    follow them (Gallup et al. 2007). Its cost is one minus the normalized correlation of a window
    with those where it falls in other views, plus their mean difference, so that smooth shading
    counts where texture is missing. A view in which something hides the surface costs no more than
    `_LEAST_SCORE` says. Costs are made smooth along eight directions
    (Hirschmueller 2008), less so across edges of the image.

    Args:
        counter: [1] shared; views already taken.
        rows: [R] int64 the views.
        images: [P] float32 grey images in 0 to 255, one after the other; starts: [V] of each.
        cameras: [V, 18] rotation, translation, fx, fy, cx, cy, width and height of each.
        others: [V, K] int64 views that each is compared with, -1 for none.
        radius: of the windows, 1 or 2 pixels.
        normal: [3] of the planes, world axes; zero for planes parallel to each image.
        base: [P] float32, inverse depth that is added to that of the planes.
        lowest: [V] inverse distance from the camera of the first plane; steps: [V] between two.
        hypotheses: how many each pixel has, at least 3.
        inverse: [P] float32 in and out, inverse depth in world units, 0 for none.
        least: [P] float32 in and out, the cost of `inverse`, infinite at first. Both stay where no
            hypothesis costs less, or the best one is the first or last.
    """
    while True:
        taken = fetch_add(counter, 0, 1)
        if taken >= len(rows):
            break
        own = rows[taken]
        width, height = int(cameras[own, 16]), int(cameras[own, 17])
        at, size = starts[own], width * height
        image = images[at:at + size].reshape(height, width)
        count = 0
        while count < others.shape[1] and others[own, count] >= 0:
            count += 1
        if count == 0:
            continue
        prior = base[at:at + size].reshape(height, width)
        slants = _slants(cameras[own], normal, height, width)
        costs = np.empty((height, width, hypotheses), np.float32)
        _fill_costs(costs, images, starts, cameras, own, others[own, :count], radius, image, prior,
                    slants, lowest[own], steps[own])
        total = np.zeros((height, width, hypotheses), np.float32)
        penalty = _penalties(image)
        _add_along_rows(total, costs, penalty)
        _add_along_columns(total, costs, penalty)
        _choose(inverse[at:at + size].reshape(height, width),
                least[at:at + size].reshape(height, width), total, prior, slants,
                lowest[own], steps[own])


@kernel
def _slants(P, normal, height, width):
    """Returns the inverse depth [H, W] of a plane at a distance of 1 from camera P."""
    x, y, z = (P[0] * normal[0] + P[1] * normal[1] + P[2] * normal[2],
               P[3] * normal[0] + P[4] * normal[1] + P[5] * normal[2],
               P[6] * normal[0] + P[7] * normal[1] + P[8] * normal[2])
    if x == 0 and y == 0 and z == 0:
        z = 1.0
    slants = np.empty((height, width), np.float32)
    for row in range(height):
        for column in range(width):
            slants[row, column] = abs(x * (column + 0.5 - P[14]) / P[12]
                                      + y * (row + 0.5 - P[15]) / P[13] + z)
    return slants


@kernel
def _fill_costs(
    costs, images, starts, cameras, own, others, radius, image, base, slants, lowest, step,
):
    """Writes the cost of every hypothesis, [H, W, D].

    Windows are summed row by row: a ring of rows holds the sums along x of what is needed.
    """
    height, width, hypotheses = costs.shape
    rows = 2 * radius + 1
    padded = np.empty((_SUMS, width + 2 * radius), np.float32)
    ring = np.empty((rows, _SUMS, width), np.float32)
    inside = np.empty((rows, width), np.float32)
    place = np.empty((3, width), np.float32)
    sums = np.empty((_SUMS, width), np.float32)
    mean, spread = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    scale = np.float32(1 / rows**2)
    for y in range(height + radius):
        if y < height:
            _push_row(ring[y % rows], padded, image[y], image[y], radius)
        if y >= radius:
            _sum_rows(sums, ring, y - radius, radius, height)
            for x in range(width):
                a = sums[0, x] * scale
                mean[y - radius, x] = a
                spread[y - radius, x] = max(sums[1, x] * scale - a * a, _ZERO) + _NOISE
    score, seen = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for d in range(hypotheses):
        score[:] = 0
        seen[:] = 0
        for other in others:
            Q = cameras[other]
            R, t = _relative(cameras[own], Q)
            for y in range(height + radius):
                if y < height:
                    _warp_row(padded[0, radius:radius + width], inside[y % rows], place,
                              images[starts[other]:], cameras[own], Q, R, t, y, base[y], slants[y],
                              lowest + step * d)
                    _push_row(ring[y % rows], padded, padded[0, radius:radius + width], image[y],
                              radius)
                if y >= radius:
                    _sum_rows(sums, ring, y - radius, radius, height)
                    row = y - radius
                    _add_scores(score[row], seen[row], sums, inside[row % rows], mean[row],
                                spread[row], scale)
        for y in range(height):
            for x in range(width):
                costs[y, x, d] = _ONE - score[y, x] / max(seen[y, x], _ONE)


@kernel
def _relative(P, Q):
    """Returns rotation [3, 3] and translation [3] from the axes of camera P to those of Q."""
    R, t = np.empty((3, 3)), np.empty(3)
    for i in range(3):
        t[i] = Q[9 + i]
        for j in range(3):
            R[i, j] = (Q[3 * i] * P[3 * j] + Q[3 * i + 1] * P[3 * j + 1]
                       + Q[3 * i + 2] * P[3 * j + 2])
            t[i] -= R[i, j] * P[9 + j]
    return R, t


@inlined
def _warp_row(warped, inside, place, other, P, Q, R, t, y, base, slant, shift):
    """Reads another image where a row falls at the inverse depths base + slant * shift."""
    width = len(warped)
    wide, tall = int(Q[16]), int(Q[17])
    b, first, slope = (y + 0.5 - P[15]) / P[13], (0.5 - P[14]) / P[12], 1 / P[12]
    # u = (a line in x + inverse depth * a constant) / z + cx - .5, in pixels
    u0, u1, u2 = (np.float32(Q[12] * (R[0, 0] * first + R[0, 1] * b + R[0, 2])),
                  np.float32(Q[12] * R[0, 0] * slope), np.float32(Q[12] * t[0]))
    v0, v1, v2 = (np.float32(Q[13] * (R[1, 0] * first + R[1, 1] * b + R[1, 2])),
                  np.float32(Q[13] * R[1, 0] * slope), np.float32(Q[13] * t[1]))
    z0, z1, z2 = (np.float32(R[2, 0] * first + R[2, 1] * b + R[2, 2]), np.float32(R[2, 0] * slope),
                  np.float32(t[2]))
    cx, cy, moved = np.float32(Q[14] - 0.5), np.float32(Q[15] - 0.5), np.float32(shift)
    right, bottom = np.float32(wide - 1), np.float32(tall - 1)
    us, vs, xs = place[0], place[1], place[2]
    for x in range(width):
        xs[x] = np.float32(x)
    for x in range(width):
        inverse = base[x] + slant[x] * moved
        z = z0 + z1 * xs[x] + z2 * inverse
        one_over = _ONE / z
        u = (u0 + u1 * xs[x] + u2 * inverse) * one_over + cx
        v = (v0 + v1 * xs[x] + v2 * inverse) * one_over + cy
        shown = z > _LEAST_Z and inverse > 0 and u >= 0 and v >= 0 and u <= right and v <= bottom
        inside[x] = _ONE if shown else _ZERO
        us[x] = min(max(u, _ZERO), right) if shown else _ZERO
        vs[x] = min(max(v, _ZERO), bottom) if shown else _ZERO
    for x in range(width):
        i, j = min(int(us[x]), wide - 2), min(int(vs[x]), tall - 2)
        du, dv = us[x] - np.float32(i), vs[x] - np.float32(j)
        at = np.uintp(j * wide + i)
        low = np.uintp(j * wide + i + wide)
        one = np.uintp(1)
        top = other[at] + du * (other[at + one] - other[at])
        down = other[low] + du * (other[low + one] - other[low])
        warped[x] = top + dv * (down - top)


@inlined
def _push_row(slot, padded, warped, image, radius):
    """Writes sums along x of values, squares, products and differences of a row, [4, W].

    Beyond its ends a row repeats its last value. `warped` may be a part of `padded`.
    """
    width = len(image)
    here = slice(radius, radius + width)
    values, squares, products, differences = (
        padded[0, here], padded[1, here], padded[2, here], padded[3, here])
    for x in range(width):
        value = warped[x]
        values[x] = value
        squares[x] = value * value
        products[x] = value * image[x]
        differences[x] = min(abs(value - image[x]), _MOST_DIFFERENCE)
    for row in range(_SUMS):
        for x in range(radius):
            padded[row, x] = padded[row, radius]
            padded[row, radius + width + x] = padded[row, radius + width - 1]
        result = slot[row]
        first, second, third = (
            padded[row, :width], padded[row, 1:width + 1], padded[row, 2:width + 2])
        for x in range(width):
            result[x] = first[x] + second[x] + third[x]
        if radius == 2:
            fourth, fifth = padded[row, 3:width + 3], padded[row, 4:width + 4]
            for x in range(width):
                result[x] += fourth[x] + fifth[x]


@inlined
def _sum_rows(sums, ring, y, radius, height):
    """Writes the sums [4, W] of the windows about a row."""
    width = sums.shape[1]
    rows = 2 * radius + 1
    middle = y % rows
    above, below = max(y - 1, 0) % rows, min(y + 1, height - 1) % rows
    for row in range(_SUMS):
        result = sums[row]
        first, second, third = ring[above, row], ring[middle, row], ring[below, row]
        for x in range(width):
            result[x] = first[x] + second[x] + third[x]
        if radius == 2:
            fourth = ring[max(y - 2, 0) % rows, row]
            fifth = ring[min(y + 2, height - 1) % rows, row]
            for x in range(width):
                result[x] += fourth[x] + fifth[x]


@inlined
def _add_scores(score, seen, sums, inside, mean, spread, scale):
    """Adds the scores of a row: correlation less mean difference, at least `_LEAST_SCORE`."""
    values, squares, products, differences = sums[0], sums[1], sums[2], sums[3]
    weight = scale / _MOST_DIFFERENCE
    for x in range(len(score)):
        b = values[x] * scale
        other = max(squares[x] * scale - b * b, _ZERO) + _NOISE
        value = ((products[x] * scale - mean[x] * b) / np.sqrt(spread[x] * other)
                 - differences[x] * weight)
        score[x] += inside[x] * max(value, _LEAST_SCORE)
        seen[x] += inside[x]


@kernel
def _penalties(image):
    """Returns the share [H, W] of the larger penalty that counts at each pixel."""
    height, width = image.shape
    shares = np.empty((height, width), np.float32)
    for y in range(height):
        for x in range(width):
            across = image[y, min(x + 1, width - 1)] - image[y, max(x - 1, 0)]
            down = image[min(y + 1, height - 1), x] - image[max(y - 1, 0), x]
            gradient = 0.5 * math.sqrt(across * across + down * down)
            shares[y, x] = max(math.exp(-gradient / _EDGE), _LEAST_PENALTY)
    return shares


@inlined
def _extend(now, before, costs, large):
    """Writes the least costs of paths that end at a pixel, from those of the one before."""
    count = len(now)
    least = before[0]
    for d in range(1, count):
        least = min(least, before[d])
    most, small = np.float32(large), np.float32(_SMALL_STEP)
    for d in range(count):
        path = min(before[d] - least, most)
        if d > 0:
            path = min(path, before[d - 1] - least + small)
        if d < count - 1:
            path = min(path, before[d + 1] - least + small)
        now[d] = costs[d] + path


@kernel
def _add_along_rows(total, costs, penalty):
    """Adds the least costs of paths from the left and from the right."""
    height, width, hypotheses = costs.shape
    before, now = np.empty(hypotheses, np.float32), np.empty(hypotheses, np.float32)
    for y in range(height):
        for way in range(2):
            for i in range(width):
                x = i if way == 0 else width - 1 - i
                if i == 0:
                    now[:] = costs[y, x]
                else:
                    last = x - 1 if way == 0 else x + 1
                    _extend(now, before, costs[y, x],
                            _LARGE_STEP * min(penalty[y, x], penalty[y, last]))
                for d in range(hypotheses):
                    total[y, x, d] += now[d]
                before, now = now, before


@kernel
def _add_along_columns(total, costs, penalty):
    """Adds the least costs of paths from above and below, straight and diagonal."""
    height, width, hypotheses = costs.shape
    before = np.empty((width, hypotheses), np.float32)
    now = np.empty((width, hypotheses), np.float32)
    for way in range(2):
        for slope in range(-1, 2):
            for i in range(height):
                y = i if way == 0 else height - 1 - i
                last = y - 1 if way == 0 else y + 1
                for x in range(width):
                    beside = x - slope
                    if i == 0 or beside < 0 or beside >= width:
                        now[x] = costs[y, x]
                    else:
                        _extend(now[x], before[beside], costs[y, x],
                                _LARGE_STEP * min(penalty[y, x], penalty[last, beside]))
                    for d in range(hypotheses):
                        total[y, x, d] += now[x, d]
                before, now = now, before


@kernel
def _choose(inverse, least, total, base, slants, lowest, step):
    """Writes the hypothesis of least cost, between its neighbours by a parabola."""
    height, width, hypotheses = total.shape
    for y in range(height):
        for x in range(width):
            best = 0
            for d in range(1, hypotheses):
                if total[y, x, d] < total[y, x, best]:
                    best = d
            if best == 0 or best == hypotheses - 1 or total[y, x, best] >= least[y, x]:
                continue
            least[y, x] = total[y, x, best]
            left, middle, right = total[y, x, best - 1], total[y, x, best], total[y, x, best + 1]
            bend = left - 2 * middle + right
            offset = 0.5 * (left - right) / bend if bend > 1e-6 else 0.0
            inverse[y, x] = max(
                base[y, x] + slants[y, x] * (lowest + step * (best + offset)), 0.0)


@kernel
def lay_planes(counter, inverse, image, confirmed, blank, step, plane_depth):
    """Lays a plane through the inverse depths about each blank pixel.

    An inverse depth that is linear in the place in the image is a plane in the room. Each is fitted
    to what is as bright and near the plane so far, by weights that fall off like a Gaussian.

    Args:
        counter: [1] shared; rows already taken.
        inverse: [H, W] float32, 0 for none; image: [H, W] float32 grey levels.
        confirmed: [H, W] whether another view agrees; blank: [H, W] float32, share of the plane.
        step: between two hypotheses.
        plane_depth: [H, W] float32 out.
    """
    height, width = inverse.shape
    while True:
        y = fetch_add(counter, 0, 1)
        if y >= height:
            break
        for x in range(width):
            at, across, down = float(inverse[y, x]), 0.0, 0.0
            plane_depth[y, x] = inverse[y, x]
            if blank[y, x] < _LEAST_BLANK or at <= 0:
                continue
            grey = 1 / (_GREY * _GREY)
            for turn in range(len(_SPREADS)):
                spread = step * _SPREADS[turn]
                depth = 1 / (spread * spread)
                n = sx = sy = sv = xx = xy = yy = xv = yv = 0.0
                for j in range(-_REACH, _REACH + 1, _STRIDE):
                    if y + j < 0 or y + j >= height:
                        continue
                    for i in range(-_REACH, _REACH + 1, _STRIDE):
                        if x + i < 0 or x + i >= width:
                            continue
                        v = float(inverse[y + j, x + i])
                        off = v - (at + across * i + down * j)
                        other = image[y + j, x + i] - image[y, x]
                        off = off * off * depth + other * other * grey
                        if v <= 0 or off >= _CUT:
                            continue
                        w = 1 - off / _CUT  # to the fourth about exp(-off / 2)
                        w *= w
                        w *= w
                        if not confirmed[y + j, x + i]:
                            w *= _UNSURE
                        n += w
                        sx += w * i
                        sy += w * j
                        sv += w * v
                        xx += w * i * i
                        xy += w * i * j
                        yy += w * j * j
                        xv += w * i * v
                        yv += w * j * v
                mx, my, mv = sx / n, sy / n, sv / n  # the pixel itself counts: n > 0
                xx, yy, xy = xx / n - mx * mx + _SLOPE, yy / n - my * my + _SLOPE, xy / n - mx * my
                xv, yv = xv / n - mx * mv, yv / n - my * mv
                divisor = xx * yy - xy * xy
                across, down = (xv * yy - yv * xy) / divisor, (yv * xx - xv * xy) / divisor
                at = mv - across * mx - down * my
            plane_depth[y, x] += blank[y, x] * (max(at, 0.0) - inverse[y, x])


@kernel
def compare(counter, maps, starts, cameras, own, others, tolerance, near, agree, through):
    """Counts, for each pixel of a depth map, the other maps that agree and that see through it.

    Args:
        counter: [1] shared; rows already taken.
        maps: [P] float32, all depth maps one after the other, 0 for none; starts: [C] of each.
        cameras: [C, 18] rotation, translation, fx, fy, cx, cy, width and height of each.
        own: number of the map; others: [K] int64 numbers of those that it is compared with.
        tolerance: of the depth, within which surfaces agree; near: least depth, world units.
        agree: [H * W] int32 out; so is through.
    """
    P, start = cameras[own], starts[own]
    width, height = int(P[16]), int(P[17])
    while True:
        y = fetch_add(counter, 0, 1)
        if y >= height:
            break
        for x in range(width):
            at = y * width + x
            agree[at] = through[at] = 0
            d = maps[start + at]
            if d <= near:
                continue
            cx = (x + 0.5 - P[14]) / P[12] * d - P[9]
            cy = (y + 0.5 - P[15]) / P[13] * d - P[10]
            cz = d - P[11]
            wx = P[0] * cx + P[3] * cy + P[6] * cz
            wy = P[1] * cx + P[4] * cy + P[7] * cz
            wz = P[2] * cx + P[5] * cy + P[8] * cz
            for other in others:
                Q = cameras[other]
                z = Q[6] * wx + Q[7] * wy + Q[8] * wz + Q[11]
                if z <= near:
                    continue
                u = Q[12] * (Q[0] * wx + Q[1] * wy + Q[2] * wz + Q[9]) / z + Q[14]
                v = Q[13] * (Q[3] * wx + Q[4] * wy + Q[5] * wz + Q[10]) / z + Q[15]
                if u < 0 or v < 0 or u >= Q[16] or v >= Q[17]:
                    continue
                seen = maps[starts[other] + int(v) * int(Q[16]) + int(u)]
                if seen <= 0:
                    continue
                if z < seen - tolerance * z:
                    through[at] += 1
                elif z <= seen + tolerance * z:
                    agree[at] += 1
