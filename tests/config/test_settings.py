"""Which layer wins, and what is said about a setting that does not exist."""

import re
from pathlib import Path

import pytest
from facts import assert_facts, raises

from recon_cli.config import settings as layers
from recon_cli.config.export import ExportConfig
from recon_cli.config.settings import SECTIONS
from recon_cli.config.stages import IngestConfig, PruneConfig, SfmConfig, TrainConfig
from recon_cli.errors import ConfigError


def test_a_later_layer_wins_field_by_field() -> None:
    merged = layers.merge([
        {"train": {"iterations": 1, "seed": 1}}, {"train": {"iterations": 2}}, {"prune": {}}])
    assert merged["train"] == {"iterations": 2, "seed": 1}
    config = layers.build(TrainConfig, merged)
    assert (config.iterations, config.seed, config.max_size) == (2, 1, TrainConfig().max_size)


def test_toml_round_trips_every_section(tmp_path: Path) -> None:
    configs = {name: config() for name, config in SECTIONS.items()}
    configs["train"] = TrainConfig(iterations=7, means_rate=1e-15, images="original")
    configs["prune"] = PruneConfig(recovery=5)
    configs["export"] = ExportConfig(scale_between=("frame \"1\".png", "1,2,3", 2.0))
    path = tmp_path / "recon.toml"
    path.write_text(layers.to_toml(configs))
    read = layers.read_settings(path)
    assert {name: layers.build(SECTIONS[name], read) for name in SECTIONS} == configs


@pytest.mark.parametrize(("text", "message", "hint"), [
    ("[trian]\niterations = 3", "section trian", "Did you mean train?"),
    ("[train]\niteration = 3", "train.iteration,", "Did you mean iterations?"),
    ("[train]\nxyz = 3", "train.xyz", "quality, minutes"),
    ("[train]\nposes = 'on'", "train.poses, which recon no longer has", "Delete the line poses ="),
    ("[train]\ntone = 'auto'", "train.tone, which recon no longer has", "Delete the line tone ="),
    ("train = 3", "it is a section", "[train]"),
    ("[train]\ndensify = 'swarm'", "train.densify is 'swarm'", "--densify"),
    ("[prune]\nratio = 2", "prune.ratio is 2.0", "--ratio"),
    ("[train\n", "not valid TOML", "Fix"),
])
def test_a_mistake_in_a_file_names_the_file_and_what_was_meant(
    tmp_path: Path, text: str, message: str, hint: str
) -> None:
    path = tmp_path / "recon.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        layers.read_settings(path)
    assert str(path) in caught.value.message
    assert message in caught.value.message
    assert hint in caught.value.hint
    assert caught.value.exit_code == 2


def test_a_missing_file_is_a_usage_error(tmp_path: Path) -> None:
    with raises(ConfigError):
        layers.read_settings(tmp_path / "none.toml")


@pytest.mark.parametrize(("text", "expected"), [
    ("train.iterations=12", {"train": {"iterations": 12}}),
    ("train.validation = 0.25", {"train": {"validation": 0.25}}),
    ("sfm.max_minutes=3", {"sfm": {"max_minutes": 3.0}}),
    ("ingest.holdout=segment:0.4:0.6", {"ingest": {"holdout": "segment:0.4:0.6"}}),
    ("ingest.frames=automatic", {"ingest": {"frames": None}}),
    ("sfm.scale_between='IMG 7.jpg' 1,2,3 2", {
        "sfm": {"scale_between": ("IMG 7.jpg", "1,2,3", 2.0)}}),
])
def test_an_assignment_is_typed_as_its_field_is(text: str, expected: object) -> None:
    assert layers.parse_assignment(text) == expected


