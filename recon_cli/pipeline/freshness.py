"""Whether a run would make the same result now, and if not, why.

A result is compared with the options it was made with, except where recon.toml, --config or --set
say otherwise. After `recon train --iterations 100`, `recon eval` finds the training fresh although
the default is another; after `iterations = 200` in recon.toml, it does not.
"""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from recon_cli.config import settings as layers
from recon_cli.config.fields import StageConfig
from recon_cli.config.settings import Settings
from recon_cli.errors import ConfigError, ManifestError
from recon_cli.pipeline.continuation import is_imported, made_by, may_resume, origin_row
from recon_cli.stages import IMPORT, Stage
from recon_cli.workspace.digests import Source, digest_file, read_source
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.manifest import (
    SCENE,
    Manifest,
    PartialRun,
    ResultKey,
    describe_progress,
    differences,
    find_changed_outputs,
    version_differences,
)

logger = logging.getLogger("recon")


@dataclass(frozen=True)
class StageCheck:
    """The state of one stage's result."""

    row: Stage  # the stage
    manifest: Manifest | None  # of the finished result; None where there is none
    reasons: tuple[str, ...] = ()  # why the result is stale; empty where it is fresh or missing
    # how another version of recon made it that is not stale; this one would make another
    version_reasons: tuple[str, ...] = ()
    newer: bool = False  # a later version of recon made it, or what it was made from
    gone: tuple[str, ...] = ()  # inputs that no longer exist; that alone makes nothing stale
    partial_run: PartialRun | None = None  # an interrupted run that the next one would resume
    damage: ManifestError | None = None  # why the manifest of a result cannot be trusted

    @property
    def fresh(self) -> bool:
        """Whether a run would make the same result now."""
        return self.usable and not self.version_reasons

    @property
    def usable(self) -> bool:
        """Whether the result is what it was made to be, be it by another version of recon."""
        return self.manifest is not None and not self.reasons

    @property
    def state(self) -> str:
        """One of damaged, fresh, partial, older, newer, stale, missing."""
        if self.damage:
            return "damaged"
        if self.fresh:
            return "fresh"
        if self.partial_run:
            return "partial"
        if self.manifest and self.usable:
            return "newer" if self.newer else "older"
        return "stale" if self.manifest else "missing"

    def describe(self) -> str:
        """Returns the state with its reason or progress, as part of a sentence."""
        partial = self.partial_run
        if partial and not self.fresh:
            return f"unfinished ({describe_progress(partial.done, partial.total)})"
        state = self.state
        if state in ("older", "newer"):
            state = f"made by {'a newer' if self.newer else 'an older'} version of recon"
        reasons = "; ".join((*self.reasons, *self.version_reasons))
        return f"{state}: {reasons}" if reasons else state


class WorkspaceCheck:
    """The checks of a workspace as it is now, each made once. Nothing is changed.

    A stage behind a stale one is stale too; one behind a missing one is not, until that is made.
    A damaged manifest is an error, or with `tolerant` a state of its own.
    """

    def __init__(
        self, workspace: Workspace, settings: Settings, table: Sequence[Stage], *,
        tolerant: bool = False,
    ) -> None:
        self._tolerant = tolerant
        self._workspace = workspace
        self._settings = settings
        self._rows = {row.name: row for top in table for row in (top, *top.parts)}
        self._checks: dict[str, StageCheck] = {}

    def row(self, name: str) -> Stage:
        """Returns the row of a stage, without the needs that an imported scene spares it."""
        row = self._rows[name]
        if not row.optional_when_imported or not self._imported:
            return row
        needs = tuple(need for need in row.needs if need not in row.optional_when_imported)
        return dataclasses.replace(row, needs=needs, uses=(*row.optional_when_imported, *row.uses))

    @cached_property
    def _imported(self) -> bool:
        """Whether the scene was imported; one whose manifest is damaged counts as trained."""
        try:
            manifest = self._workspace.manifest(IMPORT.name)
        except ManifestError:
            return False
        return manifest is not None and is_imported(manifest.key)

    def check(self, name: str) -> StageCheck:
        """Returns the check of a stage's result against the options it was made with.

        Raises:
            ManifestError: its manifest, or one before it, cannot be trusted.
            ConfigError: the settings hold a value that cannot be used.
        """
        if name not in self._checks:
            self._checks[name] = self._check(name)
        return self._checks[name]

    def _check(self, name: str) -> StageCheck:
        row = self.row(name)
        try:
            manifest = self._workspace.manifest(name)
        except ManifestError as error:
            if not self._tolerant:
                raise
            return StageCheck(row, None, (error.message,), damage=error)
        if manifest:
            row = origin_row(row, manifest.key)
        return self._compare(row, manifest, self.config(row, manifest.key if manifest else None))

    def check_against(
        self, name: str, config: StageConfig, sources: tuple[Source, ...] | None
    ) -> StageCheck:
        """Returns the check of a stage's result against `config` and, if given, `sources`."""
        return self._compare(self.row(name), self._workspace.manifest(name), config, sources)

    @property
    def finished_scene(self) -> Path | None:
        """The trained or imported scene, as it was written; None where there is none."""
        path = self._workspace.folder(IMPORT.name) / SCENE
        manifest = self.check(IMPORT.name).manifest
        known = manifest.outputs.get(SCENE) if manifest else None
        if known is None or not path.is_file() or digest_file(path, known).sha256 != known.sha256:
            return None
        return path

    def config(self, row: Stage, key: ResultKey | None) -> StageConfig:
        """Returns the known options that a result was made with, overlaid by the settings."""
        names = {item.name for item in dataclasses.fields(row.config)} if key else set()
        stored = {
            name: value for name, value in row.config.rename(key.config if key else {}).items()
            if name in names and _accepts(row.config, name, value)}
        try:
            return layers.build(row.config, layers.merge(
                [{layers.section_of(row.config): stored}, self._settings]))
        except ConfigError:  # stored values that exclude each other or the present ones
            return layers.build(row.config, self._settings)

    def upstream(self, row: Stage) -> dict[str, str | None]:
        """Returns the digests of a stage's inputs; None for those that are missing or left out."""
        digests: dict[str, str | None] = {}
        for name in (*row.needs, *row.uses):
            check = self.check(name)
            digests[name] = None
            if check.manifest and (check.usable or name in row.needs):
                digests[name] = check.manifest.digest if name not in row.reads else (
                    check.manifest.digest_of(row.reads[name]))
        return digests

    def siblings(self, row: Stage) -> list[StageCheck]:
        """Returns the checks of the other stages that the verb of a stage makes, as `place`."""
        return [self.check(other.name) for other in self._rows.values()
                if other.verb == row.verb and other.name != row.name
                and not (row.part or other.part)]

    def _compare(
        self, row: Stage, manifest: Manifest | None, config: StageConfig,
        sources: tuple[Source, ...] | None = None,
    ) -> StageCheck:
        if manifest is None:
            return StageCheck(row, None, partial_run=self._resumable(row))
        verb = made_by(manifest.key)
        if verb not in ("", row.verb):
            reason = f"it was made by `recon {verb}`"
            return StageCheck(row, manifest, (reason,), partial_run=self._resumable(row))
        gone: tuple[str, ...] = ()
        if sources is None:
            gone, sources = self._read_again(manifest.key.sources)
        needs = [self.check(need) for need in row.needs]
        reasons = [
            f"{check.row.name} is {'damaged' if check.damage else 'stale'}" for check in needs
            if check.damage or (check.manifest and not check.usable)]
        version_reasons = [] if row.reads_other_versions else [
            f"{check.row.name} is {check.state}" for check in needs
            if check.usable and not check.fresh]
        newer = manifest.key.version > row.version or any(
            check.state == "newer" for check in needs)
        stored = dataclasses.replace(
            manifest.key, config=row.config.rename(manifest.key.config))
        keys = stored, self._current_key(row, config, stored, sources)
        section, late = layers.section_of(row.config), row.config.late_fields()
        gone_values = {name: value for name, value in stored.config.items()
                       if name in keys[1].config and not _accepts(row.config, name, value)}
        version_reasons += [f"{section}.{name} no longer takes {str(value)[:40]}"
                            for name, value in gone_values.items()]
        without = {*gone_values, *(item.name for item in dataclasses.fields(row.config)
                                   if row.options is not None and item.name not in row.options)}
        version_reasons += version_differences(*keys, section=section, without=without, late=late)
        reasons += differences(*keys, section=section, without=without, late=late)
        reasons += find_changed_outputs(
            self._workspace.folder(row.name), manifest, row.volatile, row.states, row.edits)
        try:  # another version may have written another record
            summary = row.summary.from_json(manifest.run.summary)
            reasons += summary.contradictions(dataclasses.asdict(config))
        except ManifestError as error:
            version_reasons.append(error.message)
        return StageCheck(
            row, manifest, tuple(reasons), tuple(version_reasons), newer, gone,
            self._resumable(row))

    def _current_key(
        self, row: Stage, config: StageConfig, stored: ResultKey, sources: tuple[Source, ...]
    ) -> ResultKey:
        """Returns the key that the result of a run would have now."""
        upstream = self.upstream(row)
        for need in row.needs:  # a missing result may well come out as it was
            upstream[need] = upstream[need] or stored.upstream.get(need)
        return ResultKey(
            row.name, row.version, row.key_options(config), sources, upstream, stored.continues,
            row.verb)

    def _read_again(self, stored: tuple[Source, ...]) -> tuple[tuple[str, ...], tuple[Source, ...]]:
        """Returns the paths of sources that cannot be read any more, and all as they are now."""
        gone = tuple(source.path for source in stored if not os.access(source.path, os.R_OK))
        return gone, tuple(
            source if source.path in gone else
            read_source(Path(source.path), known=source, without=self._workspace.root)
            for source in stored)

    def _resumable(self, row: Stage) -> PartialRun | None:
        """Returns the interrupted run of a stage if the next run would resume it."""
        partial = self._workspace.partial_run(row.name)
        if partial is None or not may_resume(self._workspace, partial):
            return None
        _, sources = self._read_again(partial.key.sources)
        expected = self._current_key(row, self.config(row, partial.key), partial.key, sources)
        return partial if expected.fingerprint == partial.key.fingerprint else None


def warn_of_other_versions(checks: Iterable[StageCheck], verb: str) -> None:
    """Logs which results that `verb` reads another version of recon made, in one line."""
    others = [f"{check.row.name} ({'; '.join(check.version_reasons)})" for check in checks
              if check.usable and not check.fresh]
    if others:
        logger.warning("%s takes as it is what another version of recon made: %s",
                       verb, ", ".join(others))


def _accepts(config: type[StageConfig], name: str, value: object) -> bool:
    """Returns whether a stored value may still be used; a newer recon may know fewer choices."""
    try:
        config(**{name: value})
    except ConfigError:
        return False
    return True
