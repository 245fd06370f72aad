"""Where options come from: defaults, recon.toml, --config, the command line; later ones win."""

from __future__ import annotations

import dataclasses
import difflib
import json
import os
import shlex
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from recon_cli.config.export import ExportConfig
from recon_cli.config.fields import StageConfig, field_type, member_types, option_info
from recon_cli.config.stages import (
    ComputeConfig,
    DenoiseConfig,
    EvaluateConfig,
    ImportConfig,
    IngestConfig,
    PruneConfig,
    SfmConfig,
    TrainConfig,
)
from recon_cli.errors import ConfigError, Hint
from recon_cli.workspace.atomic import read_text

SECTIONS: dict[str, type[StageConfig]] = {
    "ingest": IngestConfig,
    "denoise": DenoiseConfig,
    "sfm": SfmConfig,
    "train": TrainConfig,
    "prune": PruneConfig,
    "evaluate": EvaluateConfig,
    "export": ExportConfig,
    "import": ImportConfig,
    "compute": ComputeConfig,
}

# Options that are gone, with the values that ask for what is done now: a file of an earlier
# version, as `--print-config` wrote it, still means the same.
GONE: dict[str, dict[str, tuple[Any, ...]]] = {
    "denoise": {"filter": ("bilateral",)},
    "train": {"poses": ("auto", "off"), "densify_scale": (0.01,), "tone": ("off",),
              "blur": ("auto", "off"), "shutter": (), "far": (), "look": ()},
    "merge": {"validation": (0.05,)},
    "prune": {"sweep": (), "ratios": ()},
    "evaluate": {"seeds": ()},
    "export": {"drop_backdrop": (False,)},
}

SUCCESSORS: Mapping[tuple[str, str], str | Hint] = {
    ("export", "drop_backdrop"): "Give --backdrop drop, in a file backdrop = 'drop'.",
    ("prune", "sweep"): Hint("prune", "--again --score NAME --ratio X", then=" for each"),
    ("evaluate", "seeds"): "`recon study --scenes WORKSPACE --seeds N` trains with N seeds.",
    ("train", "far"): "Give --background, in a file background.",
    ("train", "look"): "Give --brightness filmed or even, in a file brightness."}
FILE = "recon.toml"  # in the workspace
Settings = dict[str, dict[str, Any]]  # section -> field -> value, explicit ones only
C = TypeVar("C", bound=StageConfig)
AUTOMATIC = "automatic"  # how None is written in --set
_TRUTH = {"true": True, "false": False}


def read_settings(path: Path) -> Settings:
    """Returns the checked settings of a recon.toml; ConfigError if it is missing or wrong."""
    try:
        settings = tomllib.loads(read_text(path))
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror}.",
            hint=f"Check {path.name}, and the path after --config where you gave one.") from error
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else error
        raise ConfigError(
            f"{path} is not valid TOML: {reason}.", hint=f"Fix {path.name}.") from error
    settings = _drop_gone({
        section: SECTIONS[section].rename(values)
        if section in SECTIONS and isinstance(values, dict) else values
        for section, values in settings.items()})
    for section, values in settings.items():
        check_names(section, (), where=str(path))
        if not isinstance(values, dict):
            raise ConfigError(
                f"{path} sets {section} to {values!r}, but it is a section.",
                hint=f"Write [{section}] on a line of its own and its fields below it.")
        check_names(section, values, where=str(path))
        _check_values(section, values, where=f"{path}: {section}.")
    return settings


def read_explicit(
    workspace: Path, config_file: Path | None = None, assigned: Settings | None = None
) -> Settings:
    """Returns what the recon.toml of a workspace, another file and `assigned` set; later ones win.

    ConfigError if a file or a value cannot be used.
    """
    in_workspace = workspace / FILE
    # A link that leads nowhere is an error, not the same as none.
    files = [in_workspace] if os.path.lexists(in_workspace) else []
    files += [config_file] if config_file else []
    settings = merge([*map(read_settings, files), assigned or {}])
    check(settings)
    return settings


def _drop_gone(settings: dict[str, Any]) -> dict[str, Any]:
    """Returns the settings of a file without options that are GONE and ask for nothing else."""
    kept: dict[str, Any] = {}
    for section, values in settings.items():
        gone = GONE.get(section, {})
        if not isinstance(values, dict):
            kept[section] = values
            continue
        left = {name: value for name, value in values.items()
                if name not in gone or value not in gone[name]}
        if left or section in SECTIONS:
            kept[section] = left
    return kept


