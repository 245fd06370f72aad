"""Command-line options: those that every verb has, and those made from the config dataclasses.

An option stores its value in a `Call` and is passed to no function. A config field therefore is
written down once, in config.py, and only what was typed reaches the settings.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import click

from recon_cli.config.fields import OptionInfo, StageConfig, field_type, member_types, option_info
from recon_cli.config.settings import (
    FILE,
    SECTIONS,
    Settings,
    check,
    merged,
    parse_assignment,
    read_settings,
)
from recon_cli.config.stages import ComputeConfig
from recon_cli.context import ALONE, Ranks

Command = Callable[..., Any]
Decorator = Callable[[Command], Command]

_METAVARS = {int: "N", float: "X", str: "TEXT"}


@dataclass
class Call:
    """What was typed, collected option by option.

    Attributes:
        workspace: of -w, RECON_WORKSPACE or the default.
        config_file: of --config.
        verbose: -v.
        again: run even if up to date.
        print_config: show the merged options and stop.
        settings: the fields that were given as options of their own.
        assigned: the fields that were given by --set.
        ranks: the processes that train together, which this one leads; nobody types it.
    """

    workspace: Path = Path("workspace")
    config_file: Path | None = None
    verbose: bool = False
    again: bool = False
    print_config: bool = False
    settings: Settings = field(default_factory=dict)
    assigned: Settings = field(default_factory=dict)
    ranks: Ranks = ALONE


pass_call = click.make_pass_decorator(Call, ensure=True)


def verb(name: str) -> Callable[[Command], click.Command]:
    """Returns a decorator that makes a function the command `recon NAME`."""
    return click.command(name)


def explicit(call: Call) -> Settings:
    """Returns what recon.toml, --config and --set set, checked.

    Raises:
        ConfigError: a file cannot be read, or a value cannot be used.
    """
    inside = call.workspace / FILE
    found = [path for path in (inside if inside.exists() else None, call.config_file) if path]
    together = merged([*map(read_settings, found), call.assigned])
    check(together)
    return together


def _keep(name: str) -> Callable[[click.Context, click.Parameter, Any], None]:
    """Returns a callback that stores an option under an attribute of `Call`."""
    def keep(ctx: click.Context, _parameter: click.Parameter, value: Any) -> None:
        setattr(ctx.ensure_object(Call), name, value)

    return keep


def common(*, workspace: str = "workspace", envvar: str | None = "RECON_WORKSPACE") -> Decorator:
    """Returns a decorator that adds -w, --config and -v.

    Args:
        workspace: folder where -w is not given.
        envvar: environment variable that stands in for -w, if any.
    """
    return _stacked([
        click.option(
            "-w", "--workspace", type=click.Path(file_okay=False, path_type=Path),
            default=workspace, envvar=envvar, show_default=True, show_envvar=True,
            expose_value=False, callback=_keep("workspace"), help="Folder of all results."),
        click.option(
            "--config", "config_file", type=click.Path(dir_okay=False, path_type=Path),
            expose_value=False, callback=_keep("config_file"),
            help="TOML file with options; it wins over recon.toml in the workspace.  "
                 "[default: none]"),
        verbosity(),
    ])


def verbosity() -> Decorator:
    """Returns a decorator that adds -v."""
    return click.option(
        "-v", "--verbose", is_flag=True, expose_value=False, callback=_keep("verbose"),
        help="Show details, and the traceback of an error.  [default: off]")


def again() -> Decorator:
    """Returns a decorator that adds --again."""
    return click.option(
        "--again", is_flag=True, expose_value=False, callback=_keep("again"),
        help="Run even if the result is up to date.  [default: off]")


def print_config() -> Decorator:
    """Returns a decorator that adds --print-config."""
    return click.option(
        "--print-config", is_flag=True, expose_value=False, callback=_keep("print_config"),
        help="Print the options that would be used as TOML, and stop.  [default: off]")


def sweep() -> Decorator:
    """Returns a decorator that adds --sweep and --ratios."""
    def parse(_ctx: click.Context, parameter: click.Parameter, text: str) -> tuple[float, ...]:
        try:
            ratios = tuple(sorted({float(word) for word in text.split(",")}))
        except ValueError:
            ratios = ()
        if not ratios or not 0 < ratios[0] <= ratios[-1] < 1:
            raise click.BadParameter(
                f"{text!r} is no list of shares between 0 and 1, such as 0.5,0.8.",
                param=parameter)
        return ratios

    return _stacked([
        click.option(
            "--sweep", is_flag=True,
            help="Print what every score costs at every ratio on the validation views, with "
                 "controls, write sweep.json and sweep.svg into the workspace, and stop.  "
                 "[default: off]"),
        click.option(
            "--ratios", default="0.5,0.66,0.8,0.9", metavar="X,X,...", callback=parse,
            show_default=True, help="With --sweep: shares that are removed."),
    ])


def assignments(example: str = "train.iterations=1000") -> Decorator:
    """Returns a decorator that adds --set, for the verbs that run many stages.

    Args:
        example: that the help shows.
    """
    def keep(ctx: click.Context, _parameter: click.Parameter, values: tuple[str, ...]) -> None:
        ctx.ensure_object(Call).assigned = merged(parse_assignment(text) for text in values)

    return click.option(
        "--set", "assigned", multiple=True, metavar="SECTION.FIELD=VALUE", expose_value=False,
        callback=keep,
        help=f"Set an option of any stage, such as {example}; may be repeated.  [default: none]")


def stage(config: type[StageConfig], *, renders: bool = False) -> Decorator:
    """Returns a decorator that adds all options of a verb that runs one stage.

    Args:
        config: of the stage.
        renders: the stage needs a rasterizer, so that device and backend can be chosen.
    """
    compute: Decorator = of(ComputeConfig, only=() if renders else ("threads",))
    return _stacked([of(config), compute, again(), print_config(), common()])


def of(
    config: type[StageConfig], *, only: Sequence[str] = (), without: Sequence[str] = (),
    lead: str = "",
) -> Decorator:
    """Returns a decorator that adds an option for each field of a config.

    Args:
        config: the class.
        only: names of the fields to take; all if empty.
        without: names of fields to leave out.
        lead: text before each help.
    """
    section = next(name for name, kind in SECTIONS.items() if kind is config)
    decorators: list[Decorator] = []
    for item in dataclasses.fields(config):
        if item.name in without or (only and item.name not in only):
            continue
        info = option_info(item)
        text = f"{lead}{info.help}  [{described(item)}]"
        if info.flags:
            decorators += [
                _flag(section, item.name, choice, text)
                for choice in info.choices if choice != item.default]
        else:
            decorators.append(_field(section, config, item.name, info, text))
    return _stacked(decorators)


def described(item: dataclasses.Field[Any]) -> str:
    """Returns the unit and the default of a field as --help shows them."""
    info = option_info(item)
    if item.default is None:
        shown = info.automatic
    elif isinstance(item.default, float):
        shown = f"{item.default:g}"
    else:
        shown = str(item.default)
    return f"{info.unit}; default: {shown}" if info.unit else f"default: {shown}"


def _field(
    section: str, config: type[StageConfig], name: str, info: OptionInfo, text: str
) -> Decorator:
    kind, _ = field_type(config, name)
    flag = name.replace("_", "-")

    def keep(ctx: click.Context, _parameter: click.Parameter, value: Any) -> None:
        if value is not None:
            ctx.ensure_object(Call).settings.setdefault(section, {})[name] = (
                info.read(value) if info.read else value)

    return click.option(
        f"--{flag}/--no-{flag}" if kind is bool else f"--{flag}",
        f"{section}_{name}", type=_click_type(kind, info), default=None, expose_value=False,
        callback=keep,
        metavar=None if info.choices else info.metavar or _METAVARS.get(kind), help=text)


def _click_type(kind: type, info: OptionInfo) -> click.ParamType[Any]:
    if info.choices:
        return click.Choice(info.choices)
    if info.read:
        return click.STRING
    if member_types(kind):
        return click.Tuple(list(member_types(kind)))
    if kind is int:
        lowest = None if info.minimum is None else int(info.minimum)
        return click.IntRange(lowest, None if info.maximum is None else int(info.maximum))
    if kind is float:
        return click.FloatRange(info.minimum, info.maximum)
    return click.BOOL if kind is bool else click.STRING


def _flag(section: str, name: str, choice: str, text: str) -> Decorator:
    """Returns the option `--<choice>`, which sets the field to that choice."""
    def keep(ctx: click.Context, _parameter: click.Parameter, value: bool) -> None:
        if not value:
            return
        values = ctx.ensure_object(Call).settings.setdefault(section, {})
        if name in values:
            raise click.UsageError(f"--{values[name]} and --{choice} exclude each other.")
        values[name] = choice

    return click.option(
        f"--{choice}", f"{section}_{name}_{choice}", is_flag=True, expose_value=False,
        callback=keep, help=f"Set {name} to {choice}: {text}")


def _stacked(decorators: Sequence[Decorator]) -> Decorator:
    """Returns one decorator that applies all, so that --help lists them in this order."""
    def apply(function: Command) -> Command:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply
