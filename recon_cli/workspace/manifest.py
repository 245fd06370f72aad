"""What a result was made from and how it came about: the record in each stage's folder."""

from __future__ import annotations

import dataclasses
import os
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from recon_cli.errors import FormatError, ManifestError
from recon_cli.workspace.atomic import read_json, write_json
from recon_cli.workspace.digests import (
    FileDigest,
    Source,
    digest_file,
    digest_outputs,
    matches,
)
from recon_cli.workspace.json_record import KEY, JsonRecord, sha256_json

NAME = "manifest.json"
SCENE = "splats.ply"  # in the results of train and prune
SCHEMA = 1
_NAME_BYTES = 255  # the most that file systems take
_MAX_REASONS = 3  # changes of one kind that are named; the rest is counted


def manifest_name(stage: str) -> str:
    """Returns the name of a manifest: that of `export.spz`, in the folder of export, has it in."""
    part = stage.partition(".")[2]
    return f"manifest.{part}.json" if part else NAME


@dataclass(frozen=True)
class ResultKey(JsonRecord):
    """Everything that decides what comes out of a stage."""

    stage: str  # its name
    version: int  # of the stage's code
    config: Mapping[str, Any]  # the hashed options
    # the user's own files, of ingest and import
    sources: tuple[Source, ...] = field(metadata={KEY: "inputs"})
    # digest of what each earlier stage wrote; None where a stage is left out
    upstream: Mapping[str, str | None]
    # digest of the finished result of this stage that the run goes on from; None where it begins
    # anew
    continues: str | None = None
    verb: str = ""  # that made it; empty in records of before verbs were kept

    @classmethod
    def from_json(cls, value: Any) -> Self:
        """Returns the key that `to_json` wrote; what once read views of sfm reads those of place.
        """
        key = super().from_json(value)
        if key.stage in ("sfm", "place") or "sfm" not in key.upstream:
            return key
        return dataclasses.replace(key, upstream={
            "place" if name == "sfm" else name: digest for name, digest in key.upstream.items()})

    @property
    def fingerprint(self) -> str:
        """SHA-256 over all but the verb, which the rest implies; of sources the contents count."""
        continues = {"continues": self.continues} if self.continues else {}
        return sha256_json({
            "stage": self.stage, "version": self.version, "config": self.config,
            "sources": [source.contents() for source in self.sources], "upstream": self.upstream,
            **continues})


@dataclass(frozen=True)
class RunRecord(JsonRecord):
    """How a result came about. Recorded for people, never hashed."""

    seconds: float  # of work, resumed runs added up
    peak_memory_bytes: int  # of the process and its children together
    summary: Mapping[str, Any]  # what the stage says about its result
    versions: Mapping[str, str]  # of Python, recon and the packages that matter
    device: str | None  # "cpu" or "cuda"; None for stages that do not render
    backend: str | None  # rasterizer; None for stages that do not render
    threads: int  # CPU threads
    finished: str  # ISO 8601 with time zone


@dataclass(frozen=True)
class _Result(JsonRecord):
    outputs: Mapping[str, FileDigest]
    digest: str