def parse_assignment(text: str) -> Settings:
    """Returns the setting of `section.field=value`, of the field's type, or raises ConfigError."""
    path, equals, value = text.partition("=")
    section, dot, name = path.strip().partition(".")
    if not equals or not dot:
        raise ConfigError(
            f"--set takes section.field=value, but got {text!r}.",
            hint="For example --set train.iterations=1000.")
    check_names(section, [name], where="--set")
    settings = {section: {name: _parse_value(section, name, value.strip())}}
    _check_values(section, settings[section], where=f"--set {section}.")
    return settings


def _parse_value(section: str, name: str, text: str) -> Any:
    """Returns the text after `=` in the type of the field."""
    kind, optional = field_type(SECTIONS[section], name)
    if optional and text == AUTOMATIC:
        return None
    members = member_types(kind)
    try:
        if members:
            words = zip(shlex.split(text), members, strict=True)
            return tuple(member(word) for word, member in words)
        return _TRUTH[text] if kind is bool else kind(text)
    except (KeyError, ValueError) as error:
        needed = "true or false" if kind is bool else f"a value of type {kind.__name__}"
        if members:
            names = ", ".join(member.__name__ for member in members)
            needed = f"{len(members)} values ({names}) with spaces between"
        raise ConfigError(
            f"{section}.{name} is {text!r}, but it must be {needed}.",
            hint="Change it in --set.") from error


def check_names(section: str, names: Iterable[str], *, where: str) -> None:
    """Raises ConfigError unless the section and its fields exist; `where` sets them."""
    if section not in SECTIONS:
        raise ConfigError(
            f"{where} holds the section {section}, which does not exist.",
            hint=_suggest(section, list(SECTIONS), "Sections:"))
    known = [item.name for item in dataclasses.fields(SECTIONS[section])]
    for name in names:
        if name in GONE.get(section, {}):
            raise ConfigError(
                f"{where} sets {section}.{name}, which recon no longer has.",
                hint=SUCCESSORS.get((section, name)) or (
                    f"Delete the line {name} = ... below [{section}] in a file, and leave out "
                    f"--set {section}.{name}."))
        if name not in known:
            raise ConfigError(
                f"{where} sets {section}.{name}, which does not exist.",
                hint=_suggest(name, known, f"Options of [{section}]:"))


def _check_values(section: str, values: Mapping[str, Any], *, where: str) -> None:
    """Raises ConfigError, with `where` before its message, unless the values can be used."""
    try:
        SECTIONS[section](**values).settle()
    except ConfigError as error:
        raise ConfigError(f"{where}{error.message}", hint=error.hint) from error
    except OverflowError as error:  # an integer for a float
        raise ConfigError(
            f"{where.rstrip('.')}: a number has too many digits.",
            hint="Write a smaller one.") from error


def _suggest(word: str, known: list[str], lead: str) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f"Did you mean {close[0]}?" if close else f"{lead} {', '.join(known)}."


def merge(layers: Iterable[Mapping[str, Mapping[str, Any]]]) -> Settings:
    """Returns the settings of all layers; a later layer wins, field by field."""
    result: Settings = {section: {} for section in SECTIONS}
    for layer in layers:
        for section, values in layer.items():
            result[section].update(values)
    return result


def build(config: type[C], settings: Mapping[str, Mapping[str, Any]]) -> C:
    """Returns the config of one class with the values of `settings`."""
    values = settings.get(section_of(config), {})
    config.refuse_contradictions(values)
    return config(**values).settle()


def section_of(config: type[StageConfig]) -> str:
    """Returns the section that sets the fields of a config class."""
    return next(name for name, kind in SECTIONS.items() if kind is config)


def check(settings: Mapping[str, Mapping[str, Any]]) -> None:
    """Raises ConfigError where a value has the wrong type or range, in whichever section."""
    for config in SECTIONS.values():
        build(config, settings)


def to_toml(configs: Mapping[str, StageConfig]) -> str:
    """Returns the configs as TOML that `read_settings` accepts; unset fields become comments."""
    lines: list[str] = []
    for section, config in configs.items():
        lines.append(f"[{section}]")
        for item in dataclasses.fields(config):
            value, info = getattr(config, item.name), option_info(item)
            if value is None:
                lines.append(f"# {item.name} = {AUTOMATIC}: {info.automatic}")
            else:
                # TOML writes strings, numbers and truth values as JSON does.
                lines.append(f"{item.name} = {json.dumps(value, ensure_ascii=False)}")
        lines.append("")
    return "\n".join(lines)
