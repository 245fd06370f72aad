"""glTF with Gaussians: the binary .glb of KHR_gaussian_splatting.

One primitive of points: POSITION; ROTATION, a unit quaternion xyzw; SCALE, the standard deviations
themselves; OPACITY, after the sigmoid; SH_DEGREE_l_COEF_n, in INRIA's basis, signs and order; and
COLOR_0 for programs that know nothing of Gaussians. All are float32 but COLOR_0. Drafts of the
extension had logarithms in SCALE; a file that has numbers below 0 there is refused.

The world of glTF is right-handed with +Y up. A scene is turned into it when it is written, with its
coefficients, and turned back when it is read: by `Z_UP` for a scene whose z is up, by `Y_DOWN` for
one with the axes of a camera (x right, y down, z forward); one with y up stays.

The extension is https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/
KHR_gaussian_splatting.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.errors import InputError
from recon_cli.io.splats.glb_container import Container, contained
from recon_cli.io.splats.values import arrays, colored_rows, logit, sigmoid, unit_quats
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import SH_C0, TERMS, Splats, joined, transformed
from recon_cli.workspace.atomic import write_bytes


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


# [3, 3] from the scene's axes to those of glTF; numbers that are whole keep positions exact.
Z_UP: NDArray[np.float64] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
Y_DOWN: NDArray[np.float64] = np.diag([1.0, -1, -1])
Y_UP: NDArray[np.float64] = np.eye(3)
# As `asset.extras` tells which of them a scene had.
_AXES = {"z up": Z_UP, "y down": Y_DOWN, "y up": Y_UP}
_SAID = "scene_axes"

_NAME = "KHR_gaussian_splatting"
_PLAIN = (_NAME, "KHR_mesh_quantization")  # what can be read of extensions that a file demands
_COLOR_SPACE = "srgb_rec709_display"
_FLOAT, _BYTE, _VERTICES, _POINTS = 5126, 5121, 34962, 0
# The opacity next to 1 that float32 can tell from it: a logit has to be finite.
_LEAST_OPACITY = 2.0 ** -24
_LEAST_SCALE = float(np.finfo(np.float32).tiny)  # a flat Gaussian has a scale of 0
_LEAST_BYTES = 12  # of a Gaussian: its position
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_glb(path: Path, splats: Splats, *, axes: NDArray[np.float64] = Z_UP) -> None:
    """Writes `splats` to `path`, whole or not at all, in their order.

    Quaternions lose their length. An opacity nearer to 1 than float32 can tell becomes 1.

    Args:
        path: of the .glb.
        splats: at least one Gaussian.
        axes: [3, 3] rotation from the scene's axes to x right, y up, z back.

    Raises:
        InputError: there are no Gaussians, a value is not finite or a scale beyond float32, or
            the file would exceed 4 GiB.
    """
    table = arrays(transformed(splats, Similarity(rotation=axes)), ".glb")
    with np.errstate(over="ignore"):
        scales = np.exp(table["log_scales"])
    if not np.isfinite(scales).all():
        raise InputError("The scene holds Gaussians that are larger than any number.")
    opacities = sigmoid(table["logit_opacities"])[:, None]
    colors = (SH_C0 * table["sh_dc"] + 0.5).clip(0, 1)
    columns: dict[str, NDArray[Any]] = {
        "POSITION": table["means"],
        "COLOR_0": np.rint(np.hstack([colors, opacities]) * 255).astype(np.uint8),
        f"{_NAME}:ROTATION": table["quats"][:, [1, 2, 3, 0]],
        f"{_NAME}:SCALE": scales,
        f"{_NAME}:OPACITY": opacities.astype(np.float32),
        f"{_NAME}:SH_DEGREE_0_COEF_0": table["sh_dc"],
    }
    degree = TERMS.index(table["sh_rest"].shape[1])
    columns |= {name: table["sh_rest"][:, at] for at, name in enumerate(_coefficients(degree))}
    described = _described(columns)
    for name, known in _AXES.items():
        if np.array_equal(axes, known):
            described["asset"]["extras"] = {_SAID: name}
    write_bytes(path, contained(described, b"".join(
        np.ascontiguousarray(column).tobytes() for column in columns.values())))


def nearest_axes(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the one of the known axes whose up is nearest to a unit vector [3]."""
    return max(_AXES.values(), key=lambda axes: float(axes[1] @ up))


def _coefficients(degree: int) -> list[str]:
    """Returns the names of the attributes of degrees 1 to `degree`, in the order of `sh_rest`."""
    return [f"{_NAME}:SH_DEGREE_{one}_COEF_{at}"
            for one in range(1, degree + 1) for at in range(2 * one + 1)]


