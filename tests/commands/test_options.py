"""Every option explains itself, and reaches the settings with its type."""

import dataclasses
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from facts import raises

from recon_cli.cli import cli
from recon_cli.commands import options
from recon_cli.commands.options import Call
from recon_cli.config.export import ExportConfig
from recon_cli.config.fields import StageConfig, option, option_info
from recon_cli.config.settings import SECTIONS, section_of
from recon_cli.config.stages import (
    ComputeConfig,
    DenoiseConfig,
    PruneConfig,
    SfmConfig,
    TrainConfig,
)
from recon_cli.errors import ConfigError

EVERY_OPTION = [
    pytest.param(parameter, id=f"{verb} {parameter.opts[0]}")
    for verb, command in cli.commands.items()
    for parameter in command.params if isinstance(parameter, click.Option)
]
EVERY_FIELD = [
    pytest.param(config, item, id=f"{section}.{item.name}")
    for section, config in SECTIONS.items() for item in dataclasses.fields(config)
]


def parsed(config: type[StageConfig], *words: str) -> dict[str, object]:
    """Returns what a command with the options of `config` collects."""
    @click.command()
    @options.config_options(config)
    def command() -> None:
        """Does nothing."""

    call = Call()
    command.main(list(words), obj=call, standalone_mode=False)
    return call.settings.get(section_of(config), {})


@pytest.mark.parametrize("parameter", EVERY_OPTION)
def test_every_option_has_help_and_shows_its_default(parameter: click.Option) -> None:
    ctx = click.Context(click.Command("any"))
    ctx.meta[options.HELP_ALL] = True
    record = parameter.get_help_record(ctx)
    assert record
    assert ("required" if parameter.required else "default: ") in record[1]
    assert parameter.help
    assert not parameter.help.startswith("[")


@pytest.mark.parametrize(("config", "item"), EVERY_FIELD)
def test_every_field_says_what_it_is_and_what_happens_without_it(
    config: type[StageConfig], item: "dataclasses.Field[object]"
) -> None:
    info = option_info(item)
    assert info.help.endswith(".")
    if item.default is None:
        assert info.automatic in options.describe_default(item)
        assert info.automatic
    if info.unit:
        assert info.unit in options.describe_default(item)
    assert config().hashed_fields().keys() <= {one.name for one in dataclasses.fields(config)}


@pytest.mark.parametrize("verb", ["ingest", "denoise", "sfm", "train", "prune", "eval", "export"])
def test_every_verb_of_a_stage_has_the_common_options(verb: str) -> None:
    names = {name for parameter in cli.commands[verb].params for name in parameter.opts}
    assert {"-w", "--config", "-v", "--again", "--print-config"} <= names


def test_only_what_was_typed_reaches_the_settings() -> None:
    assert parsed(TrainConfig) == {}
    assert parsed(TrainConfig, "--iterations", "5", "--validation", "0") == {
        "iterations": 5, "validation": 0.0}
    assert parsed(PruneConfig, "--recovery", "5", "--score", "loo") == {
        "recovery": 5, "score": "loo"}
    assert parsed(ComputeConfig, "--threads", "2") == {"threads": 2}


@pytest.mark.parametrize("words", [
    ("--iterations", "0"), ("--iterations", "1.5"), ("--validation", "0.7"),
    ("--images", "some"), ("--iteration", "5", "--nonsense"),
])
def test_a_value_out_of_type_range_or_choice_is_a_usage_error(words: tuple[str, ...]) -> None:
    with pytest.raises(click.UsageError):
        parsed(TrainConfig, *words)


def test_a_field_with_flags_gets_one_flag_for_each_other_choice() -> None:
    assert parsed(DenoiseConfig, "--force") == {"mode": "force"}
    assert parsed(DenoiseConfig, "--off") == {"mode": "off"}
    with raises(click.UsageError, "--off", "--force"):
        parsed(DenoiseConfig, "--off", "--force")
    with pytest.raises(click.UsageError):
        parsed(DenoiseConfig, "--auto")


def test_a_truth_value_gets_a_pair_of_flags(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclasses.dataclass(frozen=True)
    class Switched(StageConfig):
        """Has a switch."""

        fine: bool = option(True, "Whether it is fine.")

    monkeypatch.setitem(SECTIONS, "switched", Switched)
    assert parsed(Switched) == {}
    assert parsed(Switched, "--no-fine") == {"fine": False}
    assert parsed(Switched, "--fine") == {"fine": True}


def test_a_field_of_several_values_is_one_option() -> None:
    assert parsed(ExportConfig, "--scale-between", "a.png:1,2", "-1,2,-3", "2.5") == {
        "scale_between": ("a.png:1,2", "-1,2,-3", 2.5)}
    with pytest.raises(click.UsageError):
        parsed(ExportConfig, "--scale-between", "a.png", "b.png", "far")
    with pytest.raises(click.UsageError):
        parsed(ExportConfig, "--scale-between", "a.png", "b.png")


def test_a_matrix_is_read_from_its_file_when_it_is_typed(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("[[2, 0, 0, 0.5], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]")
    numbers = [2, 0, 0, 0.5, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]
    assert parsed(ExportConfig, "--transform", str(path)) == {"transform": numbers}
    assert ExportConfig(transform=numbers).hashed_fields()["transform"] == numbers


@pytest.mark.parametrize(("words", "formats"), [
    (["html,spz"], ("html", "spz")), (["html", "spz"], ("html", "spz")),
    (["html,spz", "glb", "spz"], ("html", "spz", "glb")), (["spz", "spz"], ("spz",))])
def test_a_repeated_format_adds_to_the_others(
        words: list[str], formats: tuple[str, ...]) -> None:
    typed = [part for word in words for part in ("--format", word)]
    config = ExportConfig(**parsed(ExportConfig, *typed))  # type: ignore[arg-type]
    assert config.formats == formats


def test_a_format_that_is_not_typed_leaves_the_setting_alone(tmp_path: Path) -> None:
    assert parsed(ExportConfig) == {}
    (tmp_path / "recon.toml").write_text('[export]\nformat = "spz,glb"\n')
    words = ["export", "-w", str(tmp_path), "--print-config"]
    runner = CliRunner()
    assert 'format = "spz,glb"' in runner.invoke(cli, words).output
    assert 'format = "html,sog"' in runner.invoke(
        cli, [*words, "--format", "html", "--format", "sog"]).output


def test_an_empty_format_is_refused() -> None:
    with raises(ConfigError, "compressed.ply"):
        ExportConfig(**parsed(ExportConfig, "--format", "spz", "--format", ""))  # type: ignore[arg-type]


def test_an_axis_may_begin_with_a_dash() -> None:
    assert parsed(ExportConfig, "--up", "-y") == {"up": "-y"}


def test_some_fields_can_be_left_out() -> None:
    @click.command()
    @options.config_options(PruneConfig, without=("at",), lead="With --prune: ")
    def command() -> None:
        """Does nothing."""

    names = [parameter.opts[0] for parameter in command.params]
    assert "--at" not in names
    assert "--ratio" in names
    assert all(one.help.startswith("With --prune: ") for one in command.params)


def test_the_camera_model_leaves_results_from_before_fresh() -> None:
    assert "camera" not in SfmConfig().hashed_fields()
    assert SfmConfig(camera_model="RADIAL").hashed_fields()["camera_model"] == "RADIAL"
