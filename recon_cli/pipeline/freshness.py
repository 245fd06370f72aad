"""Whether a result is still what it would be if it were made now, and if not, why.

Which options a result is held against: those it was made with, except where recon.toml, --config or
--set say otherwise. After `recon train --iterations 100`, `recon eval` finds the training fresh
although the default is another; after `iterations = 200` in recon.toml, it does not.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from recon_cli.config import settings as layers
from recon_cli.config.fields import StageConfig
from recon_cli.config.settings import Settings
from recon_cli.errors import ConfigError, ManifestError
from recon_cli.stages import IMPORT, Stage
from recon_cli.workspace.digests import Source, read_source
from recon_cli.workspace.layout import Workspace, changed_outputs
from recon_cli.workspace.manifest import Basis, Manifest, Unfinished, differences, how_far


@dataclass(frozen=True)
class Check:
    """What is known of one stage's result.

    Attributes:
        row: the stage.
        manifest: of the finished result; None where there is none.
        reasons: why the result is stale, in words; empty where it is fresh or missing.
        gone: inputs that were read once and are no longer there; that alone makes nothing stale.
        unfinished: an interrupted run that the next one would resume.
    """

    row: Stage
    manifest: Manifest | None
    reasons: tuple[str, ...] = ()
    gone: tuple[str, ...] = ()
    unfinished: Unfinished | None = None

    @property
    def fresh(self) -> bool:
        """Whether the result can be used as it is."""
        return self.manifest is not None and not self.reasons

    @property
    def state(self) -> str:
        """One of fresh, partial, stale, missing."""
        if self.fresh:
            return "fresh"
        if self.unfinished:
            return "partial"
        return "stale" if self.manifest else "missing"

    def described(self) -> str:
        """Returns the state with its reason or progress, as part of a sentence."""
        if self.state == "partial" and self.unfinished:
            return f"unfinished ({how_far(self.unfinished.done, self.unfinished.total)})"
        return f"{self.state}: {'; '.join(self.reasons)}" if self.reasons else self.state


def is_imported(basis: Basis) -> bool:
    """Tells whether a result is a scene that was imported: training reads no file of the user's."""
    return basis.stage == IMPORT.name and bool(basis.sources)


class Inspection:
    """One look at a workspace. Every stage is checked at most once, and nothing is changed.

    A stage that lies behind a stale one is stale too. One that lies behind a missing one is not:
    whether its input changed shows when that has been made again.

    Args:
        workspace: where the results lie.
        settings: what recon.toml, --config and --set set.
        table: the stages.
    """

    def __init__(self, workspace: Workspace, settings: Settings, table: Sequence[Stage]) -> None:
        self._workspace = workspace
        self._settings = settings
        self._rows = {row.name: row for row in table}
        self._checks: dict[str, Check] = {}

    def row(self, name: str) -> Stage:
        """Returns the row of a stage; what an imported scene spares it is not needed."""
        row = self._rows[name]
        if not row.spares or not self._imported:
            return row
        needs = tuple(need for need in row.needs if need not in row.spares)
        return dataclasses.replace(row, needs=needs, uses=(*row.spares, *row.uses))

    @cached_property
    def _imported(self) -> bool:
        """Whether the scene was imported; one whose manifest is damaged counts as trained."""
        try:
            manifest = self._workspace.manifest(IMPORT.name)
        except ManifestError:
            return False
        return manifest is not None and is_imported(manifest.basis)

    def check(self, name: str) -> Check:
        """Returns how a stage's result stands, held against the options it was made with.

        Raises:
            ManifestError: its manifest, or one before it, cannot be trusted.
            ConfigError: the settings hold a value that cannot be used.
        """
        if name not in self._checks:
            row, manifest = self.row(name), self._workspace.manifest(name)
            if manifest and is_imported(manifest.basis):
                row = IMPORT
            self._checks[name] = self._compared(
                row, manifest, self.config(row, manifest.basis if manifest else None))
        return self._checks[name]

    def check_against(
        self, name: str, config: StageConfig, sources: tuple[Source, ...] | None
    ) -> Check:
        """Returns how a stage's result stands, held against `config` and, if given, `sources`."""
        row = self.row(name)
        return self._compared(row, self._workspace.manifest(name), config, sources)

    def config(self, row: Stage, recorded: Basis | None) -> StageConfig:
        """Returns the options that a result was made with, overlaid by the settings."""
        known = {item.name for item in dataclasses.fields(row.config)}
        before: dict[str, Any] = {}
        if recorded:
            before = {key: value for key, value in recorded.config.items() if key in known}
        try:
            return layers.build(row.config, layers.merge(
                [{layers.section_of(row.config): before}, self._settings]))
        except ConfigError:
            # A newer recon may refuse what an older one took; what is set now must be right.
            return layers.build(row.config, self._settings)

    def upstream(self, row: Stage) -> dict[str, str | None]:
        """Returns the digests of what a stage reads; None for what is missing or left out."""
        digests: dict[str, str | None] = {}
        for name in (*row.needs, *row.uses):
            check = self.check(name)
            usable = check.fresh or (name in row.needs and check.manifest)
            digests[name] = check.manifest.digest if usable and check.manifest else None
        return digests

    def _compared(
        self,
        row: Stage,
        manifest: Manifest | None,
        config: StageConfig,
        sources: tuple[Source, ...] | None = None,
    ) -> Check:
        if manifest is None:
            return Check(row, None, unfinished=self._unfinished(row))
        gone: tuple[str, ...] = ()
        if sources is None:
            gone, sources = self._read_again(manifest.basis.sources)
        before = [self.check(need) for need in row.needs]
        reasons = [f"{one.row.name} is stale" for one in before if one.manifest and not one.fresh]
        expected = self._expected(row, config, manifest.basis, sources)
        reasons += differences(
            manifest.basis, expected, section=layers.section_of(row.config))
        reasons += changed_outputs(self._workspace.folder(row.name), manifest, row.volatile)
        reasons += _unreadable_summary(row, manifest)
        return Check(row, manifest, tuple(reasons), gone, self._unfinished(row))

    def _expected(
        self, row: Stage, config: StageConfig, recorded: Basis, sources: tuple[Source, ...]
    ) -> Basis:
        """Returns the basis that a run would have now."""
        upstream = self.upstream(row)
        for need in row.needs:  # what is missing now cannot be told from what was there
            upstream[need] = upstream[need] or recorded.upstream.get(need)
        return Basis(row.name, row.version, config.hashed_fields(), sources, upstream)

    def _read_again(
        self, recorded: tuple[Source, ...]
    ) -> tuple[tuple[str, ...], tuple[Source, ...]]:
        """Returns the sources that cannot be read any more, and all with what they hold by now."""
        gone = tuple(source.path for source in recorded if not os.access(source.path, os.R_OK))
        now = tuple(
            source if source.path in gone else
            read_source(Path(source.path), known=source, without=self._workspace.root)
            for source in recorded)
        return gone, now

    def _unfinished(self, row: Stage) -> Unfinished | None:
        """Returns an interrupted run if it could still be resumed."""
        unfinished = self._workspace.unfinished(row.name)
        if unfinished is None:
            return None
        basis = unfinished.basis
        _, sources = self._read_again(basis.sources)
        expected = self._expected(row, self.config(row, basis), basis, sources)
        return unfinished if expected.fingerprint == basis.fingerprint else None


def _unreadable_summary(row: Stage, manifest: Manifest) -> list[str]:
    """Returns why the record of a result cannot be read, as that of another version may not be."""
    try:
        if row.summary:
            row.summary.from_json(manifest.run.summary)
    except ManifestError as error:
        return [error.message]
    return []
