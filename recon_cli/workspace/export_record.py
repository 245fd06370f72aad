"""The record of each exported file, and of the results and options that it was made of.

An export adds to its folder: a file of a format that is not asked for again stays. So every file
has a record of its own, by which it is fresh or stale whatever the stage's fingerprint says of
splats.ply.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from recon_cli.errors import ReconstructionError
from recon_cli.workspace.digests import matches
from recon_cli.workspace.export_formats import EXPORT_FORMATS, ExportFormat
from recon_cli.workspace.summaries import JsonRecord

# A default limit is about a loss that can be seen. At 45 dB the error is 1.4 of 255 levels (root
# mean square); rounding an image to 8 bits alone leaves 58.9 dB, 0.29 levels. Only pictures without
# noise, such as renders, get there; the scenes of photos stay below 40 dB.
CLEAN_DB = 45.0
VERSION = 6  # of the stage; goes up when the meaning of a file changes, and makes the others stale
_FRAME = ("scale_between", "transform", "up")
_SCENE = (*_FRAME, "crop", "drop_floaters", "drop_islands", "backdrop", "sh_degree", "max_mb")
_EARLIER = {"ingest": "other frames", "sfm": "earlier cameras", "train": "an earlier training",
            "prune": "an earlier pruning"}


def owns(name: str, path: str) -> bool:
    """Returns whether a relative path is that of a file of a format."""
    return matches(path, EXPORT_FORMATS[name].patterns)


@dataclass(frozen=True)
class LossLimit:
    """How many dB a file may lose on the views that it is checked on."""

    most_db: float
    clean_db: float = math.inf  # PSNR of a file against the views from which on any loss is allowed

    @staticmethod
    def from_option(row: ExportFormat, max_loss: float | None) -> LossLimit:
        """Returns the limit of --max-loss, or that of the format where it is not given."""
        return LossLimit(row.max_loss_db, CLEAN_DB) if max_loss is None else LossLimit(max_loss)

    def allows(self, change_db: float, psnr_db: float) -> bool:
        """Returns whether a file passes that changes the PSNR to `psnr_db`; a NaN does not."""
        return change_db >= -self.most_db or psnr_db >= self.clean_db


def loss_limit(name: str, options: Mapping[str, Any]) -> LossLimit:
    """Returns the limit of a format under the options of export."""
    return LossLimit.from_option(EXPORT_FORMATS[name], options["max_loss"])


def deciding_options(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the options of export that decide on the files of a format, as JSON values."""
    names = _FRAME if EXPORT_FORMATS[name].kind == "cameras" else _SCENE
    chosen = {key: options[key] for key in names} | own_options(name, options)
    return {key: list(value) if isinstance(value, tuple) else value
            for key, value in chosen.items()}


