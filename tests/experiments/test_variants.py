"""Recipes of training: what a word on the command line stands for."""

from __future__ import annotations

import pytest

from recon_cli.config.stages import RunConfig
from recon_cli.errors import ConfigError
from recon_cli.experiments.variants import PAPER, parse_recipe, parse_recipes

BASE = RunConfig(iterations=1, max_size=48, max_gaussians=90, densify_every=10, validation=0.2)


def test_a_recipe_may_change_options_of_training() -> None:
    arm = parse_recipe("budget+sh_degree=1+ssim_weight=0.5")
    config = arm.config(BASE, iterations=7, seed=3)
    assert (config.densify, config.sh_degree, config.ssim_weight) == ("budget", 1, 0.5)
    assert (config.iterations, config.seed, config.max_size) == (7, 3, 48)
    assert parse_recipe("paper") is not PAPER
    assert parse_recipe("paper").prune == PAPER.prune
    assert [one.name for one in parse_recipes(("reference, budget", "paper"))] == [
        "reference", "budget", "paper"]


@pytest.mark.parametrize("text", [
    "none", "budget+nothing=1", "budget+sh_degree", "budget+sh_degree=9", "budget+iterations=5",
    "budget,budget", ","])
def test_a_recipe_that_means_nothing_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_recipes((text,))