@dataclass(frozen=True)
class Manifest:
    """A finished result."""

    key: ResultKey  # what it was made from
    # digest of every file, by path relative to the stage's folder
    outputs: Mapping[str, FileDigest]
    digest: str  # of the outputs that later stages may depend on
    run: RunRecord  # how it came about

    def digest_of(self, patterns: Sequence[str]) -> str:
        """Returns the digest of the outputs alone whose paths match a pattern."""
        return digest_outputs({name: file for name, file in self.outputs.items()
                               if matches(name, patterns)}, ())

    def as_place(self) -> Manifest:
        """Returns the part of a result of sfm that `place` makes now."""
        key = dataclasses.replace(self.key, stage="place", version=1, upstream={
            **self.key.upstream, "sfm": self.digest})
        return dataclasses.replace(self, key=key, outputs={
            name: file for name, file in self.outputs.items()
            if matches(name, ("sparse/*", "undistorted/*", "world.json"))})

    def write(self, folder: Path) -> None:
        """Writes the manifest into a stage's folder, whole or not at all."""
        content = {
            "schema": SCHEMA, **self.key.to_json(), "fingerprint": self.key.fingerprint,
            **_Result(self.outputs, self.digest).to_json(), **self.run.to_json()}
        write_json(folder / manifest_name(self.key.stage), {
            **content, "self": sha256_json(content)})

    @classmethod
    def read(cls, folder: Path, name: str = NAME) -> Manifest:
        """Returns the manifest in a stage's folder; `name` is that of its file.

        Raises:
            ManifestError: it is truncated, was edited, has another schema, or names files that do
                not lie in the folder.
        """
        path = folder / name
        stage = folder.name + name.removeprefix("manifest").removesuffix(".json")
        clean = shlex.join(["recon", "clean", stage, "-w", str(folder.parent)])
        hint = f"Remove this result by `{clean}`, then make it again."
        if (folder / SCENE).is_file():
            hint = f"Copy {folder / SCENE}, the scene itself, elsewhere if you need it. {hint}"
        try:
            content = read_json(path, dict)
            schema = content.get("schema")
            if type(schema) is int and schema > SCHEMA:
                hint = "A newer recon made it: update recon. There is nothing to delete."
            if schema != SCHEMA:
                raise FormatError(
                    f"{path} has schema {str(schema)[:20]}, but this recon reads schema {SCHEMA}.")
            if content.pop("self", None) != sha256_json(content):
                raise FormatError(
                    f"{path} does not match its own checksum: it was edited or damaged.")
        except FormatError as error:
            raise ManifestError(error.message, hint=hint) from error
        try:
            result = _Result.from_json(content)
            for name in result.outputs:
                _check_output(name)
            return cls(ResultKey.from_json(content), result.outputs, result.digest,
                       RunRecord.from_json(content))
        except (ManifestError, ValueError, RecursionError) as error:
            raise ManifestError(
                f"{path} is not a manifest of recon: {error}.", hint=hint) from error


def _check_output(name: str) -> None:
    """Raises ValueError unless a name stays in the folder that it is relative to, on any system."""
    parts = name.split("/")
    if ("\0" in name or "\\" in name or ".." in parts or "" in parts or "." in parts
            or ":" in parts[0] or max(len(os.fsencode(part)) for part in parts) > _NAME_BYTES):
        raise ValueError(f"it names the output {name[:100]!r}, which is not a file of a stage")


def describe_progress(done: int, total: int) -> str:
    """Returns how far a run came, in a few words; `total` is 0 before anything was saved."""
    return f"{done}/{total}" if total else "just begun"


@dataclass(frozen=True)
class _Progress(JsonRecord):
    done: int
    total: int
    seconds: float


@dataclass(frozen=True)
class PartialRun:
    """How far an interrupted run came; lies beside its folder in .partial."""

    key: ResultKey
    done: int = 0
    total: int = 0
    seconds: float = 0.0

    def write(self, path: Path) -> None:
        """Writes the record, whole or not at all."""
        content = {
            "fingerprint": self.key.fingerprint, **self.key.to_json(),
            **_Progress(self.done, self.total, self.seconds).to_json()}
        write_json(path, {**content, "self": sha256_json(content)})

    @classmethod
    def read(cls, path: Path) -> PartialRun | None:
        """Returns the record, or None where there is none that can be trusted."""
        try:
            value = read_json(path, dict)
            if value.pop("self", None) != sha256_json(value):
                return None
            progress = _Progress.from_json(value)
            return cls(ResultKey.from_json(value), **dataclasses.asdict(progress))
        except (FormatError, ManifestError, RecursionError):
            return None