@pytest.mark.parametrize(("text", "said"), [
    ("train.iterations", "section.field=value"),
    ("iterations=3", "section.field=value"),
    ("train.iterations=many", "type int"),
    ("train.seed=automatic", "type int"),
    ("sfm.scale_between=a.png 2", "3 values (str, str, float)"),
    ("sfm.scale_between=a.png b.png far", "3 values (str, str, float)"),
    ("sfm.scale_between=a.png 'b.png 2", "3 values (str, str, float)"),
    ("train.iteratons=3", "Did you mean iterations?"),
    ("trains.iterations=3", "Did you mean train?"),
    ("train.densify=swarm", "--set train.densify is 'swarm'"),
])
def test_a_wrong_assignment_says_what_was_needed(text: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        layers.parse_assignment(text)
    assert said in caught.value.message + caught.value.hint


def test_every_section_is_checked_not_only_the_one_that_is_used() -> None:
    layers.check({"ingest": {"max_size": 100}})
    with raises(ConfigError, "ratio", 2.0, 1):
        layers.check({"prune": {"ratio": 2.0}})
    with raises(ConfigError, "type"):
        layers.check({"train": {"iterations": "many"}})


@pytest.mark.parametrize(("value", "fact"), [
    (["a.png", "b.png"], 3),
    ("a.png b.png 2", 3),
    (["a.png", "b.png", "2"], 3),
    (["a.png", "b.png", True], 3),
    (["a.png", "b.png", float("nan")], 3),
    (["a.png", 3, 2.0], 3),
    (["a.png", "a.png", 2.0], "places"),
    (["a.png", " ", 2.0], "places"),
    (["a.png", "b.png", 0], 0),
    (["a.png", "b.png", -1.0], 0),
])
@pytest.mark.parametrize("config", [SfmConfig, ExportConfig])
def test_a_measurement_that_measures_nothing_is_refused(
    config: type[SfmConfig | ExportConfig], value: object, fact: object
) -> None:
    with raises(ConfigError, "scale_between", fact):
        config(scale_between=value)  # type: ignore[arg-type]


def test_a_whole_number_that_no_library_holds_is_refused() -> None:
    for value in (2**31, -(2**31), 10**26):
        with raises(ConfigError, "seed") as raised:
            SfmConfig(seed=value)
        assert len(raised.value.message) < 200
    assert SfmConfig(seed=2**31 - 1).seed == 2**31 - 1


def test_build_ignores_other_sections() -> None:
    assert layers.build(IngestConfig, {"train": {"iterations": 3}}) == IngestConfig()


@pytest.mark.parametrize("options", [
    {"segments": "many"}, {"segments": "0"}, {"segments": "3", "pairs": "exhaustive"}])
def test_segments_that_cannot_be_are_refused(options: dict[str, str]) -> None:
    with raises(ConfigError, *options, *options.values()):
        SfmConfig(**options)  # type: ignore[arg-type]


@pytest.mark.parametrize(("text", "left"), [
    ('[train]\nposes = "off"\niterations = 60\n', {"train": {"iterations": 60}}),
    ("[train]\ndensify_scale = 0.01\n", {"train": {}}),
    ("[train]\ntone = 'off'\nblur = 'auto'\n", {"train": {}}),
    ("[merge]\nvalidation = 0.05\n", {})])
def test_options_that_are_gone_may_ask_for_what_is_done_anyway(text, left, tmp_path):
    path = tmp_path / "recon.toml"
    path.write_text(text, encoding="utf-8")
    assert layers.read_settings(path) == left


@pytest.mark.parametrize("text", [
    '[train]\nposes = "on"\n', "[merge]\nvalidation = 0.2\n", '[train]\nblur = "on"\n',
    "[train]\nshutter = 0.02\n"])
def test_options_that_are_gone_are_refused_where_they_ask_for_more(text, tmp_path):
    path = tmp_path / "recon.toml"
    path.write_text(text, encoding="utf-8")
    section, key = re.findall(r"\w+", text)[:2]
    with raises(ConfigError, "merge" if section == "merge" else f"{section}.{key}"):
        layers.read_settings(path)


def test_options_are_read_by_the_names_that_an_earlier_version_wrote(tmp_path):
    path = tmp_path / "recon.toml"
    path.write_text('[train]\nfar = "off"\nlook = "walk"\n', encoding="utf-8")
    assert layers.read_settings(path) == {"train": {"background": "off", "brightness": "filmed"}}
    path.write_text('[train]\nlook = "even"\n', encoding="utf-8")
    assert layers.read_settings(path) == {"train": {"brightness": "even"}}
    with pytest.raises(ConfigError) as caught:
        layers.parse_assignment("train.far=on")
    assert_facts(caught.value.hint, "--background")


def test_an_option_that_is_gone_is_no_assignment():
    with raises(ConfigError, "--set", "train.blur"):
        layers.parse_assignment("train.blur=on")
