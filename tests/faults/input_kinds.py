"""Hostile inputs of every reader: videos, photos, data sets with poses, and splat files."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from case import Case
from damages import DAMAGES, NUMBERS
from fuzz_readers import hurt
from judge import RIGHT, Outcome, Verdict, broken, notices, wrong
from lab import MADE
from PIL import Image
from workspace_kinds import classes

from recon_cli.errors import ReconError
from recon_cli.splats.ply import read_ply
from recon_cli.splats.registry import read_splats

_COMMON = ("--max-size", "256", "--frames", "8")
_SUFFIXES = (".mov", ".mkv", ".jpg", ".png", ".txt", ".zip", ".json", ".ply", "", ".MP4", ".r3d",
             ".heic", ".dng", ".gif", ".webp", ".avi", ".insv", ".csv")


def _ingest(case: Case, *inputs: Path | str) -> Verdict:
    workspace = case.folder / "ws"
    words = ("ingest", *map(str, inputs), *_COMMON, "-w", str(workspace))
    before = {path: path.lstat().st_mtime_ns for path in case.folder.rglob("in/**/*")}
    done = case.run(*words)
    if bad := broken(done) or case.judge_memory(done, Path(inputs[0])):
        return bad
    if {path: path.lstat().st_mtime_ns for path in case.folder.rglob("in/**/*")} != before:
        return wrong(Outcome.LOST, done, "the input was changed")
    if done.code:
        return case.judge_error(done, workspace)
    if fault := _unusable_frames(workspace):
        return wrong(Outcome.SILENTLY_WRONG, done, fault)
    status = case.run("status", "-w", str(workspace))
    return RIGHT if status.code == 0 else wrong(
        Outcome.BUG, status, "status fails after ingest")


def _unusable_frames(workspace: Path) -> str:
    """Returns what is wrong with the frames that ingest wrote; empty where nothing is."""
    record = json.loads((workspace / "ingest" / "frames.json").read_text())
    names = [frame["name"] for frame in record["frames"]]
    pictures = {path.name: np.asarray(Image.open(path))
                for path in (workspace / "ingest" / "frames").iterdir()}
    if sorted(names) != sorted(pictures) or len(names) < 2:
        return f"frames.json names {len(names)} frames, frames/ holds {len(pictures)}"
    flat = [name for name, pixels in pictures.items() if pixels.std() < 1e-9]
    return f"{flat[:3]} show one colour" if 0 < len(flat) < len(names) else ""


def hostile_video(case: Case) -> Verdict:
    """A video that is damaged, is called something else, or is none."""
    folder = case.folder / "in"
    folder.mkdir()
    path = folder / "clip.mp4"
    shutil.copy(case.lab.clip, path)
    kinds = [*DAMAGES, *_SUFFIXES, *_CHANGES]
    kind = str(case.pick(kinds, stride=11))
    if kind in DAMAGES:
        DAMAGES[kind](path, case.rng, case.folder / "spare")
    elif kind in _CHANGES:
        path = _CHANGES[kind](path, case.rng)
    else:
        path = path.rename(folder / f"clip{kind}")
    case.tell(f"ingest of a video: {kind}")
    return _ingest(case, path)


def _zipped(path: Path, _rng: random.Random) -> Path:
    archive = path.with_suffix(".zip")
    with zipfile.ZipFile(archive, "w") as made:
        made.write(path, "clip.mp4")
    return archive


def _huge(path: Path, rng: random.Random) -> Path:
    """Makes the header say that the video is huge, or has no size at all."""
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + rng.choice((76, 80))
    data[at:at + 4] = rng.choice((b"\xff\xff\0\0", b"\0\0\0\0", b"\x7f\xff\xff\xff"))
    codec = data.index(b"avc1") + rng.choice((28, 30))
    data[codec:codec + 2] = rng.choice((b"\xff\xff", b"\0\0", b"\0\1"))
    path.write_bytes(data)
    return path


def _boxes(path: Path, rng: random.Random) -> Path:
    """Changes the size, the number of entries or a time in a box of an MP4."""
    data = bytearray(path.read_bytes())
    names = [name for name in (b"moov", b"trak", b"mdhd", b"stsz", b"stco", b"stts", b"stsd",
                               b"ctts", b"stss", b"elst", b"mvhd", b"stsc", b"avcC")
             if name in data]
    box = data.index(rng.choice(names))
    at = box + rng.choice((-4, 4, 8, 12, 16))
    data[at:at + 4] = rng.choice(
        (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\0\0\0\1", b"\x7f\xff\xff\xff"))
    path.write_bytes(data)
    return path


def _device(name: str) -> Callable[[Path, random.Random], Path]:
    return lambda _path, _rng: Path(name)


def _named(name: str | bytes) -> Callable[[Path, random.Random], Path]:
    def change(path: Path, _rng: random.Random) -> Path:
        return path.rename(path.parent / os.fsdecode(name))

    return change


_CHANGES: dict[str, Callable[[Path, random.Random], Path]] = {
    "in a zip": _zipped, "huge": _huge, "boxes": _boxes, "boxes 2": _boxes, "boxes 3": _boxes,
    "/dev/zero": _device("/dev/zero"), "/dev/null": _device("/dev/null"),
    "/dev/full": _device("/dev/full"),
    "a long path": _device("/" + "a" * 5000), "a long name": _device("/tmp/" + "a" * 300 + ".mp4"),
    "not UTF-8": _named(b"x\xff\xfe.mp4"), "newline": _named("a\nb.mp4"),
    "quote": _named("a'\".mp4"),
    "percent": _named("%d %s.mp4"), "colon": _named("file:x.mp4"), "dash": _named("-x.mp4"),
    "brackets": _named("[a]*?.mp4"), "empty word": _device("")}


def hostile_set(case: Case) -> Verdict:
    """One file of a data set with poses, or of a folder of photos."""
    source = case.pick(case.lab.sets())
    folder = case.folder / "in" / source.name
    shutil.copytree(source, folder)
    groups = classes(folder)
    texts = [group for group in groups if group[0].suffix in (".json", ".txt", ".bin", ".csv")]
    group = case.rng.choice(texts if texts and case.rng.random() < 0.75 else groups)
    path = folder / case.rng.choice(group)
    damage = case.rng.choice((*DAMAGES, "number", "number", "number", "line", "line", "word"))
    if damage in DAMAGES:
        DAMAGES[damage](path, case.rng, case.folder / "spare")
    else:
        _spoil_text(path, case.rng, damage)
    case.tell(f"ingest of {source.name}: {damage} of {path.relative_to(folder)}")
    return _ingest(case, folder)


_ENTRIES = ("../metadata", "../rgbd/9.jpg", "/tmp/x", "rgbd/../../x", "..\\metadata", "metadata",
            "rgbd/99.jpg", "a" * 300, "rgbd/\0.jpg", "C:/rgbd/1.jpg")


def hostile_recording(case: Case) -> Verdict:
    """A packed recording of a phone with damage, or with entries that it should not have."""
    outside = case.outside()
    folder = case.folder / "in"
    folder.mkdir()
    path = Path(shutil.copy(case.lab.root / "walk.r3d", folder))
    kind = str(case.pick(("inside", "entry", "inside", "bomb", "inside", *DAMAGES)))
    if kind == "inside":
        path.write_bytes(hurt(path.read_bytes(), case.rng))
    elif kind in ("entry", "bomb"):
        name = case.rng.choice(_ENTRIES)
        data = bytes(200 << 20) if kind == "bomb" else b"x"
        with warnings.catch_warnings(), zipfile.ZipFile(
                path, "a", zipfile.ZIP_DEFLATED) as archive:
            warnings.simplefilter("ignore")  # of a name that is there twice
            archive.writestr("rgbd/98.jpg" if kind == "bomb" else name, data)
        kind = f"{kind} {name[:40]!r}"
    else:
        DAMAGES[kind](path, case.rng, case.folder / "spare")
    case.tell(f"ingest of a recording: {kind}")
    before = {one for one in case.folder.rglob("*") if "ws" not in one.parts}
    verdict = _ingest(case, path)
    left = {one for one in case.folder.rglob("*") if "ws" not in one.parts} - before
    if left or not (outside / "thesis.db").is_file():
        return wrong(Outcome.LOST, case.ran[-1], f"written outside: {sorted(left)[:3]}")
    return case.canary_lost() or verdict


def _spoil_text(path: Path, rng: random.Random, what: str) -> None:
    text = path.read_bytes().decode("latin-1")
    if what == "line":
        lines = text.splitlines(keepends=True)
        at = rng.randrange(len(lines)) if lines else 0
        lines[at:at + 1] = rng.choice(
            ([], lines[at:at + 1] * 2, ["\n"], ["# \n"], ["x " * 50 + "\n"]))
        text = "".join(lines)
    else:
        pattern = r"[-+]?\d[\d.eE+-]*" if what == "number" else r"[A-Za-z_][\w./]*"
        places = list(re.finditer(pattern, text[:20_000]))
        if places:
            at = rng.choice(places)
            new = rng.choice(NUMBERS) if what == "number" else rng.choice(
                ("", "x", "../../x.png", "/etc/passwd", "a" * 300, "\0", "a b"))
            text = text[:at.start()] + new + text[at.end():]
    path.write_bytes(text.encode("latin-1"))


def hostile_splats(case: Case) -> Verdict:
    """A splat file with damage to its bytes or to what it packs."""
    form = str(case.pick(MADE))
    folder, sound = case.folder / "in", case.lab.splats(form)
    shutil.copytree(case.lab.splats("ply").parent, folder / "others")  # to be taken in its place
    if form == "lod":  # a folder, any file of which may be damaged
        index = Path(shutil.copytree(sound.parent, folder / "lod")) / sound.name
        path = case.rng.choice([index, *sorted(one for one in folder.glob("lod/*/*"))])
    else:
        index = path = Path(shutil.copy(sound, folder / f"room.{form}"))
    kind = case.rng.choice(("inside", "inside", "inside", "inside", "inside", *DAMAGES, "renamed"))
    if kind == "inside":
        path.write_bytes(hurt(path.read_bytes(), case.rng))
    elif kind == "renamed":
        other = case.rng.choice([one for one in (*MADE, "zip", "txt", "mp4") if one != form])
        index = path.rename(folder / f"other.{other}")
    else:
        DAMAGES[kind](path, case.rng, case.folder / "spare")
    case.tell(f"import of {index.name}: {kind} of {path.name}")
    workspace = case.folder / "ws"
    done = case.run("import", str(index), "-w", str(workspace))
    if bad := broken(done) or case.judge_memory(done, index.parent):
        return bad
    if done.code:
        return case.judge_error(done, workspace)
    try:
        splats = read_ply(workspace / "train" / "splats.ply")
    except ReconError as error:
        return wrong(Outcome.SILENTLY_WRONG, done, f"what was imported cannot be read: {error}")
    count = len(read_splats(sound))
    if not all(value.isfinite().all() for value in splats.parameters().values()):
        return wrong(Outcome.SILENTLY_WRONG, done, "what was imported is not finite")
    if kind in ("cut", "empty") and len(splats) < count and not notices(done.err):
        return wrong(Outcome.SILENTLY_WRONG, done, f"{len(splats)} of {count} Gaussians, silently")
    if case.rng.random() < 0.2:
        again = case.run("export", "-w", str(workspace))
        return broken(again) or (case.judge_error(again, workspace) if again.code else RIGHT)
    return RIGHT