def version_differences(
    old: ResultKey, new: ResultKey, *, section: str, without: Collection[str] = (),
    late: Collection[str] = (),
) -> list[str]:
    """Returns in words how a result differs from what this version of recon could make.

    Options `without` are not compared; those that came `late` may be missing, for None.
    """
    reasons = []
    if old.version != new.version:
        reasons.append(f"stage version {old.version} -> {new.version}")
    skipped = {*without, *late}
    reasons += [f"option {section}.{name} is new" for name in new.config
                if name not in old.config and name not in skipped]
    return reasons + [f"option {section}.{name} no longer exists" for name in old.config
                      if name not in new.config and name not in skipped]


def differences(
    old: ResultKey, new: ResultKey, *, section: str, without: Collection[str] = (),
    late: Collection[str] = (),
) -> list[str]:
    """Returns in words how a result differs from that of a run now, but for the version of recon.

    The arguments are those of `version_differences`.
    """
    reasons = []
    for name in dict.fromkeys([*new.config, *old.config]):
        before, after = old.config.get(name), new.config.get(name)
        known = name in old.config and name in new.config
        if before != after and name not in without and (known or name in late):
            reasons.append(
                f"{section}.{name} changed: {_value_text(before)} -> {_value_text(after)}")
    reasons += _source_changes(old.sources, new.sources)
    for name in new.upstream:
        had, has = old.upstream.get(name), new.upstream.get(name)
        if had and has and had != has:
            reasons.append(f"{name}'s output changed")
        elif has and not had:
            reasons.append(f"{name} was missing")
        elif had and not has:
            reasons.append(f"{name} is missing or no longer fresh")
    return reasons


def find_changed_outputs(
    folder: Path, finished: Manifest, volatile: Sequence[str], removable: Sequence[str] = (),
    edits: str = "",
) -> list[str]:
    """Returns in words which outputs are no longer what the stage wrote.

    Names that match `volatile` may differ, those that match `removable` may be missing; a file that
    was added to the folder `edits` counts.
    """
    changes = []
    if edits:
        names = sorted(path.name for path in (folder / edits).glob("*") if path.is_file())
        changes = [f"{edits}/{name} was added by hand" for name in names
                   if f"{edits}/{name}" not in finished.outputs]
    for name, known in finished.outputs.items():
        path = folder / name
        if matches(name, volatile) or (
                matches(name, removable) and not os.path.lexists(path)):
            continue
        if not os.path.isfile(path):  # False, too, for a name that no system takes
            changes.append(f"output {name} is missing")
        elif digest_file(path, known).sha256 != known.sha256:
            changes.append(f"output {name} was changed by hand")
    return _shorten(changes)


def _shorten(texts: list[str]) -> list[str]:
    """Returns the first few texts and how many more there are."""
    more = len(texts) - _MAX_REASONS
    return texts if more <= 0 else [*texts[:_MAX_REASONS], f"and {more} more"]


def _source_changes(old: tuple[Source, ...], new: tuple[Source, ...]) -> list[str]:
    if [source.contents() for source in old] == [source.contents() for source in new]:
        return []
    if [source.path for source in old] != [source.path for source in new]:
        return [f"the input changed: {_paths(old)} -> {_paths(new)}"]
    changes = []
    for before, after in zip(old, new, strict=True):
        single = [Path(after.path).name] == list(after.files)
        folder = "" if single else f"{Path(after.path).name}/"
        for name in sorted({*before.files, *after.files}):
            had, has = before.files.get(name), after.files.get(name)
            if not had or not has:
                changes.append(f"the input {folder}{name} is {'gone' if had else 'new'}")
            elif had.sha256 != has.sha256:
                changes.append(f"the input {folder}{name} changed")
    return _shorten(changes)


def _paths(sources: tuple[Source, ...]) -> str:
    return ", ".join(Path(source.path).name for source in sources)


def _value_text(value: object) -> str:
    if value is None:
        return "automatic"
    return f"{value:g}" if isinstance(value, float) else str(value)
