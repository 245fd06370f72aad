"""Command-line options: those that every verb has, and those made from the config dataclasses.

An option stores its value in a `Call` and is passed to no function. A config field therefore is
declared once, below config/, and only typed options reach the settings.
"""

from __future__ import annotations

import dataclasses
import inspect
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from recon_cli.commands.console import LOG_FORMATS, Style
from recon_cli.commands.usage import HintedUsageError, suggest_command
from recon_cli.config.fields import OptionInfo, StageConfig, field_type, member_types, option_info
from recon_cli.config.settings import (
    Settings,
    merge,
    parse_assignment,
    read_explicit,
    section_of,
)
from recon_cli.config.stages import ComputeConfig, PruneConfig, TrainConfig
from recon_cli.deadline import Deadline
from recon_cli.errors import use_workspace
from recon_cli.jobs.executor import CORES
from recon_cli.workspace.export_formats import READABLE
from recon_cli.workspace.paths import refuse_special

if TYPE_CHECKING:
    from click.types import OptionHelpExtra

HELP_ALL = "recon.help_all"  # in a context's meta: the second page of help is printed
Command = Callable[..., Any]
Decorator = Callable[[Command], Command]

_METAVARS = {int: "N", float: "X", str: "TEXT"}


@dataclass
class Call(Style):
    """The typed command line, collected option by option."""

    workspace: Path = Path("workspace")  # of -w, RECON_WORKSPACE or the default
    config_file: Path | None = None
    again: bool = False
    from_import: bool = False
    print_config: bool = False
    settings: Settings = field(default_factory=dict)  # given as options of their own
    assigned: Settings = field(default_factory=dict)  # given by --set
    deadline: Deadline = field(default_factory=Deadline)  # for what stages may do without


pass_call = click.make_pass_decorator(Call, ensure=True)


class _HelpFormatter(click.HelpFormatter):
    """Leaves more of a line to the text of an option than click does."""

    def write_dl(
        self, rows: Iterable[tuple[str, str]], col_max: int = 24, col_spacing: int = 2
    ) -> None:
        """Writes names and texts in two columns."""
        super().write_dl(rows, col_max, col_spacing)


class _VerbContext(click.Context):
    formatter_class = _HelpFormatter


class Verb(click.Command):
    """A command whose --help leaves out expert options and ranges, which --help-all shows."""

    context_class = _VerbContext

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parses the words after the verb; where there are too many, says what to type instead."""
        ctx.allow_extra_args = True
        rest = super().parse_args(ctx, args)
        if rest and not ctx.resilient_parsing and not isinstance(self, click.Group):
            raise HintedUsageError(
                f"{ctx.command_path} does not take {' '.join(rest)}.",
                hint=suggest_command(ctx.command_path, rest), ctx=ctx)
        return rest

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Returns the options with --help and --help-all as the last ones."""
        params = super().get_params(ctx)
        return [*params, self._help_all] if self._help_all else params

    @cached_property
    def _help_all(self) -> click.Option | None:
        count = sum(isinstance(option, Option) and option.expert for option in self.params)
        if not count:
            return None
        return click.Option(
            ["--help-all"], is_flag=True, is_eager=True, expose_value=False, callback=_print_all,
            help=f"Show all options ({count} more) and exit.")


