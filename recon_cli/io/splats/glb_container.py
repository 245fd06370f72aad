"""The container of a .glb: one chunk of JSON, one of bytes, and accessors that point into them.

Every length and offset is checked against what is there before anything is taken by it. The layout
is that of glTF 2.0, https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, sections 3.6 and 4.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recon_cli.errors import FormatError, InputError

_MAGIC, _VERSION = b"glTF", 2
_JSON, _BIN = b"JSON", b"BIN\0"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_JSON_LIMIT = 1 << 22  # bytes; a scene of splats needs a thousandth of it
_LARGEST = (1 << 32) - 1  # bytes: the header's length has 32 bits
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_HINT = "Write or copy the file again."


class Container:
    """An open .glb.

    Attributes:
        json: what its JSON says; an object.
        size: bytes of its binary chunk.

    Raises:
        FormatError: from every method, where the file does not hold what it promises.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            with path.open("rb") as file:
                head = file.read(_HEADER.size + _CHUNK.size)
                if len(head) < _HEADER.size + _CHUNK.size or not head.startswith(_MAGIC):
                    raise FormatError(f"{path} is no .glb.")
                data = head + file.read()
        except OSError as error:
            raise FormatError(f"{path} cannot be read: {error}.") from error
        _, version, length = _HEADER.unpack_from(data)
        if version != _VERSION:
            raise self.damaged(f"version {version} of the container; version 2 can be read")
        if length != len(data):
            raise self.damaged(f"{len(data)} bytes where its header promises {length}")
        kind, text, at = self._chunk(data, _HEADER.size)
        if kind != _JSON or len(text) > _JSON_LIMIT:
            raise self.damaged(f"a first chunk {kind!r} of {len(text)} bytes, needed is JSON")
        self._bytes = memoryview(b"")
        if at < len(data):
            kind, self._bytes, _ = self._chunk(data, at)
            if kind != _BIN:
                raise self.damaged(f"a second chunk {kind!r}, needed is BIN")
        self.size = len(self._bytes)
        self.json = self._parse(text)

    def damaged(self, found: str) -> FormatError:
        """Returns the error that says what was found in this file."""
        return FormatError(f"{self._path} holds {found}.", hint=_HINT)

    def entry(self, group: str, index: object) -> dict[str, Any]:
        """Returns one of the nodes, meshes, accessors and so on."""
        entries = self.json.get(group)
        if (not isinstance(entries, list) or type(index) is not int
                or not 0 <= index < len(entries) or not isinstance(entries[index], dict)):
            raise self.damaged(f"no {group} {index!r:.40}")
        found: dict[str, Any] = entries[index]
        return found

    def values(self, accessor: object, kind: str) -> NDArray[np.float64]:
        """Returns the values [N, C] of an accessor of a type such as VEC3.

        Normalized integers become what they stand for: 0 to 1, or -1 to 1.
        """
        said = self.entry("accessors", accessor)
        component = said.get("componentType")
        if (said.get("type") != kind or type(component) is not int
                or component not in _COMPONENTS or "sparse" in said):
            raise self.damaged(
                f"an accessor of {said.get('type')!r:.40} and {component!r:.40}, not of {kind}")
        item, width = np.dtype(_COMPONENTS[component]), _WIDTHS[kind]
        count = self._whole(said, "count", 1)
        part, stride = self._view(said.get("bufferView"), item.itemsize * width)
        start = self._whole(said, "byteOffset", 0, default=0)
        if start + stride * (count - 1) + item.itemsize * width > len(part):
            raise self.damaged(f"an accessor of {count} values that end behind their buffer")
        table = np.ndarray((count, width), item, part, start, (stride, item.itemsize))
        with np.errstate(invalid="ignore"):  # of a NaN that signals
            values = table.astype(np.float64)
        if not np.isfinite(values).all():
            raise self.damaged("values that are not finite")
        if said.get("normalized") is True and item.kind in "iu":
            values = np.maximum(values / np.iinfo(item).max, -1)
        return values

    def _view(self, index: object, least: int) -> tuple[memoryview, int]:
        """Returns the bytes of a buffer view and how far apart its values of `least` bytes lie."""
        view = self.entry("bufferViews", index)
        buffer = self.entry("buffers", view.get("buffer"))
        if view["buffer"] != 0 or "uri" in buffer:
            raise self.damaged("values in another file, or in none")
        start = self._whole(view, "byteOffset", 0, default=0)
        length = self._whole(view, "byteLength", 1)
        stride = self._whole(view, "byteStride", least, default=least)
        if start + length > self.size:
            raise self.damaged(f"a view of {length} bytes that ends behind the {self.size} there")
        return self._bytes[start:start + length], stride

    def _whole(
        self, part: dict[str, Any], name: str, least: int, *, default: int | None = None
    ) -> int:
        value = part.get(name, default)
        if type(value) is not int or not least <= value <= _LARGEST:
            raise self.damaged(f"{name} = {value!r:.40}; needed is at least {least}")
        return value

    def _chunk(self, data: bytes, at: int) -> tuple[bytes, memoryview, int]:
        """Returns the type and the bytes of a chunk, and where the next begins."""
        if at + _CHUNK.size > len(data):
            raise self.damaged("a chunk that is cut short")
        length, kind = _CHUNK.unpack_from(data, at)
        start = at + _CHUNK.size
        if start + length > len(data):
            raise self.damaged(f"a chunk of {length} bytes that ends behind the file")
        return kind, memoryview(data)[start:start + length], start + length

    def _parse(self, text: memoryview) -> dict[str, Any]:
        try:
            value = json.loads(bytes(text), parse_constant=_no_constant)
        except (ValueError, RecursionError) as error:
            raise self.damaged(f"JSON that cannot be read: {error}") from error
        if not isinstance(value, dict):
            raise self.damaged("JSON that is no set of names")
        return value


def contained(value: dict[str, Any], data: bytes) -> bytes:
    """Returns the bytes of a .glb with this JSON and this binary chunk.

    Raises:
        InputError: they are more than a .glb can hold.
    """
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


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is no number of JSON")
