"""How a record goes to JSON and back: a frozen dataclass whose fields are the keys, in order.

A field whose default is None is left out while it is None. A field that a file has always had under
another key says so: `field(metadata={KEY: "key"})`.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

from recon_cli.errors import ManifestError

KEY = "key"  # in the metadata of a field
_HINT = "Run the stage that wrote it again with --again."
_SCALARS: Mapping[Any, tuple[type, ...]] = {
    bool: (bool,), int: (int,), float: (float, int), str: (str,)}


@dataclass(frozen=True)
class JsonRecord:
    """A frozen dataclass of JSON values, paths, tuples, mappings and other dataclasses of them."""

    def contradictions(self, options: Mapping[str, Any]) -> tuple[str, ...]:  # noqa: ARG002
        """Returns why `options` that take no part in the fingerprint would give another result."""
        return ()

    def to_json(self) -> dict[str, Any]:
        """Returns JSON values that `from_json` reads; tuples become lists."""
        return _encode_fields(self)

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """Returns the record that `to_json` wrote; unknown keys are ignored.

        Raises:
            ManifestError: it is not a mapping, lacks a field, or holds one of another type.
        """
        record: Self = _decode_fields(cls, value)
        return record


def _key(field: dataclasses.Field[Any]) -> str:
    return str(field.metadata.get(KEY, field.name))


def _encode_fields(record: Any) -> dict[str, Any]:
    items = ((field, getattr(record, field.name)) for field in dataclasses.fields(record))
    return {_key(field): _encode(item) for field, item in items
            if item is not None or field.default is not None}


def _encode(item: Any) -> Any:
    if isinstance(item, JsonRecord):
        return item.to_json()
    if dataclasses.is_dataclass(item):
        return _encode_fields(item)
    if isinstance(item, (tuple, list)):
        return [_encode(part) for part in item]
    if isinstance(item, Mapping):
        return {key: _encode(part) for key, part in item.items()}
    return str(item) if isinstance(item, Path) else item


def _decode_fields(kind: type, value: Any) -> Any:
    if not isinstance(value, Mapping):
        raise ManifestError("the record is not a JSON object", hint=_HINT)
    kinds, fields = _type_hints(kind), dataclasses.fields(kind)
    missing = [
        _key(field) for field in fields if _key(field) not in value
        and field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING]
    if missing:
        raise ManifestError(
            f"the record lacks {', '.join(missing)}: another version of recon wrote it",
            hint=_HINT)
    items = {field.name: _decode(_key(field), kinds[field.name], value[_key(field)])
             for field in fields if _key(field) in value}
    try:
        return kind(**items)
    except ValueError as error:  # of a class that checks its fields
        raise ManifestError(f"the record cannot be used: {error}", hint=_HINT) from error


@cache  # else they are read anew for each record, which takes most of the time
def _type_hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _decode(name: str, kind: Any, item: Any) -> Any:
    """Returns a JSON value as the type that the field `name` is annotated with."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (types.UnionType, typing.Union):  # X | None
        return None if item is None else _decode(name, arguments[0], item)
    if origin is tuple and isinstance(item, (list, tuple)):
        kinds = [arguments[0]] * len(item) if arguments[-1] is Ellipsis else arguments
        if len(kinds) == len(item):
            return tuple(_decode(name, each, part)
                         for each, part in zip(kinds, item, strict=True))
    if origin is Mapping and isinstance(item, Mapping):
        return {key: _decode(name, arguments[1], part) for key, part in item.items()}
    if isinstance(kind, type) and issubclass(kind, JsonRecord):
        return kind.from_json(item)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        return _decode_fields(kind, item)
    if kind is Path and isinstance(item, str):
        return Path(item)
    if kind is Any or isinstance(item, _SCALARS.get(kind, ())):
        return item
    raise ManifestError(
        f"the record holds {repr(item)[:100]} as {name}: another version of recon wrote it",
        hint=_HINT)


def sha256_json(value: Any) -> str:
    """Returns the SHA-256 of a JSON value, with its keys in any order."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
