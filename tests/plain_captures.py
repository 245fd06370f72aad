"""Cameras and files for captures that are written field by field, with axes turned by hand."""

import json
import math

import numpy as np
from PIL import Image

COUNT, WIDTH, HEIGHT = 5, 64, 48
FX, FY, CX, CY = 50.0, 51.0, 33.0, 23.0
DW, DH = 16, 12
DEPTH = 1 + 0.1 * np.arange(DH)[:, None] + 0.01 * np.arange(DW)  # metres; no symmetry
T0 = 1000.25


def looking(at):
    """Returns position [3] and the axes right, down, ahead of a camera, z up."""
    yaw, pitch, roll = 0.3 * at, -0.2 + 0.05 * at, 0.04 * at
    ahead = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch),
                      math.sin(pitch)])
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    right, down = (math.cos(roll) * right + math.sin(roll) * down,
                   -math.sin(roll) * right + math.cos(roll) * down)
    return np.array([0.5 * at, 0.2 * at * at, 1.5 + 0.1 * at]), (right, down, ahead)


def matrix(position, *axes):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack(axes, axis=1), position
    return pose


TRUTH = [matrix(place, *axes) for place, axes in map(looking, range(COUNT))]


def y_up(vector):
    """(x, y, z) of a world with y up, of a vector of the one with z up."""
    x, y, z = vector
    return np.array([x, z, -y])


def arkit(at):
    """Camera to world of ARKit: y up, the camera looks along -z."""
    place, (right, down, ahead) = looking(at)
    return matrix(y_up(place), y_up(right), y_up(-down), y_up(-ahead))


def quat(pose):
    """x y z w, of a rotation whose trace is large enough, else by the largest diagonal."""
    m = pose[:3, :3]
    values = np.array([
        1 + m[0, 0] - m[1, 1] - m[2, 2], 1 - m[0, 0] + m[1, 1] - m[2, 2],
        1 - m[0, 0] - m[1, 1] + m[2, 2], 1 + np.trace(m)])
    largest = int(values.argmax())
    size = math.sqrt(values[largest]) / 2
    x, y, z, w = np.sqrt(np.maximum(values, 0)) / 2
    if largest == 3:
        x, y, z = (np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / (4 * size))
    else:
        one, two, three = [(0, 1, 2), (1, 2, 0), (2, 0, 1)][largest]
        found = np.zeros(3)
        found[one] = size
        found[two] = (m[one, two] + m[two, one]) / (4 * size)
        found[three] = (m[one, three] + m[three, one]) / (4 * size)
        x, y, z = found
        w = (m[three, two] - m[two, three]) / (4 * size)
    return [float(value) for value in (x, y, z, w)]


def picture(path, size=(WIDTH, HEIGHT), seed=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), np.uint8)
    Image.fromarray(values).save(path)


def gray(path, values, kind):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values.astype(kind)).save(path)


def text(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))


def check(posed, *, relative=False, depth=True, inner=(FX, FY, CX, CY), count=COUNT):
    """Asserts the cameras, in the order of the capture, z up where up is known."""
    images = [image for image in posed.images if "right" not in image.name]
    assert len(images) == count, posed.notices
    found = [np.linalg.inv(image.viewmat) for image in images]
    if posed.up == (0, 1, 0):
        turn = np.eye(4)
        turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        found = [turn @ pose for pose in found]
    truth = TRUTH[:count]
    if relative:
        found = [np.linalg.inv(found[0]) @ pose for pose in found]
        truth = [np.linalg.inv(TRUTH[0]) @ pose for pose in truth]
    np.testing.assert_allclose(found, truth, atol=2e-5)
    for image in images:
        np.testing.assert_allclose(image.lens.params[:4], inner, atol=1e-4)
        assert (image.depth is not None) == depth
        if depth:
            np.testing.assert_allclose(image.depth.read(), DEPTH, atol=6e-4)
            own = image.depth.own_lens(DW, DH)
            np.testing.assert_allclose(own.params[:4], (
                FX * DW / WIDTH, FY * DH / HEIGHT, CX * DW / WIDTH, CY * DH / HEIGHT), atol=1e-4)
