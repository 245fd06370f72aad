"""How a field of a config is declared (`option`) and checked (`StageConfig`).

The command line, recon.toml, the fingerprint of a stage and the documentation are all made from
these declarations, so that each option is written down once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from types import UnionType
from typing import Any, Self, get_args, get_origin, get_type_hints

from recon_cli.errors import MOST_CHARACTERS, ConfigError, ReconError

MOST = 2**31 - 1  # of any integer: the limit of COLMAP and others


@dataclass(frozen=True)
class OptionInfo:
    """The declaration of a field besides its type and default."""

    help: str  # one sentence
    unit: str = ""
    choices: tuple[str, ...] = ()  # the values that are allowed; empty for any
    minimum: float | None = None
    maximum: float | None = None
    hashed: bool = True  # the field affects the result, and so the fingerprint of its stage
    # it came later: at its default it is left out of the fingerprint, so that older results stay
    # fresh
    late: bool = False
    expert: bool = False  # --help leaves it to --help-all
    plain: Any = None  # the value that does without, of an optional part of the model
    formerly: str = ""  # its name in files of earlier versions
    old_words: Mapping[str, Any] = field(default_factory=dict)  # what values were called then
    # help of each choice that gets a flag of its own in place of one option: --force
    flags: Mapping[str, str] = field(default_factory=dict)
    automatic: str = ""  # what None means
    metavar: str = ""
    read: Callable[[str], Any] | None = None  # makes the value of the one word that is typed
    repeatable: bool = False  # may be given several times; the texts are joined by commas


def option(default: Any, help: str, **info: Any) -> Any:
    """Returns a dataclass field with its `OptionInfo`; see there for `info`."""
    return field(default=default, metadata={"option": OptionInfo(help, **info)})


def option_info(item: dataclasses.Field[Any]) -> OptionInfo:
    """Returns the declaration of `option` for a field."""
    info: OptionInfo = item.metadata["option"]
    return info


@cache  # else they are read anew for each field, which takes 5 ms a config
def _type_hints(config: Any) -> dict[str, Any]:
    return get_type_hints(config)


def field_type(config: type[StageConfig], name: str) -> tuple[type, bool]:
    """Returns the scalar type of a field and whether None is allowed."""
    of: Any = config  # mypy takes no class of a dataclass for hashable
    hint = _type_hints(of)[name]
    if get_origin(hint) is UnionType:
        return next(kind for kind in get_args(hint) if kind is not type(None)), True
    return hint, False


def member_types(kind: Any) -> tuple[type, ...]:
    """Returns the types of a tuple's members, (str, str, float); empty for any other field."""
    return get_args(kind) if get_origin(kind) is tuple else ()


@dataclass(frozen=True)
class StageConfig:
    """Base of every config: checks type, choices and range of each field, or raises ConfigError."""

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            object.__setattr__(self, item.name, self._check(item))

    def _check(self, item: dataclasses.Field[Any]) -> Any:
        """Returns the value of a field in the type that is declared."""
        name, info = item.name, option_info(item)
        value: Any = getattr(self, name)
        kind, optional = field_type(type(self), name)
        if value is None and optional:
            return None
        if member_types(kind):
            return self._check_members(name, value, member_types(kind))
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or isinstance(value, bool) is not (kind is bool):
            raise self._error(name, value, f"a value of type {kind.__name__}")
        if info.choices and value not in info.choices:
            raise self._error(name, value, "one of " + ", ".join(info.choices))
        if isinstance(value, float) and not math.isfinite(value):
            raise self._error(name, value, "a finite number")
        return self._check_range(name, value, info)

    def _check_range(self, name: str, value: Any, info: OptionInfo) -> Any:
        if info.minimum is not None and value < info.minimum:
            raise self._error(name, value, f"at least {info.minimum:g}")
        if info.maximum is not None and value > info.maximum:
            raise self._error(name, value, f"at most {info.maximum:g}")
        if isinstance(value, int) and abs(value) > MOST:
            raise self._error(name, value, f"at most {MOST}")
        return value

    def _check_members(self, name: str, value: Any, kinds: tuple[type, ...]) -> tuple[Any, ...]:
        """Returns a list or tuple as the tuple that is declared; TOML and JSON know lists only."""
        error = self._error(
            name, list(value) if isinstance(value, tuple) else value,
            f"{len(kinds)} values ({', '.join(kind.__name__ for kind in kinds)})")
        if not isinstance(value, (list, tuple)) or len(value) != len(kinds):
            raise error
        members: tuple[Any, ...] = tuple(
            float(member) if kind is float and type(member) is int else member
            for member, kind in zip(value, kinds, strict=True))
        for member, kind in zip(members, kinds, strict=True):
            infinite = isinstance(member, float) and not math.isfinite(member)
            if type(member) is not kind or infinite:
                raise error
        return members

    def _error(self, name: str, value: object, needed: str) -> ConfigError:
        return ConfigError(
            f"{name} is {repr(value)[:MOST_CHARACTERS]}, but it must be {needed}.",
            hint=f"Change --{name.replace('_', '-')} or {name} in recon.toml.")

    @property
    def parts(self) -> tuple[str, ...]:
        """The parts of the stage that are asked for besides its own result."""
        return ()

    def excuses(self, error: ReconError) -> bool:  # noqa: ARG002
        """Returns whether a part may be left out for this error."""
        return False

    @classmethod
    def late_fields(cls) -> tuple[str, ...]:
        """Returns the fields that the fingerprint leaves out at their default."""
        return tuple(item.name for item in dataclasses.fields(cls) if option_info(item).late)

    @classmethod
    def rename(cls, values: Mapping[str, Any]) -> dict[str, Any]:
        """Returns values that an earlier version may have written, by the names of now."""
        infos = {option_info(item).formerly or item.name: (item.name, option_info(item).old_words)
                 for item in dataclasses.fields(cls)}
        renamed = {}
        for name, value in values.items():
            now, words = infos.get(name, (name, {}))
            renamed[now] = words.get(value, value) if isinstance(value, str) else value
        return renamed

    @classmethod
    def plain_values(cls, *, late: bool = True) -> dict[str, Any]:
        """Returns the values of a model without optional parts, `late` options included or not."""
        infos = {item.name: option_info(item) for item in dataclasses.fields(cls)}
        return {name: info.plain for name, info in infos.items()
                if info.plain is not None and (late or not info.late)}

    @classmethod
    def refuse_contradictions(cls, values: Mapping[str, Any]) -> None:
        """Raises ConfigError where options that are given, default or not, exclude each other."""

    def settle(self) -> Self:
        """Returns the options with those that others fix; ConfigError where they contradict."""
        return self

    def hashed_fields(self) -> dict[str, Any]:
        """Returns the fields that affect the result, for the fingerprint; a tuple as a list."""
        values = {
            item.name: getattr(self, item.name) for item in dataclasses.fields(self)
            if option_info(item).hashed and not (
                option_info(item).late and getattr(self, item.name) == item.default)}
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values.items()}
