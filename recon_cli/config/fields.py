"""What --scale-between says, and what is refused of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from recon_cli.errors import ConfigError


@dataclass(frozen=True)
class OptionInfo:
    """What is said about a field beyond its type and default."""

    help: str
    unit: str = ""
    choices: tuple[str, ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    hashed: bool = True
    flags: bool = False  # each choice other than the default gets a flag of its own: --force
    automatic: str = ""  # what None means
    metavar: str = ""  # how --help names the values of a tuple
    read: Callable[[str], Any] | None = None  # makes the value of the one word that is typed


def option(default: Any, help: str, **info: Any) -> Any:
    """Returns a dataclass field with its `OptionInfo`; see there for `info`."""
    return field(default=default, metadata={"option": OptionInfo(help, **info)})


def option_info(item: dataclasses.Field[Any]) -> OptionInfo:
    """Returns what `option` recorded for a field."""
    info: OptionInfo = item.metadata["option"]
    return info


def field_type(config: type[StageConfig], name: str) -> tuple[type, bool]:
    """Returns the scalar type of a field and whether None is allowed."""
    hint = get_type_hints(config)[name]
    if get_origin(hint) is UnionType:
        inner = next(t for t in get_args(hint) if t is not type(None))
        return inner, True
    return hint, False


def member_types(kind: Any) -> tuple[type, ...]:
    """Returns the types of a tuple's members, (str, str, float); none where a field is no tuple."""
    return get_args(kind) if get_origin(kind) is tuple else ()


@dataclass(frozen=True)
class StageConfig:
    """Base of every config: checks type, choices and range of each field.

    Raises:
        ConfigError: a value has the wrong type or lies outside its range.
    """

    def __post_init__(self) -> None:
        for item in dataclasses.fields(self):
            object.__setattr__(self, item.name, self._checked(item))

    def _checked(self, item: dataclasses.Field[Any]) -> Any:
        value: Any = getattr(self, item.name)
        info = option_info(item)
        kind, optional = field_type(type(self), item.name)
        if value is None and optional:
            return None
        if member_types(kind):
            return self._checked_members(item.name, value, member_types(kind))
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or isinstance(value, bool) is not (kind is bool):
            raise self._refused(item.name, value, f"a value of type {kind.__name__}")
        if info.choices and value not in info.choices:
            raise self._refused(item.name, value, "one of " + ", ".join(info.choices))
        if isinstance(value, float) and not math.isfinite(value):
            raise self._refused(item.name, value, "a finite number")
        return self._within(item.name, value, info)

    def _checked_members(self, name: str, value: Any, kinds: tuple[type, ...]) -> Any:
        """Returns a list or tuple as the tuple that it should be; TOML and JSON know lists only."""
        needed = ", ".join(kind.__name__ for kind in kinds)
        if not isinstance(value, (list, tuple)) or len(value) != len(kinds):
            raise self._refused(name, value, f"{len(kinds)} values ({needed})")
        members: tuple[Any, ...] = tuple(
            float(one) if kind is float and type(one) is int else one
            for one, kind in zip(value, kinds, strict=True))
        for one, kind in zip(members, kinds, strict=True):
            if type(one) is not kind or (isinstance(one, float) and not math.isfinite(one)):
                raise self._refused(name, list(value), f"{len(kinds)} values ({needed})")
        return members

    def _within(self, name: str, value: Any, info: OptionInfo) -> Any:
        if info.minimum is not None and value < info.minimum:
            raise self._refused(name, value, f"at least {info.minimum:g}")
        if info.maximum is not None and value > info.maximum:
            raise self._refused(name, value, f"at most {info.maximum:g}")
        return value

    def _refused(self, name: str, value: object, needed: str) -> ConfigError:
        return ConfigError(
            f"{name} is {value!r}, but it must be {needed}.",
            hint=f"Change --{name.replace('_', '-')} or {name} in recon.toml.",
        )

    def hashed(self) -> dict[str, Any]:
        """Returns the fields that decide what comes out, as JSON keeps them.

        They are the config's part of a fingerprint. A tuple is a list there, as in a manifest.
        """
        values = {
            item.name: getattr(self, item.name)
            for item in dataclasses.fields(self)
            if option_info(item).hashed
        }
        return {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in values.items()}


def parse_holdout(text: str) -> tuple[str, float, float]:
    """Returns (kind, a, b) of --holdout: ("every", N, 0), ("segment", A, B) or ("none", 0, 0).

    Raises:
        ConfigError: the text is none of the three forms.
    """
    kind, *numbers = text.split(":")
    try:
        values = [float(number) for number in numbers]
    except ValueError:
        values = []
    if kind == "none" and not numbers:
        return kind, 0.0, 0.0
    if kind == "every" and len(values) == 1 and values[0] >= 2 and values[0].is_integer():
        return kind, values[0], 0.0
    if kind == "segment" and len(values) == 2 and 0 <= values[0] < values[1] <= 1:
        return kind, values[0], values[1]
    raise ConfigError(
        f"holdout is {text!r}, but it must be every:N (N >= 2), segment:A:B (0 <= A < B <= 1) "
        "or none.",
        hint="Try --holdout every:8.",
    )


SCALE_BETWEEN = (
    "Make one unit a metre: A and B are METRES apart. Each is a frame's name (where its camera "
    "was), x,y,z (a point of the scene as it is without this option) or FRAME:u,v (what the "
    "undistorted frame shows at that pixel).")
_MEASURE = "For example --scale-between 000003.png:120,200 000003.png:480,210 1.5"


def check_scale_between(value: tuple[str, str, float] | None) -> None:
    """Raises ConfigError where --scale-between measures nothing."""
    if value is None:
        return
    a, b, metres = value
    if a.strip() == b.strip() or not a.strip() or not b.strip():
        raise ConfigError(
            f"scale_between goes from {a!r} to {b!r}, but it must name two different places.",
            hint=_MEASURE)
    if metres <= 0:
        raise ConfigError(
            f"scale_between says {metres:g} metres, but it must be more than 0.", hint=_MEASURE)