def own_options(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns those of the deciding options that the fingerprint of the stage leaves out."""
    row = EXPORT_FORMATS[name]
    own = {key: options[key] for key in row.options}
    if "max_loss" in own:  # how a .sog shares its colours depends on it
        own["max_loss"] = loss_limit(name, options).most_db
    if row.kind != "cameras":
        own["limited"] = limited_format(options)
    return own


def skip_options(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the options that decide whether a format loses too much, as JSON values."""
    return {**own_options(name, options), "max_loss": options["max_loss"]}


def limited_format(options: Mapping[str, Any]) -> str | None:
    """Returns the format whose size --max-mb limits, and the scene for its sake; None: none."""
    if options["max_mb"] is None:
        return None
    return str(options["format"]).split(",")[0].strip()


@dataclass(frozen=True, kw_only=True)
class ExportChange(JsonRecord):
    """The Gaussians and dB that an option of export removed."""

    option: str
    gaussians: int
    gaussians_before: int
    degree: int  # of the spherical harmonics
    degree_before: int
    psnr_change_db: float  # on the views that the export is checked on


@dataclass(frozen=True, kw_only=True)
class ExportedFile(JsonRecord):
    """A file or folder beside the exported .ply."""

    file: str  # name
    bytes: int | None = None  # None for a folder of cameras
    # None, as the next one, for what is not of Gaussians
    smaller: float | None = None  # size of the .ply over its size
    psnr_change_db: float | None = None  # on the views that the export is checked on
    psnr_db: float | None = None  # of the file on them; None where an older version wrote it
    inferred_share: float | None = None  # of a mesh: share of its area that no view confirms
    # sources: version, model, digests of stages, options; None where an older version wrote it
    made_of: Mapping[str, Any] | None = None
    stale: str | None = None  # why it no longer fits the .ply; None where it does


@dataclass(frozen=True, kw_only=True)
class FailedFormat(JsonRecord):
    """Why a format was not written."""

    message: str
    hint: str
    # the options with which it was left out, as --skip-lossy allows; None where it was not
    skipped_with: Mapping[str, Any] | None = None


@dataclass(frozen=True, kw_only=True)
class ExportSummary(JsonRecord):
    """The result of export."""

    model: str  # base or pruned
    file: str  # name of the .ply
    gaussians: int
    bytes: int  # of the .ply
    transform: Mapping[str, Any]  # similarity from the world of the training to the files
    changes: tuple[ExportChange, ...] | None = None  # by options, in order
    files: Mapping[str, ExportedFile] | None = None  # the other formats by name, kept ones too
    limited: str | None = None  # the format that --max-mb limited
    failed: Mapping[str, FailedFormat] | None = None  # the formats that could not be written
    own_files: tuple[str, ...] | None = None  # of the user, kept as they were
    notices: tuple[str, ...] | None = None  # for the user

    def contradictions(self, options: Mapping[str, Any]) -> tuple[str, ...]:
        """Returns which files that `options` ask for are missing, stale or made otherwise."""
        asked = (name.strip() for name in str(options["format"]).split(","))
        reasons = [self._doubt(name, options) for name in dict.fromkeys(asked) if name != "ply"]
        if self.limited != limited_format(options):
            reasons.insert(0, "another format was first, which --max-mb limits")
        return tuple(filter(None, reasons))

    def _doubt(self, name: str, options: Mapping[str, Any]) -> str:
        """Returns why the file of a format must be written again; empty if it need not."""
        found, failed = (self.files or {}).get(name), (self.failed or {}).get(name)
        if failed is not None:
            if options["skip_lossy"] and failed.skipped_with == skip_options(
                    name, options):
                return ""
            return f"{name} could not be written"
        if found is None:
            return f"{name} is not there yet"
        if found.stale:
            return f"{found.file} is stale: {found.stale}"
        limit = loss_limit(name, options)
        if not loss_is_small(found, limit):
            return f"{found.file} loses more than {limit.most_db:g} dB"
        made_of = found.made_of or {}
        before = {key: value for key, value in made_of.items() if key in own_options(
            name, options)}
        changed = describe_changes(before, own_options(name, options))
        return f"{found.file} is stale: {changed}" if changed else ""

    def not_recorded(self) -> tuple[str, ...]:
        """Returns the files of the user, which may change without making the export stale."""
        return self.own_files or ()

    def failure(self) -> ReconstructionError | None:
        """Returns the error about the formats that failed, where any did."""
        failed = [one for one in (self.failed or {}).values() if one.skipped_with is None]
        if not failed:
            return None
        kept = [self.file, *(one.file for one in (self.files or {}).values() if not one.stale)]
        reasons = [one.message for one in failed]
        hints = dict.fromkeys(one.hint for one in failed if one.hint)
        return ReconstructionError(
            f"{' '.join(reasons)} Written: {', '.join(kept)}.", hint=" ".join(hints))


def loss_is_small(found: ExportedFile, limit: LossLimit) -> bool:
    """Returns whether a file loses no more than is allowed."""
    psnr_db = -math.inf if found.psnr_db is None else found.psnr_db
    return found.psnr_change_db is None or limit.allows(found.psnr_change_db, psnr_db)


def describe_changes(before: Mapping[str, Any] | None, now: Mapping[str, Any]) -> str:
    """Returns in words which source of a file has changed; empty if none has."""
    if before is None or before.get("version") != now.get("version"):
        return "another version of recon wrote it"
    for key, value in now.items():
        had = before.get(key)
        if had == value or (had is None and value is False):
            continue
        if key == "model":
            return f"it shows the {had} model"
        if key in _EARLIER:
            return f"it was made from {_EARLIER[key]}" if had else f"{key} was missing"
        if key == "limited":
            return f"--max-mb limited {had or 'nothing'}"
        if had is None or had is False:
            return f"it was written before {_option_text(key, value)}"
        return f"it was written with {_option_text(key, had)}"
    return ""


def _option_text(name: str, value: Any) -> str:
    """Returns an option as it is typed; the path of a matrix is not known."""
    words = [f"--{name.replace('_', '-')}"]
    if name != "transform" and value is not True:
        words += map(_number_text, value if isinstance(value, list) else [value])
    return " ".join(words)


def _number_text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def main_file(name: str, recorded: str) -> str:
    """Returns the path of the file of a format that is always there."""
    index = EXPORT_FORMATS[name].index
    return f"{recorded}/{index}" if index else recorded
