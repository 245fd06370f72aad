"""Hostile settings, camera paths and places: recon.toml, --config, --set, --path, -w."""

from __future__ import annotations

import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
from case import Case
from damages import DAMAGES, DEEP, NUMBERS, spoiled_json
from judge import RIGHT, Outcome, Verdict, broken, differing, wrong
from lab import FULL, SETTINGS, STAGES, copy

_VALUES = (*NUMBERS, "nan", "inf", "-inf", "1e400", "''", '""', "0x10", "1979-05-27", "[1, 2]",
           '"a\\u0000"', '"every:0"', '"segment:1:0"', "-9223372036854775809", "1_000", "01")
_TEXTS = (
    "", "x", "[", "[[train]]", "train = 1", "[train]\n[train]", f"a = {DEEP}", "a = 1\na = 2",
    "[train.x]\ny = 1", "\ufeff[train]\n", "[train]\niterations = 1\r\n\0", "[nothing]\nx = 1",
    "[train]\nnothing = 1", '[train]\n"a\\nb" = 1', "[" + "a." * 20_000 + "b]", "x = '''",
    f"[train]\niterations = {'9' * 5000}", "\udcff", f"# {'x' * 1_000_000}\n",
    "[train]\nseed = 1.5")


def settings(case: Case) -> Verdict:
    """recon.toml, a file after --config, or --set with values that no option takes."""
    workspace = case.workspace()
    where = str(case.pick(("recon.toml", "--config", "--set", "file")))
    path = workspace / "recon.toml" if where in ("recon.toml", "file") else case.folder / "my.toml"
    rng, extra = case.rng, ()
    lines = SETTINGS.splitlines()
    at = rng.choice([number for number, line in enumerate(lines) if "=" in line])
    name, value = lines[at].split(" = ")[0], rng.choice(_VALUES)
    lines[at] = f"{name} = {value}"
    text = rng.choice(("\n".join(lines), "\n".join(lines), rng.choice(_TEXTS)))
    if where == "--set":
        section = next(line[1:-1] for line in reversed(lines[:at]) if line.startswith("["))
        value = rng.choice(_VALUES).replace("\\udcff", "\udcff").replace("\0", "")
        word = rng.choice((f"{section}.{name}={value}", f"{section}.{name}", value, f"{value}=1",
                           f"{section}={value}"))
        extra = ("--set", word)
    else:
        path.write_bytes(text.encode("utf-8", "surrogateescape"))
        if where == "file":
            damage = rng.choice(sorted(DAMAGES))
            DAMAGES[damage](path, rng, case.folder / "spare")
        if where == "--config":
            extra = ("--config", str(path))
    verb = "run" if where == "--set" else rng.choice(
        ("status", "export", "train", "eval", "report", "render", "clean", "prune"))
    words = [verb, "--print-config"] if verb in ("run", "train", "prune") else [
        word for word in FULL[verb] if word != "--again"]  # with other settings it takes minutes
    case.tell(f"{where}: {name} = {value[:40]} or {text[:40]!r}, then {' '.join(words)}")
    done = case.run(*words, *extra, "-w", str(workspace))
    if done.code:
        return case.judge_error(done, workspace)
    return broken(done) or RIGHT


def _camera_path() -> dict[str, object]:
    return {
        "camera_type": "perspective", "render_width": 32, "render_height": 24, "fps": 10.0,
        "seconds": 0.3, "is_cycle": False, "keyframes": [], "camera_path": [
            {"camera_to_world": np.eye(4).ravel().tolist(), "fov": 60.0 + at, "aspect": 1.33}
            for at in range(3)]}


def camera_path(case: Case) -> Verdict:
    """A camera path that is damaged or asks for what cannot be drawn."""
    workspace, path = case.workspace(), case.folder / "paths" / "path.json"
    path.parent.mkdir()
    path.write_text(json.dumps(_camera_path()))
    damage = str(case.pick(("value", "value", "value", "value", *DAMAGES)))
    if damage == "value":
        path.write_text(spoiled_json(_camera_path(), case.rng))
    else:
        DAMAGES[damage](path, case.rng, case.folder / "spare")
    case.tell(f"render --path with damage: {damage}")
    out = case.folder / "frames"
    done = case.run("render", "--path", str(path), "--out", str(out), "-w", str(workspace))
    if bad := broken(done):
        return bad
    if done.code:
        return case.judge_error(done, workspace)
    pictures = list(out.rglob("*.png"))
    try:
        frames = len(json.loads(path.read_text())["camera_path"]) if path.is_file() else -1
    except (ValueError, KeyError, TypeError):
        frames = -1
    if len(pictures) != frames:
        return wrong(Outcome.SILENTLY_WRONG, done, f"{len(pictures)} frames of {frames}")
    return RIGHT


_FOLDERS: tuple[str | bytes, ...] = (
    b"x\xff\xfe", "a" * 255, "deep/" * 60 + "w", "a\nb", "a b", "%s %d", "[a]*?",
    "\u00e4\u4e2d\U0001f600", "-w", "'\"", "a:b", "~", "$HOME", "con", "w.", " w", "\\", "#x",
    "a=b", "\u202eabc", "\x1b[31m")


def places(case: Case) -> Verdict:
    """A workspace below a folder with an odd name: the result is the same as anywhere."""
    name = os.fsdecode(case.pick(_FOLDERS))
    workspace = case.folder / name / "ws"
    workspace.parent.mkdir(parents=True)
    verb = case.rng.choice(("ingest", "denoise", "sfm", "train", "eval", "eval", "export", "prune",
                            "render", "report", "status"))
    top = {"eval": "evaluate"}.get(verb, verb)
    copy(case.lab.tiny, workspace, without=(top,))
    words = [word for word in FULL[verb] if word != "--again"]
    if verb == "ingest":
        shutil.copy(case.lab.clip, workspace.parent / "clip.mp4")
        words.append(str(workspace.parent / "clip.mp4"))
    case.tell(f"{verb} below {name!r}")
    done = case.run(*words, "-w", str(workspace))
    if bad := broken(done):
        return bad
    if done.code:
        return case.judge_error(done, workspace)
    wrongs = differing(case.lab, workspace, [top] if top in (*STAGES, "render") else [])
    return wrong(Outcome.SILENTLY_WRONG, done, f"not as elsewhere: {wrongs[:5]}") if wrongs else (
        RIGHT)


def bad_places(case: Case) -> Verdict:
    """A workspace that cannot be: a file, a pipe, a device, a name too long, a folder that went."""
    rng, folder = case.rng, case.folder
    (folder / "file").write_text("x")
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to("loop")
    (folder / "dangling").symlink_to("gone")
    where = str(case.pick((
        "file", "pipe", "loop", "dangling", "file/below", "/dev/null", "/proc/self", "/dev/full",
        "a" * 300, "b/" * 2500, "", "/proc/nothing", "loop/ws", "\udcff", "/sys/kernel/x")))
    verb = rng.choice(("status", "clean", "train", "eval", "export", "render", "report", "ingest",
                       "import"))
    words = [word for word in FULL.get(verb, ("import",)) if word != "--again"]
    if verb in ("ingest", "import"):
        words.append(str(case.lab.clip if verb == "ingest" else case.lab.splats("ply")))
    case.tell(f"{verb} in the workspace {where[:40]!r}")
    done = case.run(*words, "-w", where)
    if done.code:
        return case.judge_error(done, folder / where, follow=False)
    return broken(done) or RIGHT


_WORDS = re.compile(r"^\s+(--[a-z-]+)", re.M)


def odd_words(case: Case) -> Verdict:
    """Options with values that make no sense."""
    workspace = case.workspace()
    verb = str(case.pick(tuple(FULL)))
    options = _WORDS.findall(case.run(verb, "--help").out)
    option = case.rng.choice([one for one in options if one not in (
        "--help", "--help-all", "--workspace", "--out", "--max-minutes", "--minutes")])
    value = case.rng.choice((
        "", "x", "-1", "0", "nan", "inf", "1e999", "9" * 5000, "1,2,3", "../..", "\udcff",
        "a" * 5000, str(Path("/")), "1.5", "-inf", "0x1"))
    case.tell(f"{verb} {option} {value[:40]!r}")
    done = case.run(*FULL[verb], option, value, "-w", str(workspace))
    if done.code:
        return case.judge_error(done, workspace, follow=False)
    return broken(done) or RIGHT
