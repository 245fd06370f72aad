"""The views that a protocol needs: which are held out, and how large they are."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from facts import raises

from recon_cli.config.stages import TrainConfig
from recon_cli.errors import ConfigError
from recon_cli.stages.train import fit_protocol, image_size
from recon_cli.workspace.records import Frame, choose_held_out

NAMES = [f"photo_{number:03d}.png" for number in range(20)]


def frames(held_out: frozenset[str]) -> list[Frame]:
    return [Frame(name, None, name, None, name in held_out) for name in reversed(NAMES)]


def scene(*sizes: tuple[int, int]) -> Any:
    views = [SimpleNamespace(camera=SimpleNamespace(width=width, height=height))
             for width, height in sizes]
    return SimpleNamespace(train=views[1:], test=views[:1])


def test_every_eighth_view_by_name_is_the_split_that_ingest_makes_by_default() -> None:
    held_out = choose_held_out(NAMES, ("every", 8.0, 0.0))
    assert sorted(held_out) == [NAMES[0], NAMES[8], NAMES[16]]
    config = TrainConfig(protocol="3dgs")
    assert fit_protocol(config, scene((800, 533)), frames(held_out)).max_size == 800


@pytest.mark.parametrize("holdout", [
    ("every", 7.0, 0.0), ("segment", 0.0, 0.15), ("none", 0.0, 0.0)])
def test_another_split_is_refused(holdout: tuple[str, float, float]) -> None:
    split = frames(choose_held_out(NAMES, holdout))
    with raises(ConfigError, "8th") as caught:
        fit_protocol(TrainConfig(protocol="recon"), scene((8, 8)), split)
    assert "--holdout every:8" in (caught.value.hint or "")


def test_one_view_more_or_less_is_refused() -> None:
    right = choose_held_out(NAMES, ("every", 8.0, 0.0))
    for split in (right | {NAMES[1]}, right - {NAMES[8]}):
        with raises(ConfigError):
            fit_protocol(TrainConfig(protocol="3dgs"), scene((8, 8)), frames(split))


def test_without_a_protocol_any_split_will_do() -> None:
    config = TrainConfig()
    assert fit_protocol(config, scene((8, 8)), frames(frozenset())) is config


@pytest.mark.parametrize(("sizes", "longest"), [
    ([(800, 533)], 800), ([(1600, 1200)], 1600), ([(3200, 2400)], 1600),
    # wider than 1,600 is reduced to it, whatever the height
    ([(1500, 2000)], 2000), ([(3000, 4000)], 2133), ([(640, 480), (800, 600)], 800)])
def test_images_keep_their_size_up_to_a_width_of_1600(
    sizes: list[tuple[int, int]], longest: int
) -> None:
    assert image_size(scene(*sizes)) == longest


def test_a_size_that_is_asked_for_stays() -> None:
    held_out = frames(choose_held_out(NAMES, ("every", 8.0, 0.0)))
    config = fit_protocol(
        TrainConfig(protocol="recon", max_size=400), scene((800, 533)), held_out)
    assert config.max_size == 400
    assert replace(config, sh_degree=1).protocol == "recon"
