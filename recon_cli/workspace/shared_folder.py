"""A folder of several results, each with a manifest of its own, and of the user's files.

So are exports: `export` (splats.ply) has manifest.json, `export.spz` manifest.spz.json. The files
of a result are moved in one by one, its manifest last; what a crash left is moved in later. A file
that the user made or changed is never lost: where one of its name is written, it gets another.
"""

from __future__ import annotations

import dataclasses
import errno
import itertools
import logging
import os
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from recon_cli.errors import ManifestError
from recon_cli.workspace import durable
from recon_cli.workspace.digests import FileDigest, digest_file, digest_outputs, matches
from recon_cli.workspace.export_formats import EXPORT_FORMATS
from recon_cli.workspace.manifest import NAME, Manifest, manifest_name

FOLDER = "export"
_KEPT = "*.kept*"  # files that were given another name

logger = logging.getLogger("recon")


def is_shared(stage: str) -> bool:
    """Returns whether a result lies in a folder with others."""
    return stage.partition(".")[0] == FOLDER


def find_damage(partial: Path, folder: Path) -> list[str]:
    """Returns the outputs of a finished result that are neither in `partial` nor moved in yet."""
    outputs = Manifest.read(partial, manifest_name(partial.name)).outputs
    return [f"output {name} is missing or damaged" for name, known in outputs.items()
            if not any(_is_unchanged(place / name, known) for place in (partial, folder))]


def move_in(partial: Path, folder: Path) -> None:
    """Moves a finished result into the folder, in place of its last one; its manifest comes last.

    `partial` keeps its manifest: what was begun by a run that was killed is done again.
    """
    name = manifest_name(partial.name)
    finished, known = Manifest.read(partial, name), _read_all(folder)
    outputs = finished.outputs
    if name == NAME and name in known:
        known |= _split(folder, known[name])
    last = known.pop(name).outputs if name in known else {}
    others = [manifest.outputs for manifest in known.values()]
    folder.mkdir(exist_ok=True)
    for path in outputs:
        if os.path.lexists(partial / path):
            _make_way(folder, path, [last, outputs, *others])
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            _put(partial / path, folder / path)
    _remove_outputs(folder, last, [outputs, *others])
    for path in _find_strangers(folder, partial.name, [outputs, *others]):
        _set_aside(folder / path)
    finished.write(folder)


def result_paths(folder: Path, stage: str) -> list[Path]:
    """Returns the files of one result alone, as it wrote them, and its manifest."""
    known = _read_all(folder)
    own = known.pop(manifest_name(stage), None)
    return [*_removable(folder, own.outputs if own else {}, [
        other.outputs for other in known.values()]), folder / manifest_name(stage)]


def _read_all(folder: Path) -> dict[str, Manifest]:
    """Returns the manifests in a folder by their names, without those that cannot be trusted."""
    found = {}
    for path in sorted(folder.glob("manifest*.json")):
        with suppress(ManifestError):
            found[path.name] = Manifest.read(folder, path.name)
    return found


def _split(folder: Path, last: Manifest) -> dict[str, Manifest]:
    """Gives the formats in the one manifest of before version 7 manifests of their own."""
    parts = {}
    for row in EXPORT_FORMATS.values():
        outputs = {path: known for path, known in last.outputs.items()
                   if matches(path, row.patterns)}
        if row.name != "ply" and row.main_file in outputs:
            summary = last.run.summary.get("files", {}).get(row.name, {"file": row.file})
            key = dataclasses.replace(last.key, stage=f"{FOLDER}.{row.name}", upstream={
                **last.key.upstream, FOLDER: last.digest})
            part = Manifest(key, outputs, digest_outputs(outputs, ()),
                            dataclasses.replace(last.run, summary=summary))
            part.write(folder)
            parts[manifest_name(key.stage)] = part
    return parts


def _make_way(folder: Path, path: str, known: Collection[Mapping[str, FileDigest]]) -> None:
    """Gives what lies where a file is to be another name, unless a result wrote it so."""
    for part in reversed([*Path(path).parents][:-1]):
        if os.path.lexists(folder / part) and (
                (folder / part).is_symlink() or not (folder / part).is_dir()):
            _set_aside(folder / part)
    target = folder / path
    if os.path.lexists(target) and not any(
            path in outputs and _is_unchanged(target, outputs[path]) for outputs in known):
        _set_aside(target)


def _find_strangers(
    folder: Path, stage: str, known: Collection[Mapping[str, FileDigest]]
) -> list[str]:
    """Returns files with names of a format that no result wrote.

    INRIA's reader leaves a points3D.ply beside a model, and prefers it to a new model.
    """
    patterns = EXPORT_FORMATS[stage.partition(".")[2] or "ply"].patterns
    names = (path.relative_to(folder).as_posix() for path in _files_below(folder))
    return [name for name in names if matches(name, patterns) and not matches(name, [_KEPT])
            and not any(name in outputs for outputs in known)]


def _removable(
    folder: Path, outputs: Mapping[str, FileDigest], others: Collection[Mapping[str, FileDigest]]
) -> list[Path]:
    return [folder / path for path, known in outputs.items()
            if not any(path in other for other in others) and _is_unchanged(folder / path, known)]


def _remove_outputs(
    folder: Path, outputs: Mapping[str, FileDigest], others: Collection[Mapping[str, FileDigest]]
) -> None:
    """Removes the outputs that are as they were written and that no other result has."""
    for path in _removable(folder, outputs, others):
        path.unlink()
        for parent in path.relative_to(folder).parents:
            with suppress(OSError):  # not empty
                (folder / parent).rmdir()


def _files_below(folder: Path) -> Iterator[Path]:
    """Yields the files and links below a folder; links are not followed."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.is_symlink():
            yield from _files_below(path)
        else:
            yield path


def _is_unchanged(path: Path, known: FileDigest) -> bool:
    return (path.is_file() and not path.is_symlink()
            and digest_file(path, known).sha256 == known.sha256)


def _put(source: Path, target: Path) -> None:
    """Renames a file, also to another file system."""
    try:
        durable.replace(source, target)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        copy = target.with_name(f".{target.name}.moving")
        shutil.copy2(source, copy)
        durable.flush(copy)
        durable.replace(copy, target)
        source.unlink()


def _set_aside(path: Path) -> None:
    """Gives a file of the user a name that is free, such as splats.kept.ply for splats.ply."""
    stem, dot, suffix = path.name.partition(".")
    names = (path.with_name(f"{stem}.kept{number if number > 1 else ''}{dot}{suffix}")
             for number in itertools.count(1))
    free = next(one for one in names if not os.path.lexists(one))
    durable.rename(path, free)
    logger.warning("%s was not written by recon, or changed since: it is kept as %s.",
                   path.name, free.name)
