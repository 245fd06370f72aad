"""Folders that are links, files, pipes or somebody else's; manifests with a valid checksum that
name what is not theirs."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from case import Case
from damages import spoiled_json
from judge import (
    RIGHT,
    Outcome,
    Verdict,
    broken,
    differing,
    lost_files,
    new_notices,
    owned,
    snapshot,
    spares,
    vanished,
    wrong,
)
from lab import FULL, STAGES, VERBS

from recon_cli.workspace.json_record import sha256_json

Change = Callable[[Path, Path], object]  # of a path, given a folder outside of the workspace


def _gone(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _put_file(path: Path, _outside: Path) -> None:
    _gone(path)
    path.write_text("x")


def _put_fifo(path: Path, _outside: Path) -> None:
    _gone(path)
    os.mkfifo(path)


def _put_folder(path: Path, _outside: Path) -> None:
    _gone(path)
    path.mkdir()


def _put_foreign(path: Path, outside: Path) -> None:
    _gone(path)
    shutil.copytree(outside, path)


def _link(target: str) -> Change:
    def change(path: Path, outside: Path) -> None:
        _gone(path)
        path.symlink_to(target.format(outside=outside, name=path.name))

    return change


def _move(path: Path, outside: Path) -> None:
    away = outside.parent / "larger disk"
    away.mkdir()
    if path.exists():
        shutil.move(path, away / path.name)
    else:
        (away / path.name).mkdir()
    path.symlink_to(away / path.name)


CHANGES: dict[str, Change] = {
    "moved to a larger disk": _move, "a file": _put_file, "a pipe": _put_fifo,
    "an empty folder": _put_folder, "somebody's folder": _put_foreign,
    "a link to the user's files": _link("{outside}"),
    "a link to a file of the user's": _link("{outside}/thesis.db"),
    "a dangling link": _link("{outside}/gone"), "a link to itself": _link("{name}"),
    "gone": lambda path, _outside: _gone(path)}
_PLACES = (*STAGES, ".partial", ".partial/train", ".partial/train.json", ".partial/eval", ".old",
           ".old/train", ".old/junk", ".lock", ".lock.json", "recon.log", "recon.toml", "render",
           "report.html", "blocks", "seeds", "seeds/1", "ingest/frames", "place/undistorted",
           "sfm/parts/1", "train/manifest.json", "recon.toml", "render/test")


def structure(case: Case) -> Verdict:
    """A folder or file of the workspace that is something else."""
    combinations = [(place, change) for place in _PLACES for change in CHANGES]
    place, change = case.pick(combinations, stride=7919)
    outside, workspace = case.outside(), case.workspace()
    case.may_add = place.split("/")[0] == "render"  # frames may go to a larger disk
    path = workspace / place
    path.parent.mkdir(exist_ok=True)
    CHANGES[change](path, outside)
    top = place.split("/")[0]
    verb = case.rng.choice((
        "status", "clean", "clean", "report", "render",
        *(VERBS[top] if top in STAGES else "train", "train", "eval", "export", "denoise")))
    if top in (".partial", ".old", "blocks", "seeds") and case.rng.random() < 0.6:
        verb = "clean"
    words = (*FULL[verb], *((case.rng.choice(STAGES),) if verb == "clean"
                            and case.rng.random() < 0.3 else ()), "-w", str(workspace))
    if top == "recon.toml":  # with other settings it takes minutes
        words = tuple(word for word in words if word != "--again")
    case.tell(f"{place} is {change}, then {' '.join(words)}")
    verdict = _judge(case, workspace, verb, words, top)
    if change == "somebody's folder" and place in (*STAGES, "render") and lost_files(
            snapshot(outside), path, lambda _: False):
        return wrong(Outcome.LOST, case.ran[-1], f"{place}, which recon did not make, was replaced")
    return verdict


def _judge(case: Case, workspace: Path, verb: str, words: tuple[str, ...], top: str) -> Verdict:
    before = snapshot(workspace)
    done = case.run(*words)
    if bad := case.canary_lost() or broken(done):
        return bad
    spare = spares(verb, words)
    if lost := lost_files(before, workspace, spare):
        return wrong(Outcome.LOST, done, f"changed: {lost[:5]}")
    if gone := vanished(before, workspace, removed=[top, *words]):
        return wrong(Outcome.LOST, done, f"{gone} are gone")
    if done.code:
        verdict = case.judge_error(done, workspace)
        return case.canary_lost() or verdict
    if verb in ("status", "clean", "report") or top == "render":
        return RIGHT
    if top == "prune" and verb in ("eval", "export") and not (workspace / top).is_dir():
        return RIGHT  # they do without a pruned model where there is none
    names = {"train": {"train"}, "sfm": {"sfm", "place"}}.get(verb, owned(verb))
    wrongs = [] if top == "recon.toml" else differing(case.lab, workspace, sorted(names))
    if wrongs and not new_notices(case.lab, verb, done):
        return wrong(Outcome.SILENTLY_WRONG, done, f"not as without the fault: {wrongs[:5]}")
    return RIGHT


_NAMES = (
    "{outside}/thesis.db", "../../outside/thesis.db", "../../outside/photos", "parts/../../../"
    "outside/photos", "parts/../../../outside/thesis.db", "log.jsonl/../../../outside/thesis.db",
    "../train/splats.ply", "..", ".", "", "/", "a" * 300, "b/" * 3000 + "c", "\udcff.png",
    "nul\0byte", "manifest.json", "~/x", "frames/../../../outside/photos/a.jpg", "parts//{outside}",
    "parts/link")


def manifest_names(case: Case) -> Verdict:
    """A manifest with a valid checksum whose outputs lie elsewhere."""
    outside, workspace = case.outside(), case.workspace()
    # Large outputs of sfm that only it reads are what `clean` removes.
    removed = case.rng.random() < 0.6
    stage = "sfm" if removed else str(case.rng.choice(STAGES))
    name = str(case.pick(_NAMES)).replace("{outside}", str(outside))
    if name == "parts/link":
        (workspace / "sfm" / "parts" / "link").symlink_to(outside)
    how = "new" if removed else case.rng.choice(("new", "renamed", "stage", "source"))

    def change(content: dict[str, object]) -> None:
        outputs = content["outputs"]
        large = {"sha256": "0" * 64, "size": 5 << 20, "mtime_ns": 1}
        if how == "stage":
            content["stage"] = name
        elif how == "source" and content["inputs"]:
            content["inputs"][0]["path"] = name
        elif how == "renamed":
            outputs[name] = outputs.pop(case.rng.choice(sorted(outputs)))
        else:
            outputs[name] = large

    resign(workspace / stage / "manifest.json", change)
    verb = "clean" if removed else case.rng.choice(
        ("clean", "status", "report", VERBS[stage], "export"))
    words = (*FULL[verb], *((stage,) if verb == "clean" and not removed else ()),
             "-w", str(workspace))
    case.tell(f"the manifest of {stage} names {name[:60]!r} ({how}), then {' '.join(words)}")
    return _judge(case, workspace, verb, words, stage)


def manifest_values(case: Case) -> Verdict:
    """A manifest with a valid checksum, one value of which is something else."""
    workspace = case.workspace()
    stage = str(case.pick(STAGES))
    path = workspace / stage / "manifest.json"

    def change(content: dict[str, object]) -> None:
        text = spoiled_json(dict(content), case.rng)
        try:
            value = json.loads(text)
        except (ValueError, RecursionError):
            value = content
        content.clear()
        content.update(value)

    resign(path, change)
    verb = case.rng.choice(("status", "clean", "report", VERBS[stage], "eval", "export", "render"))
    words = (*FULL[verb], "-w", str(workspace))
    case.tell(f"a value in the manifest of {stage} is another, then {' '.join(words)}")
    return _judge(case, workspace, verb, words, stage)


def resign(path: Path, change: Callable[[dict[str, object]], None]) -> None:
    """Changes a manifest and writes its checksum anew, as somebody who wants to deceive does."""
    content = json.loads(path.read_text())
    content.pop("self")
    change(content)
    try:
        content["self"] = sha256_json(content)
    except (ValueError, UnicodeEncodeError):  # NaN, surrogates
        content["self"] = "0" * 64
    path.write_text(json.dumps(content, indent=1))
