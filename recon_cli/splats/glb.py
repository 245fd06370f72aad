"""glTF with Gaussians: the binary .glb of KHR_gaussian_splatting, and its container.

One primitive of points: POSITION; ROTATION, a unit quaternion xyzw; SCALE, the standard deviations
themselves; OPACITY, after the sigmoid; SH_DEGREE_l_COEF_n, in INRIA's basis, signs and order; and
COLOR_0 for programs that know nothing of Gaussians, linear as all colours of vertices in glTF. All
are float32: 8 bits are too few for dark linear colours, and of 16 trimesh and MeshLab read the
lower 8. Drafts of the extension had logarithms in SCALE; a file that has numbers below 0 there is
refused. A program that does not know the extension keeps the attributes and may leave out its
entry; such a file is read, with a warning.

The world of glTF is right-handed with +Y up. A scene is rotated into it, with its coefficients,
when it is written, and back when it is read: by `Z_UP` for a scene whose z is up, by `Y_DOWN` for
one with the axes of a camera (x right, y down, z forward); one with y up stays.

Every length and offset of the container is checked against the file before it is used. Sources:
https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, sections 3.6 and 4, and
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting.
"""

from __future__ import annotations

import json
import logging
import struct
from collections.abc import Iterator, Mapping
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, InputError
from recon_cli.io.calibration import rotation_matrix
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splat_arrays import SH_C0, TERMS, SplatArrays
from recon_cli.splats.axes import nearest_up
from recon_cli.splats.foreign import (
    NOT_GAUSSIANS_HINT,
    accept_surplus,
    drop_not_finite,
    warn_of_degree,
)
from recon_cli.splats.format import LoadedScene, SplatFormat, WriteSettings
from recon_cli.splats.values import (
    UntrustedFile,
    linear_from_srgb,
    logit,
    normalize_quats,
    sigmoid,
    splats_from_arrays,
    to_arrays,
)
from recon_cli.workspace.atomic import write_bytes

if TYPE_CHECKING:
    from recon_cli.scene.splats import Splats

# [3, 3] from the scene's axes to those of glTF; whole numbers keep positions exact.
Z_UP: NDArray[np.float64] = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
Y_DOWN: NDArray[np.float64] = np.diag([1.0, -1, -1])
Y_UP: NDArray[np.float64] = np.eye(3)
# By the names under which `asset.extras` records the axes of the scene.
_AXES = {"z up": Z_UP, "y down": Y_DOWN, "y up": Y_UP}
_AXES_KEY = "scene_axes"
_UP = {"z": Z_UP, "-y": Y_DOWN, "y": Y_UP}
_NAME = "KHR_gaussian_splatting"
_SUPPORTED = (_NAME, "KHR_mesh_quantization")  # of the extensions that a file may require
_COLOR_SPACE = "srgb_rec709_display"
_DEFAULTS = {"kernel": "ellipse", "colorSpace": _COLOR_SPACE}
# Distance from 1 of the nearest opacity below it in float32: a logit has to be finite.
_LEAST_OPACITY = float(np.finfo(np.float32).epsneg)
_LEAST_SCALE = float(np.finfo(np.float32).tiny)  # a flat Gaussian has a scale of 0
_LEAST_BYTES = np.dtype("3f4").itemsize  # of a Gaussian: its position
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MAGIC, _VERSION = b"glTF", 2
_JSON, _BIN = b"JSON", b"BIN\0"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_JSON_LIMIT = 1 << 22  # bytes; a scene needs a thousandth of it
_LARGEST = int(np.iinfo(np.uint32).max)  # bytes: the header's length has 32 bits
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}

logger = logging.getLogger("recon")


class _Gl(IntEnum):
    """Numbers of OpenGL that glTF takes over."""

    POINTS = 0
    FLOAT = 5126
    ARRAY_BUFFER = 34962