def _print_all(ctx: click.Context, _parameter: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        ctx.meta[HELP_ALL] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()


class PathType(click.Path):
    """A path that is not a pipe, socket or device, and not longer than the system allows."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(path_type=Path, **settings)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> Any:
        """Returns the path; FormatError if it is one of those, ConfigError for an address."""
        refuse_special(Path(value), command=ctx.command_path if ctx else "")
        return super().convert(value, param, ctx)


class Option(click.Option):
    """An option of a verb; `expert` ones are in --help-all alone."""

    def __init__(self, *args: Any, expert: bool = False, **settings: Any) -> None:
        super().__init__(*args, **settings)
        self.expert = expert

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Returns name and text, `--[no-]x` for a pair of flags; None where it is left out."""
        record = super().get_help_record(ctx)
        if record is None or (self.expert and HELP_ALL not in ctx.meta):
            return None
        name, text = record
        return (f"--[no-]{self.opts[0][2:]}" if self.secondary_opts else name), text

    def get_help_extra(self, ctx: click.Context) -> OptionHelpExtra:
        """Returns click's additions in brackets; the range of a number on the second page alone."""
        extra = super().get_help_extra(ctx)
        if HELP_ALL not in ctx.meta:
            extra.pop("range", None)
        return extra


def verb(name: str) -> Callable[[Command], Verb]:
    """Returns a decorator that makes a function the command `recon NAME`.

    Its docstring is the help, with the formats that are read in place of {formats}.
    """
    def decorate(function: Command) -> Verb:
        text = inspect.cleandoc(function.__doc__ or "")
        formats = ", ".join(row.ending for row in READABLE)
        return click.command(name, cls=Verb, help=text.replace("{formats}", formats))(function)

    return decorate


def explicit_settings(call: Call) -> Settings:
    """Returns the values of recon.toml, --config and --set; ConfigError if one cannot be used."""
    return read_explicit(call.workspace, call.config_file, call.assigned)


def _store(name: str) -> Callable[[click.Context, click.Parameter, Any], None]:
    """Returns a callback that stores an option under an attribute of `Call`."""
    def store(ctx: click.Context, _parameter: click.Parameter, value: Any) -> None:
        setattr(ctx.ensure_object(Call), name, value)

    return store


def _switch(flag: str, help: str, *short: str, expert: bool = False) -> Decorator:
    """Returns a decorator that adds a flag, stored under its own name in `Call`."""
    name = flag[2:].replace("-", "_")
    return click.option(
        *short, flag, name, cls=Option, expert=expert, is_flag=True, expose_value=False,
        callback=_store(name), help=f"{help}  [default: off]")


verbosity = _switch("--verbose", "Show details and tracebacks.", "-v")
again = _switch("--again", "Run anew, even if up to date.")
with_prune = click.option(
    "--prune/--no-prune", "with_prune", cls=Option, default=True,
    help="Also prune midway through training.  [default: on]")
from_import = _switch("--from-import", "Train the imported scene further.")
print_config = _switch("--print-config", "Print options as TOML and exit.", expert=True)


def _style_options(*, has_json: bool, expert: bool) -> list[Option]:
    """Returns the options by which every verb is told how to talk; eager, so that errors obey."""
    quiet = Option(
        ["-q", "--quiet"], is_flag=True, is_eager=True, expose_value=False,
        callback=_store("quiet"),
        help="No progress, no notices.  [default: off]")
    log_format = Option(
        ["--log-format"], type=click.Choice(LOG_FORMATS), default=LOG_FORMATS[0], is_eager=True,
        expose_value=False, callback=_store("log_format"), expert=expert,
        help="Log on stderr; auto: bars on a terminal, else lines with the time.  [default: auto]")
    as_object = Option(
        ["--json", "as_object"], is_flag=True, is_eager=True, expose_value=False,
        callback=_store("as_object"),
        help="Print one JSON object at the end.  [default: off]")
    return [quiet, log_format, *([] if has_json else [as_object])]


def complete(command: click.Command, *words: str) -> click.Command:
    """Gives a command the options that every verb has, and each option its variable.

    That is RECON_TRAIN_ITERATIONS for --iterations of `recon train`. `words` call the command.
    """
    typed = {name for option in command.params for name in option.opts}
    if "--quiet" in typed:
        return command
    command.params += _style_options(
        has_json="--json" in typed, expert=isinstance(command, Verb))
    for option in command.params:
        if isinstance(option, click.Option) and not option.envvar:
            flag = next(name for name in option.opts if name.startswith("--"))
            option.envvar = "_".join(["RECON", *words, flag[2:]]).upper().replace("-", "_")
    if isinstance(command, click.Group):
        for name, under in command.commands.items():
            complete(under, *words, name)
    return command


def used_variables(command: click.Command) -> list[str]:
    """Returns the environment variables that set an option of a command, besides -w."""
    return [option.envvar for option in command.params
            if isinstance(option.envvar, str) and option.name != "workspace"
            and os.environ.get(option.envvar)]


def _use_workspace(ctx: click.Context, _parameter: click.Parameter, value: Path) -> None:
    ctx.ensure_object(Call).workspace = value
    use_workspace(ctx.info_name or "", value)


def common(*, workspace: str = "workspace", envvar: str | None = "RECON_WORKSPACE") -> Decorator:
    """Returns a decorator that adds -w (default: `envvar`, then `workspace`), --config and -v."""
    return stack([
        click.option(
            "-w", "--workspace", type=PathType(file_okay=False), metavar="DIR",
            default=workspace, envvar=envvar, show_default=True, show_envvar=True,
            expose_value=False, is_eager=True, callback=_use_workspace,
            help="Folder of all results."),
        click.option(
            "--config", "config_file", type=PathType(dir_okay=False),
            expose_value=False, callback=_store("config_file"),
            help="TOML file with options.  [default: none]"),
        verbosity,
    ])


def assignments(example: str = "train.iterations=1000") -> Decorator:
    """Returns a decorator that adds --set, for the verbs that run many stages."""
    def store(ctx: click.Context, _parameter: click.Parameter, values: tuple[str, ...]) -> None:
        ctx.ensure_object(Call).assigned = merge(parse_assignment(text) for text in values)

    return click.option(
        "--set", "assigned", multiple=True, metavar="SECTION.FIELD=VALUE", expose_value=False,
        callback=store,
        help=f"Set an option of any stage, such as {example}; may be repeated.  [default: none]")


def stage(config: type[StageConfig], *, renders: bool = False) -> Decorator:
    """Returns a decorator that adds a stage's options; device and backend where it `renders`."""
    where = compute(trains=config in (TrainConfig, PruneConfig)) if renders else config_options(
        ComputeConfig, only=("threads",))
    return stack([config_options(config), where, again, print_config, common()])


def executor(jobs: str) -> Decorator:
    """Returns a decorator that adds where commands run, and how many `jobs` (a plural) at once."""
    return stack([
        click.option(
            "--on", "place", type=click.Choice(["local", "ray"]), default="local",
            help="Run in processes of this machine, or on the Ray cluster at RAY_ADDRESS.  "
                 "[default: local]"),
        click.option(
            "--jobs", type=click.IntRange(min=1), metavar="N",
            help=f"{jobs} at once.  [default: one for each {CORES} cores]")])


def compute(*, trains: bool = False, without: Sequence[str] = ()) -> Decorator:
    """Returns a decorator that adds where a verb computes, and the memory for one that trains."""
    return config_options(ComputeConfig, without=(*without, *(() if trains else ("max_memory",))))


def config_options(
    config: type[StageConfig], *, only: Sequence[str] = (), without: Sequence[str] = (),
    expert: Sequence[str] = (), lead: str = "",
) -> Decorator:
    """Returns a decorator that adds an option for each field of a config.

    `only` and `without` select fields by name, `expert` names those for experts in this verb beside
    those that always are, unless `only` names them; `lead` is put before each help.
    """
    decorators: list[Decorator] = []
    for item in dataclasses.fields(config):
        if item.name in without or (only and item.name not in only):
            continue
        info = option_info(item)
        decorators += [
            _flag(config, item.name, choice, text) for choice, text in info.flags.items()
        ] or [_field(
            config, item.name, f"{lead}{info.help}  [{describe_default(item)}]",
            expert=(info.expert and not only) or item.name in expert)]
    return stack(decorators)


def describe_default(item: dataclasses.Field[Any]) -> str:
    """Returns the unit and the default of a field as --help shows them."""
    info = option_info(item)
    if item.default is None:
        default = info.automatic
    elif isinstance(item.default, bool):
        default = "on" if item.default else "off"
    else:
        default = f"{item.default:g}" if isinstance(item.default, float) else str(item.default)
    return f"{info.unit}; default: {default}" if info.unit else f"default: {default}"


def _field(config: type[StageConfig], name: str, text: str, *, expert: bool) -> Decorator:
    """Returns the option that sets one field."""
    section = section_of(config)
    info = option_info(config.__dataclass_fields__[name])
    kind, _ = field_type(config, name)
    flag = name.replace("_", "-")

    def store(ctx: click.Context, _parameter: click.Parameter, value: Any) -> None:
        if value is None or (info.repeatable and not value):
            return
        if info.repeatable:
            value = ",".join(value)
        ctx.ensure_object(Call).settings.setdefault(section, {})[name] = (
            info.read(value) if info.read else value)

    return click.option(
        f"--{flag}/--no-{flag}" if kind is bool else f"--{flag}",
        f"{section}_{name}", cls=Option, expert=expert, type=_click_type(kind, info), default=None,
        multiple=info.repeatable, expose_value=False, callback=store, help=text,
        metavar=None if info.choices else info.metavar or _METAVARS.get(kind))


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


def _flag(config: type[StageConfig], name: str, choice: str, text: str) -> Decorator:
    """Returns the option `--<choice>`, which sets the field to that choice."""
    section = section_of(config)

    def store(ctx: click.Context, _parameter: click.Parameter, value: bool) -> None:
        if not value:
            return
        values = ctx.ensure_object(Call).settings.setdefault(section, {})
        if name in values:
            raise click.UsageError(f"--{values[name]} and --{choice} exclude each other.")
        values[name] = choice

    return click.option(
        f"--{choice}", f"{section}_{name}_{choice}", is_flag=True, expose_value=False,
        callback=store, help=f"{text}  [default: off]")


def stack(decorators: Sequence[Decorator]) -> Decorator:
    """Returns one decorator that applies all, so that --help lists them in this order."""
    def apply(function: Command) -> Command:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply
