"""Faults of a file: damage to its bytes, its numbers, and its kind."""

from __future__ import annotations

import json
import os
import random
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

Damage = Callable[[Path, random.Random, Path], None]
DEEP = "[" * 100_000
NUMBERS = ("NaN", "Infinity", "-Infinity", "1e999", "9" * 5000, "-1", "null", '"x"', "[]", "{}",
           "true", "1e300", "0", "0.5", "99999999999", f'"{"x" * 5000}"', '"\\udcff"',
           '"a\\u0000b"', '"../../x"')


def flip(path: Path, rng: random.Random, _spare: Path) -> None:
    """Changes a few bits."""
    data = bytearray(path.read_bytes())
    for _ in range(rng.choice((1, 1, 2, 8))):
        if data:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def cut(path: Path, rng: random.Random, _spare: Path) -> None:
    """Keeps the first part."""
    data = path.read_bytes()
    path.write_bytes(data[:rng.randrange(len(data))] if data else b"")


def empty(path: Path, _rng: random.Random, _spare: Path) -> None:
    """Leaves a file without a byte."""
    path.write_bytes(b"")


def grow(path: Path, rng: random.Random, _spare: Path) -> None:
    """Adds bytes to the end."""
    with path.open("ab") as file:
        file.write(rng.choice((b"\0" * 100, b"x", rng.randbytes(5000))))


def replace_text(path: Path, rng: random.Random, _spare: Path) -> None:
    """Puts something else into its place."""
    path.write_bytes(rng.choice((
        b"hello\n", b"null", b"[]", b"{}", b"1", DEEP.encode(), b"\xff\xfe\x00", b"\x89PNG\r\n",
        b"ply\nformat ascii 1.0\nend_header\n", rng.randbytes(3000), b'{"a": NaN}')))


def replace_other(path: Path, rng: random.Random, _spare: Path) -> None:
    """Puts another file of the folder above into its place, of the same type or of another."""
    top = path.parent.parent
    others = sorted(one for one in top.rglob("*") if one.is_file() and not one.is_symlink()
                    and one != path and one.read_bytes() != path.read_bytes())
    if rng.random() < 0.6:
        others = [one for one in others if one.suffix == path.suffix] or others
    if others:
        path.write_bytes(rng.choice(others).read_bytes())


def delete(path: Path, _rng: random.Random, _spare: Path) -> None:
    """Removes the file."""
    path.unlink()


def spoil_numbers(path: Path, rng: random.Random, spare: Path) -> None:
    """Puts NaN and other values where numbers are."""
    if path.suffix in (".json", ".jsonl") and path.stat().st_size:
        _spoil_json(path, rng)
    elif path.suffix in (".safetensors", ".ply", ".bin", ".db"):
        _spoil_floats(path, rng)
    else:
        flip(path, rng, spare)


def _spoil_json(path: Path, rng: random.Random) -> None:
    try:
        lines = path.read_text().splitlines() if path.suffix == ".jsonl" else [path.read_text()]
        at = rng.randrange(len(lines))
        value = json.loads(lines[at])
    except (ValueError, RecursionError):
        return
    lines[at] = spoiled_json(value, rng)
    path.write_text("\n".join(lines) + "\n")


def spoiled_json(value: Any, rng: random.Random, word: str = "") -> str:
    """Returns JSON with one leaf, or one entry, that is something else or gone."""
    places = list(_places(value))
    if not places:
        return rng.choice(NUMBERS)
    *above, key = rng.choice(places)
    inner = value
    for step in above:
        inner = inner[step]
    mark = "@here@"
    kind = rng.random()
    if kind < 0.12:
        del inner[key]
    elif kind < 0.2 and isinstance(inner, dict):
        inner[rng.choice(("extra", "", "a" * 300))] = inner.pop(key)
    else:
        inner[key] = mark
    return json.dumps(value).replace(f'"{mark}"', word or rng.choice((*NUMBERS, DEEP)), 1)


def _places(value: Any, before: tuple[Any, ...] = ()) -> Any:
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(
        value, list) else ()
    for key, inner in entries:
        yield (*before, key)
        yield from _places(inner, (*before, key))


def _spoil_floats(path: Path, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    start = data.find(b"end_header\n") + 11 if path.suffix == ".ply" else (
        8 + struct.unpack("<Q", data[:8])[0]) if path.suffix == ".safetensors" else 8
    size = 8 if path.suffix == ".bin" else 4
    if len(data) - start < 2 * size:
        return
    for _ in range(rng.choice((1, 3, 50))):
        at = start + size * rng.randrange((len(data) - start) // size)
        value = rng.choice((float("nan"), float("inf"), -float("inf"), 3e38, 0.0))
        data[at:at + size] = struct.pack("<d" if size == 8 else "<f", value)
    path.write_bytes(data)


def link_away(path: Path, _rng: random.Random, spare: Path) -> None:
    """Moves the file elsewhere and leaves a link, as to a larger disk."""
    spare.mkdir(exist_ok=True)
    target = spare / path.name
    shutil.move(path, target)
    path.symlink_to(target)


def link_dangling(path: Path, _rng: random.Random, spare: Path) -> None:
    """Leaves a link to what is not there."""
    path.unlink()
    path.symlink_to(spare / "gone" / path.name)


def link_itself(path: Path, _rng: random.Random, _spare: Path) -> None:
    """Leaves a link to itself."""
    path.unlink()
    path.symlink_to(path.name)


def to_folder(path: Path, rng: random.Random, _spare: Path) -> None:
    """Puts a folder into its place, empty or not."""
    path.unlink()
    path.mkdir()
    if rng.random() < 0.5:
        (path / "file").write_text("x")


def to_fifo(path: Path, _rng: random.Random, _spare: Path) -> None:
    """Puts a named pipe into its place: whoever opens it to read waits for ever."""
    path.unlink()
    os.mkfifo(path)


DAMAGES: dict[str, Damage] = {
    "flip": flip, "cut": cut, "empty": empty, "grow": grow, "text": replace_text,
    "other": replace_other, "delete": delete, "nan": spoil_numbers, "link": link_away,
    "dangling": link_dangling, "itself": link_itself, "folder": to_folder, "fifo": to_fifo}