def write_glb(path: Path, splats: Splats, *, axes: NDArray[np.float64] = Z_UP) -> None:
    """Writes `splats` to `path`, whole or not at all, in their order.

    Quaternions are normalized. An opacity nearer to 1 than float32 can represent becomes 1. `axes`
    is the [3, 3] rotation from the scene's axes to x right, y up, z back. FormatError if there are
    no Gaussians or a value is not finite; InputError if a scale exceeds float32, or the file 4 GiB.
    """
    from recon_cli.scene.splats import transformed  # imports torch

    table = to_arrays(transformed(splats, Similarity(rotation=axes)), ".glb")
    with np.errstate(over="ignore"):
        scales = np.exp(table["log_scales"])
    if not np.isfinite(scales).all():
        raise InputError(
            "The scene holds Gaussians whose size overflows float32.",
            hint="Leave glb out of --format, or take the large ones away with --crop.")
    opacities = sigmoid(table["logit_opacities"])[:, None]
    colors = (SH_C0 * table["sh_dc"] + 0.5).clip(0, 1)
    columns: dict[str, NDArray[Any]] = {
        "POSITION": table["means"],
        "COLOR_0": np.hstack([linear_from_srgb(colors), opacities]).astype(np.float32),
        f"{_NAME}:ROTATION": table["quats"][:, [1, 2, 3, 0]],
        f"{_NAME}:SCALE": scales,
        f"{_NAME}:OPACITY": opacities.astype(np.float32),
        f"{_NAME}:SH_DEGREE_0_COEF_0": table["sh_dc"],
    }
    degree = TERMS.index(table["sh_rest"].shape[1])
    columns |= {name: table["sh_rest"][:, at] for at, name in enumerate(_coefficient_names(degree))}
    gltf = _describe(columns)
    for name, known in _AXES.items():
        if np.array_equal(axes, known):
            gltf["asset"]["extras"] = {_AXES_KEY: name}
    write_bytes(path, pack_glb(gltf, b"".join(
        np.ascontiguousarray(column).tobytes() for column in columns.values())))


