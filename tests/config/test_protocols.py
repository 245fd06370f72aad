"""What a protocol fixes, what it leaves open, and what it says to options that contradict it."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
from facts import raises

from recon_cli.config import settings as layers
from recon_cli.config.fields import OptionInfo, option_info
from recon_cli.config.protocols import FREE, PROTOCOLS
from recon_cli.config.stages import RunConfig, TrainConfig
from recon_cli.errors import ConfigError


def test_3dgs_is_the_published_recipe_on_all_views_that_are_not_held_out() -> None:
    config = TrainConfig(protocol="3dgs").settle()
    assert (config.iterations, config.sh_degree, config.validation) == (30_000, 3, 0.0)
    assert (config.ssim_weight, config.means_rate, config.opacities_rate) == (0.2, 1.6e-4, 0.05)
    assert (config.densify_every, config.densify_gradient, config.min_opacity) == (
        100, 2e-4, 0.005)
    run = RunConfig(**{item.name: getattr(config, item.name) for item in dataclasses.fields(config)
                       if getattr(config, item.name) is not None})
    assert run.is_reference
    assert config.max_radius == 0
    assert not config.early_stop
    assert config.blocks == "off"


def test_recon_is_the_default_recipe_on_the_same_views() -> None:
    config, plain = TrainConfig(protocol="recon").settle(), TrainConfig()
    changed = {item.name for item in dataclasses.fields(config)
               if getattr(config, item.name) != getattr(plain, item.name)}
    assert changed == {"protocol", "iterations", "validation", "early_stop", "blocks"}
    shared = ("iterations", "validation")
    assert [getattr(config, name) for name in shared] == [
        getattr(TrainConfig(protocol="3dgs").settle(), name) for name in shared]


@pytest.mark.parametrize("name", PROTOCOLS)
def test_what_a_table_names_may_be_chosen(name: str) -> None:
    config = TrainConfig(
        protocol=name, iterations=7000, max_size=800, max_gaussians=9, seed=3, jobs=2).settle()
    assert (config.iterations, config.max_size, config.max_gaussians) == (7000, 800, 9)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_every_other_option_is_refused_at_another_value(name: str) -> None:
    for item in dataclasses.fields(TrainConfig):
        info = option_info(item)
        fixed = PROTOCOLS[name].options.get(item.name, item.default)
        value = _another(info, fixed, item.default)
        if item.name in FREE | {"blocks"} or not info.hashed or value == item.default:
            continue  # what is not given looks as the default does; see the next test
        given: dict[str, Any] = {item.name: value}
        with raises(ConfigError, item.name, name, "protocol") as caught:
            TrainConfig(protocol=name, **given).settle()
        assert f"--{item.name.replace('_', '-')}" in (caught.value.hint or "")


def _another(info: OptionInfo, fixed: Any, default: Any) -> Any:
    """Returns a value that an option may have and a protocol does not fix."""
    if isinstance(fixed, str) and not info.choices:
        return default
    if info.choices:
        return next((c for c in info.choices if c not in (fixed, default)), default)
    if isinstance(fixed, bool):
        return not fixed
    if isinstance(fixed, float):
        return fixed + 0.01
    return 2 if fixed is None or fixed == 3 else fixed + 1


@pytest.mark.parametrize("given", [{"validation": 0.05}, {"early_stop": True}, {"blocks": "auto"}])
def test_a_default_that_is_given_is_refused_too(given: dict[str, object]) -> None:
    with raises(ConfigError, next(iter(given)), "protocol"):
        layers.build(TrainConfig, {"train": {"protocol": "recon", **given}})


def test_the_options_of_a_protocol_can_be_given_again() -> None:
    config = TrainConfig(protocol="3dgs", seed=2).settle()
    values = {item.name: getattr(config, item.name) for item in dataclasses.fields(config)}
    assert layers.build(TrainConfig, {"train": values}) == config


def test_trials_may_fill_in_what_a_followed_protocol_leaves_automatic() -> None:
    settled = TrainConfig(protocol="recon").settle()
    assert dataclasses.replace(settled, sh_degree=1, background="on").validation == 0.0


def test_the_config_itself_says_only_what_was_asked_for() -> None:
    asked = TrainConfig(protocol="3dgs")
    assert (asked.iterations, asked.validation) == (None, TrainConfig.validation)
    assert asked.settle().settle() == asked.settle()


def test_without_a_protocol_the_fingerprint_is_the_one_of_before() -> None:
    assert "protocol" not in TrainConfig().hashed_fields()
    assert TrainConfig(protocol="recon").settle().hashed_fields()["protocol"] == "recon"
