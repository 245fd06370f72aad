"""Files of an earlier export that a new one leaves in its folder.

They are hard links to those of the result that is replaced, made last, so that nothing writes
through them. Each is fresh or stale by its own record. A file that the user put there or changed
is never lost either: where an export writes one of its name, it gets another one.
"""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recon_cli.config.export import ExportConfig
from recon_cli.context import EarlierResult, StageInputs
from recon_cli.errors import ManifestError
from recon_cli.workspace.atomic import LEFTOVERS
from recon_cli.workspace.digests import matches
from recon_cli.workspace.export_formats import EXPORT_FORMATS
from recon_cli.workspace.export_record import (
    VERSION,
    ExportedFile,
    ExportSummary,
    deciding_options,
    describe_changes,
    loss_is_small,
    loss_limit,
    main_file,
    owns,
)
from recon_cli.workspace.layout import link_or_copy
from recon_cli.workspace.manifest import NAME as MANIFEST

_CHANGED, _MISSING = "it was changed by hand", "some of its files are missing"


@dataclass(frozen=True)
class KeptFiles:
    """The files that are kept of an earlier export."""

    files: Mapping[str, ExportedFile]  # by format
    own_files: tuple[str, ...]  # relative paths of those that the user made or changed
    renamed: Mapping[str, str]  # of these, the new path by the old one


def read_records(
    config: ExportConfig, inputs: StageInputs, model: str
) -> dict[str, ExportedFile]:
    """Returns the record of each format of the earlier export, with why it is stale now."""
    earlier = inputs.earlier
    if earlier is None:
        return {}
    try:
        files = ExportSummary.from_json(earlier.summary).files or {}
    except ManifestError:  # of another version, or damaged: the sources of the files are unknown
        files = {name: ExportedFile(file=row.file) for name, row in EXPORT_FORMATS.items()
                 if name != "ply"}
    return {
        name: dataclasses.replace(record, stale=_find_reason(name, record, config, inputs, model))
        for name, record in files.items() if name in EXPORT_FORMATS
        and (earlier.folder / main_file(name, record.file)).exists()}


def _find_reason(
    name: str, record: ExportedFile, config: ExportConfig, inputs: StageInputs, model: str
) -> str | None:
    earlier = inputs.earlier
    assert earlier is not None
    if record.stale in (_CHANGED, _MISSING):
        return record.stale
    main = main_file(name, record.file)
    if main in earlier.foreign or any(owns(name, path) for path in earlier.changed):
        return _CHANGED
    if any(owns(name, path) for path in earlier.missing):
        return _MISSING
    return describe_changes(record.made_of, made_of(name, config, inputs, model)) or None


def made_of(
    name: str, config: ExportConfig, inputs: StageInputs, model: str
) -> dict[str, Any]:
    """Returns what a file of a format would be made of now, as JSON values."""
    stages = ["ingest", "sfm"]
    model_shown = {}
    if EXPORT_FORMATS[name].kind != "cameras":
        stages += ["train", "prune"] if model == "pruned" else ["train"]
        model_shown = {"model": model}
    digests = {stage: inputs.digests[stage] for stage in stages if stage in inputs.digests}
    options = deciding_options(name, dataclasses.asdict(config))
    return {"version": VERSION, **model_shown, **digests, **options}


def find_fresh(
    config: ExportConfig, inputs: StageInputs, records: Mapping[str, ExportedFile]
) -> set[str]:
    """Returns the formats that need not be written again."""
    if inputs.again:
        return set()
    options = dataclasses.asdict(config)
    return {name for name, record in records.items()
            if not record.stale and loss_is_small(record, loss_limit(name, options))}


def discard_files(out: Path, name: str, written: Collection[str]) -> None:
    """Removes the files of a format that failed, and of no other one."""
    for path in list(_files_below(out)):
        relative = path.relative_to(out).as_posix()
        if owns(name, relative) and not any(owns(other, relative) for other in written):
            path.unlink()


def keep_files(
    out: Path, earlier: EarlierResult | None, records: Mapping[str, ExportedFile],
    written: Collection[str],
) -> KeptFiles:
    """Puts the files of the earlier export into `out`, without the formats now written."""
    kept = {name: record for name, record in records.items() if name not in written}
    own_files: list[str] = []
    renamed: dict[str, str] = {}
    moved: dict[Path, Path] = {}  # folders by the files that have their names now
    if earlier is None:
        return KeptFiles(kept, (), renamed)
    for path in _files_below(earlier.folder):
        name = path.relative_to(earlier.folder).as_posix()
        target = out / name
        if name in earlier.foreign | earlier.changed or not any(
                owns(one, name) for one in EXPORT_FORMATS):
            # INRIA's reader leaves a points3D.ply beside a model, and prefers it to a new model
            blocker = _find_blocker(out, name)
            if blocker is not None:
                if blocker not in moved:
                    moved[blocker] = _free_name(out, blocker.relative_to(out).as_posix())
                target = moved[blocker] / target.relative_to(blocker)
            elif os.path.lexists(target) or any(owns(one, name) for one in written):
                target = _free_name(out, name)
            if target != out / name:
                renamed[name] = target.relative_to(out).as_posix()
            own_files.append(target.relative_to(out).as_posix())
        elif os.path.lexists(target) or not any(owns(one, name) for one in kept):
            continue  # replaced, or left of a format that is
        link_or_copy(path, target)
    return KeptFiles(kept, tuple(own_files), renamed)


def _files_below(folder: Path) -> Iterator[Path]:
    """Yields the files and links below a folder but the manifest; links are not followed."""
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.is_symlink():
            yield from _files_below(path)
        elif path.name != MANIFEST and not matches(path.name, [LEFTOVERS]):
            yield path


def _find_blocker(out: Path, name: str) -> Path | None:
    """Returns the file below `out` that has the name of a folder in a relative path, if any."""
    for part in reversed(Path(name).parents):
        if os.path.lexists(out / part) and not (out / part).is_dir():
            return out / part
    return None


def _free_name(out: Path, name: str) -> Path:
    """Returns a path below `out` that is free, such as splats.kept.ply for splats.ply."""
    path = out / name
    stem, dot, suffix = path.name.partition(".")
    free = (path.with_name(f"{stem}.kept{number if number > 1 else ''}{dot}{suffix}")
            for number in itertools.count(1))
    return next(one for one in free if not os.path.lexists(one))