def nearest_axes(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns Z_UP, Y_DOWN or Y_UP, whichever has its up nearest to a unit vector [3]."""
    return _UP[nearest_up(up)]


def _coefficient_names(degree: int) -> list[str]:
    """Returns the names of the attributes of degrees 1 to `degree`, in the order of `sh_rest`."""
    return [f"{_NAME}:SH_DEGREE_{band}_COEF_{at}"
            for band in range(1, degree + 1) for at in range(2 * band + 1)]


def _describe(columns: Mapping[str, NDArray[Any]]) -> dict[str, Any]:
    """Returns the JSON for columns that are stored one after the other."""
    views, accessors, start = [], [], 0
    for at, (name, column) in enumerate(columns.items()):
        views.append({"buffer": 0, "byteOffset": start, "byteLength": column.nbytes,
                      "target": _Gl.ARRAY_BUFFER})
        start += column.nbytes
        accessor: dict[str, Any] = {
            "bufferView": at, "componentType": _Gl.FLOAT, "count": len(column),
            "type": _TYPES[column.shape[1]]}
        if name == "POSITION":
            accessor |= {"min": column.min(axis=0).tolist(), "max": column.max(axis=0).tolist()}
        accessors.append(accessor)
    return {
        "asset": {"version": "2.0", "generator": "recon"}, "extensionsUsed": [_NAME],
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{
            "attributes": {name: at for at, name in enumerate(columns)}, "mode": _Gl.POINTS,
            "extensions": {_NAME: _DEFAULTS}}]}],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": start}],
    }


def pack_glb(value: dict[str, Any], data: bytes) -> bytes:
    """Returns the bytes of a .glb with this JSON and this binary chunk; InputError beyond 4 GiB."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    length = _HEADER.size + 2 * _CHUNK.size + len(text) + len(data)
    if length > _LARGEST:
        raise InputError(
            f"The scene takes {length} bytes as a .glb, which holds {_LARGEST} at most.",
            hint="Prune it, or write another format.")
    return b"".join([
        _HEADER.pack(_MAGIC, _VERSION, length), _CHUNK.pack(len(text), _JSON), text,
        _CHUNK.pack(len(data), _BIN), data])


def load_glb(path: Path, *, axes: NDArray[np.float64] | None = None) -> LoadedScene:
    """Returns the scene of a .glb and its axis that is up; other points and meshes are skipped.

    The order is the file's; where several primitives hold Gaussians, those with coefficients come
    first. Behind the last one of a primitive that has any, Gaussians are of degree 0. `axes` are as
    in `write_glb`; None for those that the file records, or else `Z_UP`. FormatError if the file is
    missing or damaged, holds no Gaussians, or needs an unsupported feature: compression,
    another kernel, linear colours, nodes that stretch. Gaussians that are not finite are dropped.
    """
    from recon_cli.scene.splats import joined, transformed  # imports torch

    container = Container(path)
    required = container.json.get("extensionsRequired", [])
    if not isinstance(required, list) or not all(name in _SUPPORTED for name in required):
        raise container.error(f"content that needs the extensions {required!r:.200}")
    parts, total = [], 0
    for mesh, similarity in walk_meshes(container):
        for primitive, extension in _find_primitives(container, mesh):
            part = _read_primitive(container, primitive, extension)
            total += len(part)
            if total * _LEAST_BYTES > container.size:
                raise container.error(f"{total} Gaussians in {container.size} bytes")
            parts.append(transformed(part.as_tensors(), similarity))
    if not parts:
        raise FormatError(
            f"{path} holds a mesh or points, but no Gaussians (no primitive with {_NAME}).",
            hint=NOT_GAUSSIANS_HINT)
    degree = max(part.sh_degree for part in parts)
    splats = parts[0] if len(parts) == 1 else joined(
        [part.with_degree(degree) for part in parts])[0]
    if not all(value.isfinite().all() for value in splats.parameters().values()):
        raise container.error("values that overflow float32")
    if axes is None:
        axes = _AXES.get(_read_axes(container.json), Z_UP)
    up = next((name for name, known in _UP.items() if np.array_equal(known, axes)), None)
    return LoadedScene(
        transformed(splats, Similarity(rotation=axes.T)).as_arrays(), up,
        writer=container.generator(container.json))


def _read_axes(value: Mapping[str, Any]) -> str:
    """Returns the name of the scene's axes that a file records; empty if it records none."""
    inner: Any = value
    for key in ("asset", "extras", _AXES_KEY):
        inner = inner.get(key) if isinstance(inner, Mapping) else None
    return inner if isinstance(inner, str) else ""


def _find_primitives(
    container: Container, mesh: dict[str, Any]
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Yields the primitives of Gaussians, each with its entry of the extension."""
    primitives = mesh.get("primitives")
    if not isinstance(primitives, list):
        raise container.error("a mesh without primitives")
    for primitive in primitives:
        extensions = primitive.get("extensions", {}) if isinstance(primitive, dict) else None
        if not isinstance(extensions, dict):
            raise container.error("a malformed primitive")
        extension, attributes = extensions.get(_NAME), primitive.get("attributes")
        if isinstance(extension, dict):
            yield primitive, extension
        elif isinstance(attributes, dict) and f"{_NAME}:SCALE" in attributes:
            logger.warning(
                "%s: Gaussians without an entry of %s, which a program has left out, are read as "
                "plain ones", container.path.name, _NAME)
            yield primitive, _DEFAULTS


def _read_primitive(
    container: Container, primitive: dict[str, Any], extension: dict[str, Any]
) -> SplatArrays:
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or primitive.get("mode") != _Gl.POINTS:
        raise container.error("Gaussians that are not points")
    if extension.get("extensions"):
        raise container.error(f"Gaussians with the extensions {extension['extensions']!r:.200}")
    for name, known in _DEFAULTS.items():
        value = extension.get(name)
        if value != known:
            raise container.error(f"the {name} {value!r:.40}; {known} can be read")

    def values(name: str, kind: str) -> NDArray[np.float64]:
        if name not in attributes:
            raise container.error(f"Gaussians without {name}")
        return container.values(attributes[name], kind, finite=False)

    means = values("POSITION", "VEC3")
    scales, opacities = values(f"{_NAME}:SCALE", "VEC3"), values(f"{_NAME}:OPACITY", "SCALAR")
    # a NaN, which is neither, is dropped below
    if (scales < 0).any() or (opacities < 0).any() or (opacities > 1).any():
        raise container.error("scales below 0 or opacities beyond 0 to 1: a draft of the format?")
    present = [name for name in _coefficient_names(3) if name in attributes]
    if len(present) not in TERMS or present != _coefficient_names(TERMS.index(len(present))):
        raise container.error(f"{len(present)} coefficients, which do not fill a degree")
    if f"{_NAME}:SH_DEGREE_4_COEF_0" in attributes:
        warn_of_degree(container.path, 4)
    rest = [values(name, "VEC3") for name in present]
    table: dict[str, NDArray[Any]] = {
        "means": means,
        "quats": normalize_quats(values(f"{_NAME}:ROTATION", "VEC4")[:, [3, 0, 1, 2]]),
        "log_scales": np.log(np.maximum(scales, _LEAST_SCALE)),
        "logit_opacities": logit(opacities[:, 0], _LEAST_OPACITY),
        "sh_dc": values(f"{_NAME}:SH_DEGREE_0_COEF_0", "VEC3"),
    }
    if {len(column) for column in (*table.values(), *rest)} != {len(means)}:
        raise container.error("attributes of different lengths")
    table["sh_rest"] = np.stack(rest, axis=1) if rest else np.zeros((len(means), 0, 3))
    return splats_from_arrays(container.path, drop_not_finite(container.path, table))


def walk_meshes(container: Container) -> Iterator[tuple[dict[str, Any], Similarity]]:
    """Yields the meshes of the default scene, each with its similarity to the world.

    FormatError if nodes are missing, form a cycle, or stretch, shear or mirror a mesh.
    """
    scene = container.entry("scenes", container.json.get("scene", 0))
    pending = [(node, np.eye(4)) for node in _indices(container, scene, "nodes")]
    visited: set[int] = set()
    while pending:
        index, parent = pending.pop()
        if index in visited:
            raise container.error(f"the node {index} twice, which is not a tree")
        visited.add(index)
        node = container.entry("nodes", index)
        with np.errstate(over="ignore", invalid="ignore"):  # such a matrix is refused below
            matrix = parent @ _matrix(container, node)
        pending += [(child, matrix) for child in _indices(container, node, "children")]
        if "mesh" in node:
            try:
                similarity = Similarity.from_matrix(matrix)
            except ValueError as error:
                raise container.error(
                    "a node that stretches, shears or mirrors its Gaussians") from error
            yield container.entry("meshes", node["mesh"]), similarity


def _indices(container: Container, entry: dict[str, Any], name: str) -> list[int]:
    value = entry.get(name, [])
    if not isinstance(value, list) or not all(type(index) is int for index in value):
        raise container.error(f"{name} = {value!r:.40}; needed are numbers of nodes")
    return value


def _matrix(container: Container, node: dict[str, Any]) -> NDArray[np.float64]:
    """Returns the matrix [4, 4] of a node, given as a matrix or as its three parts."""
    if "matrix" in node:
        return _numbers(container, node, "matrix", np.eye(4).ravel()).reshape(4, 4).T
    quat = _numbers(container, node, "rotation", np.array([0.0, 0, 0, 1]))
    matrix = np.eye(4)
    scale = _numbers(container, node, "scale", np.ones(3))
    matrix[:3, :3] = rotation_matrix(quat[[3, 0, 1, 2]]) * scale
    matrix[:3, 3] = _numbers(container, node, "translation", np.zeros(3))
    return matrix


def _numbers(
    container: Container, node: dict[str, Any], name: str, default: NDArray[np.float64]
) -> NDArray[np.float64]:
    if node.get(name) is None:
        return default
    return container.numbers(node, name, len(default), len(default))


class Container(UntrustedFile):
    """An open .glb; every method raises FormatError if the file breaks its own promises."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, _MAGIC, ".glb")
        data = self.data
        if len(data) < _HEADER.size + _CHUNK.size:
            raise FormatError(f"{path} is not a .glb.")
        _, version, length = _HEADER.unpack_from(data)
        if version != _VERSION:
            raise self.error(f"version {version} of the container; version 2 can be read")
        if length > len(data):
            raise self.error(f"{len(data)} bytes where its header promises {length}")
        accept_surplus(path, len(data) - length, _LEAST_BYTES)
        self.data = data = data[:length]
        kind, text, at = self._chunk(data, _HEADER.size)
        if kind != _JSON or len(text) > _JSON_LIMIT:
            raise self.error(f"a first chunk {kind!r} of {len(text)} bytes, needed is JSON")
        self._bytes = memoryview(b"")
        if at < len(data):
            kind, self._bytes, _ = self._chunk(data, at)
            if kind != _BIN:
                raise self.error(f"a second chunk {kind!r}, needed is BIN")
        self.size = len(self._bytes)  # of the binary chunk
        self.json = self.json_object(bytes(text))

    def entry(self, group: str, index: object) -> dict[str, Any]:
        """Returns an entry of nodes, meshes, accessors and so on."""
        entries = self.json.get(group)
        if (not isinstance(entries, list) or type(index) is not int
                or not 0 <= index < len(entries) or not isinstance(entries[index], dict)):
            raise self.error(f"no {group} {index!r:.40}")
        entry: dict[str, Any] = entries[index]
        return entry

    def values(
        self, accessor: object, kind: str, *, finite: bool = True
    ) -> NDArray[np.float64]:
        """Returns the values [N, C] of an accessor of a type such as VEC3.

        Normalized integers are converted to 0 to 1, or -1 to 1. All must be `finite`, unless not.
        """
        entry = self.entry("accessors", accessor)
        component = entry.get("componentType")
        if (entry.get("type") != kind or type(component) is not int
                or component not in _COMPONENTS or "sparse" in entry):
            raise self.error(
                f"an accessor of {entry.get('type')!r:.40} and {component!r:.40}, not of {kind}")
        item, width = np.dtype(_COMPONENTS[component]), _WIDTHS[kind]
        count = self.integer(entry, "count", 1, _LARGEST)
        part, stride = self._view(entry.get("bufferView"), item.itemsize * width)
        start = self.integer(entry, "byteOffset", 0, _LARGEST, default=0)
        if start + stride * (count - 1) + item.itemsize * width > len(part):
            raise self.error(f"an accessor of {count} values that end after their buffer")
        table = np.ndarray((count, width), item, part, start, (stride, item.itemsize))
        with np.errstate(invalid="ignore"):  # of a NaN that signals
            values = table.astype(np.float64)
        if finite and not np.isfinite(values).all():
            raise self.error("values that are not finite")
        if entry.get("normalized") is True and item.kind in "iu":
            values = np.maximum(values / np.iinfo(item).max, -1)
        return values

    def _view(self, index: object, least: int) -> tuple[memoryview, int]:
        """Returns the bytes of a buffer view and the stride of its values of `least` bytes."""
        view = self.entry("bufferViews", index)
        buffer = self.entry("buffers", view.get("buffer"))
        if view["buffer"] != 0 or "uri" in buffer:
            raise self.error("values in another file, or in none")
        start = self.integer(view, "byteOffset", 0, _LARGEST, default=0)
        length = self.integer(view, "byteLength", 1, _LARGEST)
        stride = self.integer(view, "byteStride", least, _LARGEST, default=least)
        if start + length > self.size:
            raise self.error(f"a view of {length} bytes that ends after the {self.size} there")
        return self._bytes[start:start + length], stride

    def _chunk(self, data: bytes, at: int) -> tuple[bytes, memoryview, int]:
        """Returns the type and the bytes of a chunk, and the offset of the next."""
        if at + _CHUNK.size > len(data):
            raise self.error("a chunk that is cut short")
        length, kind = _CHUNK.unpack_from(data, at)
        start = at + _CHUNK.size
        if start + length > len(data):
            raise self.error(f"a chunk of {length} bytes that ends after the file")
        return kind, memoryview(data)[start:start + length], start + length


def _write_with(path: Path, splats: SplatArrays, settings: WriteSettings) -> None:
    axes = Z_UP if settings.up is None else nearest_axes(settings.up)
    write_glb(path, splats.with_sphere().as_tensors(), axes=axes)


FORMAT = SplatFormat(load_glb, _write_with, load_unturned=lambda path: load_glb(path, axes=Y_UP))