def _described(columns: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Returns the JSON for columns that lie one behind the other."""
    views, accessors, start = [], [], 0
    for at, (name, column) in enumerate(columns.items()):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": column.nbytes,
                      "target": _VERTICES})
        start += column.nbytes
        accessor: dict[str, Any] = {
            "bufferView": at, "componentType": _FLOAT, "count": len(column),
            "type": _TYPES[column.shape[1]]}
        if column.dtype == np.uint8:
            accessor |= {"componentType": _BYTE, "normalized": True}
        if name == "POSITION":
            accessor |= {"min": column.min(axis=0).tolist(), "max": column.max(axis=0).tolist()}
        accessors.append(accessor)
    return {
        "asset": {"version": "2.0", "generator": "recon"}, "extensionsUsed": [_NAME],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{
            "attributes": {name: at for at, name in enumerate(columns)}, "mode": _POINTS,
            "extensions": {_NAME: {"kernel": "ellipse", "colorSpace": _COLOR_SPACE}}}]}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": start}],
    }


def read_glb(path: Path, *, axes: NDArray[np.float64] | None = None) -> Splats:
    """Returns the Gaussians of a .glb as float32 tensors; other points and meshes are left out.

    The order is the file's; where several primitives hold Gaussians, those with coefficients come
    first. Behind the last one of a primitive that has any, Gaussians are of degree 0.

    Args:
        path: of the .glb.
        axes: [3, 3] rotation from the axes that are wanted to those of glTF, as in `write_glb`;
            None for those that the file says the scene had, or else `Z_UP`.

    Raises:
        FormatError: the file is missing or damaged, holds no Gaussians, or asks for more than is
            known here: compression, another kernel, linear colours, nodes that stretch.
    """
    container = Container(path)
    required = container.json.get("extensionsRequired", [])
    if not isinstance(required, list) or not all(name in _PLAIN for name in required):
        raise container.damaged(f"what needs the extensions {required!r:.200}")
    parts, total = [], 0
    for mesh, place in placed_meshes(container):
        for primitive, said in _primitives(container, mesh):
            part = _read_primitive(container, primitive, said)
            total += len(part)
            if total * _LEAST_BYTES > container.size:
                raise container.damaged(f"{total} Gaussians in {container.size} bytes")
            parts.append(transformed(part, place))
    if not parts:
        raise container.damaged(f"no Gaussians: no primitive with {_NAME}")
    degree = max(part.sh_degree for part in parts)
    splats = parts[0] if len(parts) == 1 else joined(
        [part.with_degree(degree) for part in parts])[0]
    if not all(torch.isfinite(value).all() for value in splats.parameters().values()):
        raise container.damaged("values beyond any number")
    if axes is None:
        axes = _AXES.get(_said_axes(container.json), Z_UP)
    return transformed(splats, Similarity(rotation=axes.T))


def _said_axes(value: Mapping[str, Any]) -> str:
    """Returns which axes a file says the scene had; empty where it says nothing."""
    inner: Any = value
    for key in ("asset", "extras", _SAID):
        inner = inner.get(key) if isinstance(inner, Mapping) else None
    return inner if isinstance(inner, str) else ""


def _primitives(
    container: Container, mesh: dict[str, Any]
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Yields the primitives of Gaussians, each with what the extension says of it."""
    primitives = mesh.get("primitives")
    if not isinstance(primitives, list):
        raise container.damaged("a mesh without primitives")
    for primitive in primitives:
        extensions = primitive.get("extensions", {}) if isinstance(primitive, dict) else None
        if not isinstance(extensions, dict):
            raise container.damaged("a primitive that is none")
        said = extensions.get(_NAME)
        if isinstance(said, dict):
            yield primitive, said


def _read_primitive(
    container: Container, primitive: dict[str, Any], said: dict[str, Any]
) -> Splats:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or primitive.get("mode") != _POINTS:
        raise container.damaged("Gaussians that are no points")
    if said.get("extensions"):
        raise container.damaged(f"Gaussians with the extensions {said['extensions']!r:.200}")
    for name, known in (("kernel", "ellipse"), ("colorSpace", _COLOR_SPACE)):
        if said.get(name) != known:
            raise container.damaged(f"the {name} {said.get(name)!r:.40}; {known} can be read")

    def values(name: str, kind: str) -> NDArray[np.float64]:
        if name not in attributes:
            raise container.damaged(f"Gaussians without {name}")
        return container.values(attributes[name], kind)

    means = values("POSITION", "VEC3")
    scales, opacities = values(f"{_NAME}:SCALE", "VEC3"), values(f"{_NAME}:OPACITY", "SCALAR")
    if scales.min() < 0 or opacities.min() < 0 or opacities.max() > 1:
        raise container.damaged("scales below 0 or opacities beyond 0 to 1: a draft of the format?")
    present = [name for name in _coefficients(3) if name in attributes]
    if len(present) not in TERMS or present != _coefficients(TERMS.index(len(present))):
        raise container.damaged(f"{len(present)} coefficients, which make no degree")
    rest = [values(name, "VEC3") for name in present]
    table: dict[str, NDArray[Any]] = {
        "means": means,
        "quats": unit_quats(values(f"{_NAME}:ROTATION", "VEC4")[:, [3, 0, 1, 2]]),
        "log_scales": np.log(np.maximum(scales, _LEAST_SCALE)),
        "logit_opacities": logit(opacities[:, 0], _LEAST_OPACITY),
        "sh_dc": values(f"{_NAME}:SH_DEGREE_0_COEF_0", "VEC3"),
    }
    if {len(column) for column in (*table.values(), *rest)} != {len(means)}:
        raise container.damaged("attributes of different lengths")
    table["sh_rest"] = colored_rows(
        np.stack(rest, axis=1) if rest else np.zeros((len(means), 0, 3)))
    return Splats(**{name: torch.from_numpy(value.astype(np.float32))
                     for name, value in table.items()})
