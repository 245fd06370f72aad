"""The nodes of a glTF scene: which meshes it shows, and where."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.io.splats.glb_container import Container
from recon_cli.scene.similarity import Similarity


def placed_meshes(container: Container) -> Iterator[tuple[dict[str, Any], Similarity]]:
    """Yields the meshes of the scene that is shown first, each with what leads it to the world.

    Raises:
        FormatError: nodes are missing, form a ring, or stretch, shear or mirror a mesh, which
            Gaussians do not survive as such.
    """
    scene = container.entry("scenes", container.json.get("scene", 0))
    left = [(node, np.eye(4)) for node in _indices(container, scene, "nodes")]
    seen: set[int] = set()
    while left:
        index, above = left.pop()
        if index in seen:
            raise container.damaged(f"the node {index} twice: no tree")
        seen.add(index)
        node = container.entry("nodes", index)
        with np.errstate(over="ignore", invalid="ignore"):  # such a matrix is refused below
            matrix = above @ _matrix(container, node)
        left += [(child, matrix) for child in _indices(container, node, "children")]
        if "mesh" in node:
            yield container.entry("meshes", node["mesh"]), _similarity(container, matrix)


def _indices(container: Container, entry: dict[str, Any], name: str) -> list[int]:
    value = entry.get(name, [])
    if not isinstance(value, list) or not all(type(index) is int for index in value):
        raise container.damaged(f"{name} = {value!r:.40}; needed are numbers of nodes")
    return value


def _matrix(container: Container, node: dict[str, Any]) -> NDArray[np.float64]:
    """Returns the matrix [4, 4] of a node, given as such or as its three parts."""
    if "matrix" in node:
        return _numbers(container, node, "matrix", np.eye(4).ravel()).reshape(4, 4).T
    x, y, z, w = _numbers(container, node, "rotation", np.array([0.0, 0, 0, 1]))
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
    matrix = np.eye(4)
    matrix[:3, :3] = turn * _numbers(container, node, "scale", np.ones(3))
    matrix[:3, 3] = _numbers(container, node, "translation", np.zeros(3))
    return matrix


def _numbers(
    container: Container, node: dict[str, Any], name: str, default: NDArray[np.float64]
) -> NDArray[np.float64]:
    value = node.get(name)
    if value is None:
        return default
    largest = float(np.finfo(np.float32).max)
    if not isinstance(value, list) or len(value) != len(default) or not all(
            type(one) in (int, float) and abs(one) <= largest for one in value):
        raise container.damaged(f"{name} = {value!r:.40}; needed are {len(default)} numbers")
    return np.array(value, np.float64)


def _similarity(container: Container, matrix: NDArray[np.float64]) -> Similarity:
    try:
        return Similarity.from_matrix(matrix)
    except ValueError as error:
        raise container.damaged(
            "a node that stretches, shears or mirrors its Gaussians") from error
