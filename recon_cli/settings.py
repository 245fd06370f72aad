"""Where values come from: defaults, recon.toml, --config, the command line; a later layer wins."""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from recon_cli.config import (
    ComputeConfig,
    DenoiseConfig,
    EvaluateConfig,
    ExportConfig,
    IngestConfig,
    PruneConfig,
    SfmConfig,
    TrainConfig,
)
from recon_cli.errors import ConfigError
from recon_cli.fields import StageConfig, option_info

SECTIONS: dict[str, type[StageConfig]] = {
    "ingest": IngestConfig,
    "denoise": DenoiseConfig,
    "sfm": SfmConfig,
    "train": TrainConfig,
    "prune": PruneConfig,
    "evaluate": EvaluateConfig,
    "export": ExportConfig,
    "compute": ComputeConfig,
}

Settings = dict[str, dict[str, Any]]  # section -> field -> value, only what was set
C = TypeVar("C", bound=StageConfig)


def read_settings(path: Path) -> Settings:
    """Returns what a recon.toml sets, with every section and field name checked.

    Raises:
        ConfigError: the file is no TOML, or names a section or field that does not exist.
    """
    try:
        with path.open("rb") as file:
            settings = tomllib.load(file)
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path} does not exist.", hint="Check the path after --config.") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not valid TOML: {error}.", hint="Mend that line.") from error
    for section, values in settings.items():
        if section not in SECTIONS or not isinstance(values, dict):
            raise ConfigError(
                f"{path} holds [{section}], which is no section.",
                hint="The sections are " + ", ".join(SECTIONS) + ".")
        for name in values:
            check_field(section, name, where=str(path))
    return settings


def check_field(section: str, name: str, *, where: str) -> None:
    """Raises ConfigError unless `section` has a field `name`; `where` is named in the message."""
    names = [item.name for item in dataclasses.fields(SECTIONS[section])]
    if name not in names:
        raise ConfigError(
            f"{where} sets {section}.{name}, which does not exist.",
            hint=f"[{section}] knows " + ", ".join(names) + ".")


def merged(layers: Iterable[Mapping[str, Mapping[str, Any]]]) -> Settings:
    """Returns the settings of all layers; a later layer wins, field by field."""
    result: Settings = {section: {} for section in SECTIONS}
    for layer in layers:
        for section, values in layer.items():
            result[section].update(values)
    return result


def build(config: type[C], settings: Mapping[str, Mapping[str, Any]]) -> C:
    """Returns the frozen instance of one config class that `settings` describe."""
    section = next(name for name, kind in SECTIONS.items() if kind is config)
    return config(**settings.get(section, {}))


def to_toml(configs: Mapping[str, StageConfig]) -> str:
    """Returns the configs as TOML that `read_settings` accepts; unset fields become comments."""
    lines: list[str] = []
    for section, config in configs.items():
        lines.append(f"[{section}]")
        for item in dataclasses.fields(config):
            value, info = getattr(config, item.name), option_info(item)
            if value is None:
                lines.append(f"# {item.name} = automatic: {info.automatic}")
            else:
                text = str(value).lower() if isinstance(value, bool) else repr(value)
                lines.append(f"{item.name} = {text.replace(chr(39), chr(34))}")
        lines.append("")
    return "\n".join(lines)
