"""A board that is carried past a wall is found by short runs and masked where that pays."""

from dataclasses import replace

import numpy as np
import pytest
from facts import assert_facts
from wall_scene import CONFIG, scene

from recon_cli.train.masks import enlarge, hide
from recon_cli.train.parts.moving import have_evidence, is_plausible, share_of
from recon_cli.train.parts.trials import examine

PARTS = {
    "background": "off", "stereo": "off", "exposure": "off", "vignette": "off", "iterations": 1000}


def carried(views, *, size=(50, 26), every=1):
    """Returns views in some of which a red board is carried across, and where it is."""
    made, boards = [], []
    for row, view in enumerate(views):
        board = np.zeros((96, 128), bool)
        if 8 <= row < 17 and row % every == 0:
            left = 6 + 11 * (row - 8)
            board[20:20 + size[0], left:left + size[1]] = True
        image = view.image.copy()
        image[board] = 200, 20, 20
        made.append(replace(view, stored=image))
        boards.append(board)
    return made, boards


def with_views(made, views, **config):
    task = made.task
    schedule = replace(task.schedule, config=replace(task.schedule.config, **config))
    return replace(made, task=replace(task, train=views, schedule=schedule))


def decision(needs):
    return next(one for one in needs.decisions if one.name == "moving")


@pytest.mark.integration
def test_what_is_carried_past_is_masked_and_little_else():
    made = scene()
    views, boards = carried(made.task.train)
    needs = examine(with_views(made, views, **PARTS, moving="auto"))
    assert decision(needs).on, decision(needs).reason
    hidden = missed = spared = 0
    for region, board in zip(needs.masks, boards, strict=True):
        large = enlarge(region, 128, 96)
        hidden += int((large & board).sum())
        missed += int((board & ~large).sum())
        spared += int((large & ~board).sum())
    assert hidden > 0.95 * (hidden + missed)
    assert spared < 0.03 * 96 * 128 * len(views)


@pytest.mark.integration
def test_off_looks_for_nothing_and_on_skips_the_trial():
    made = scene()
    views, _ = carried(made.task.train)
    needs = examine(with_views(made, views, **PARTS, moving="off"))
    assert needs.masks is None
    assert needs.decisions == ()
    needs = examine(with_views(made, views, **PARTS, moving="on"))
    assert needs.masks is not None
    assert decision(needs).mean_db is None


@pytest.mark.integration
def test_a_clean_wall_gets_no_mask():
    needs = examine(scene(config=replace(CONFIG, **PARTS, moving="auto")))
    assert needs.masks is None
    assert_facts(decision(needs).reason, "0 of 26")


@pytest.mark.parametrize("config", [{"densify": "reference"}, {"iterations": 999}])
def test_the_reference_recipe_and_short_runs_do_not_look(config):
    made = scene()
    views, _ = carried(made.task.train)
    needs = examine(with_views(made, views, **{**PARTS, "moving": "auto", **config}))
    assert needs.masks is None
    assert "moving" not in [one.name for one in needs.decisions]


@pytest.mark.parametrize(("found", "of", "enough"), [
    (0, 60, False), (4, 60, False), (5, 60, True), (2, 20, False), (3, 20, True)])
def test_a_twelfth_of_the_views_must_show_what_moves_and_three_at_least(found, of, enough):
    assert have_evidence(np.arange(of) < found) == enough


@pytest.mark.integration
def test_a_board_in_two_views_is_no_sign():
    made = scene()
    views, boards = carried(made.task.train)
    views = [view if row in (10, 12) else old
             for row, (view, old) in enumerate(zip(views, made.task.train, strict=True))]
    assert boards[10].any()
    needs = examine(with_views(made, views, **PARTS, moving="auto"))
    assert needs.masks is None
    assert_facts(decision(needs).reason, "2 of 26")


def test_regions_hide_pixels_on_top_of_a_mask():
    view = scene(views=2).task.train[0]
    upper = np.ones((96, 128), bool)
    upper[:20] = False
    region = np.zeros((48, 64), bool)
    region[:, :32] = True
    hidden, = hide([replace(view, mask=upper)], [region])
    assert not hidden.mask[:20].any()
    assert not hidden.mask[:, :63].any()
    assert hidden.mask[20:, 65:].all()
    assert hide([view], [np.zeros((48, 64), bool)]) == [view]


def test_more_than_a_quarter_is_not_plausible():
    half = np.zeros((10, 10), bool)
    half[:5] = True
    assert share_of([half, half & False]) == 0.25
    assert is_plausible([half, half & False])
    assert not is_plausible([half, half])
