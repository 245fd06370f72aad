"""Parts of the model are on where a sign speaks for them and a trial does."""

from dataclasses import replace

import pytest
from facts import assert_facts
from wall_scene import CONFIG, scene

from recon_cli.deadline import Deadline
from recon_cli.train.parts import background
from recon_cli.train.parts.trials import Trials, examine

pytestmark = pytest.mark.integration


SHINY = replace(CONFIG, sh_degree=3)


def reasons(needs):
    return {decision.name: decision.reason for decision in needs.decisions}


def test_a_plain_scene_needs_nothing_and_pays_nothing():
    needs = examine(scene())
    assert needs.config.background == needs.config.exposure == "off"
    assert needs.config.vignette == "off"
    assert not any(one.seconds for one in needs.decisions)
    assert needs.masks is None
    assert_facts(reasons(needs)["background"], "cover")
    assert_facts(reasons(needs)["exposure"], "differs")


def test_a_view_through_a_window_is_modelled_far_outside():
    needs = examine(scene(window=True))
    decision = next(one for one in needs.decisions if one.name == "background")
    assert (decision.on, decision.seconds, needs.config.background) == (True, 0.0, "on")


def test_what_lies_behind_a_thing_must_gain_in_a_trial(monkeypatch):
    monkeypatch.setattr(background, "look_at_one_thing", lambda _: True)
    needs = examine(scene(window=True))
    decision = next(one for one in needs.decisions if one.name == "background")
    assert decision.mean_db > 0.3
    assert needs.config.background == "on"


def test_a_camera_that_sets_its_exposure_is_found_and_helped():
    needs = examine(scene(drift=0.15))
    decision = next(one for one in needs.decisions if one.name == "exposure")
    assert decision.on, decision.reason
    assert needs.config.exposure == "on"


def test_a_lens_with_dark_corners_is_found_and_helped():
    needs = examine(scene(vignette=(-0.5, -0.3)))
    decision = next(one for one in needs.decisions if one.name == "vignette")
    assert decision.on, decision.reason
    assert needs.config.vignette == "on"


def test_one_exposure_for_all_needs_no_trial_but_a_drift():
    config = replace(CONFIG, brightness="even", background="off", moving="off")
    even, plain = examine(scene(drift=0.15, config=config)), examine(scene(config=config))
    assert (even.config.exposure, plain.config.exposure) == ("on", "off")
    assert not any(one.seconds for one in even.decisions)
    assert_facts(reasons(even)["exposure"], "one")


def test_denoised_images_that_show_something_else_are_not_trained_on():
    made = scene(config=replace(CONFIG, images="auto", background="off", exposure="off"))
    twins = [replace(view, stored=view.image // 2) for view in made.task.train]
    needs = examine(replace(made, twins=lambda: twins))
    assert needs.config.images == "original"
    assert next(one for one in needs.decisions if one.name == "images").mean_db < -1
    assert examine(made).config.images == "original"
    assert "images" not in reasons(examine(made))


def test_surfaces_by_stereo_are_used_without_a_trial():
    needs = examine(scene())
    assert needs.config.stereo == "on"
    assert "stereo" not in reasons(needs)


def test_what_the_options_say_is_not_tried():
    config = replace(
        CONFIG, background="off", stereo="on", exposure="on", depth="off", moving="off",
        vignette="off")
    needs = examine(scene(window=True, config=config))
    assert needs.decisions == ()
    assert needs.config == config


def test_too_few_views_switch_nothing_on():
    needs = examine(scene(window=True, drift=0.15, views=6))
    assert needs.config.exposure == needs.config.background == "off"
    assert_facts(reasons(needs)["exposure"], "views")


@pytest.mark.parametrize(("psnr", "degree", "tried"), [
    ({0: 30, 1: 31, 3: 32}, 3, [1]),
    ({0: 30, 1: 31, 3: 31.04}, 1, [1, 0]),
    ({0: 30, 1: 30.04, 3: 30.08}, 0, [1, 0])])
def test_the_degree_is_the_lowest_that_the_next_does_not_beat(monkeypatch, psnr, degree, tried):
    monkeypatch.setattr(
        Trials, "_run", lambda _self, config: [float(psnr[config.sh_degree])] * 9)
    config = replace(SHINY, background="off", moving="off")
    needs = examine(replace(scene(config=config), harmonics=True))
    assert needs.config.sh_degree == degree
    assert [one.name for one in needs.decisions if one.mean_db is not None] == [
        f"harmonics above degree {low}" for low in tried]


def test_the_same_scene_gets_the_same_answer():
    first, second = (examine(scene(window=True)) for _ in range(2))
    assert first.config == second.config
    assert [one.mean_db for one in first.decisions] == [one.mean_db for one in second.decisions]


class Ticking:
    """A clock that goes on at each look, which every step of a limited trial takes."""

    def __init__(self, seconds):
        self.now, self.seconds = 0.0, seconds

    def __call__(self):
        self.now += self.seconds
        return self.now


def test_trials_that_would_end_late_are_cut_and_parts_are_as_without_evidence():
    clock = Ticking(0.05)
    deadline = Deadline(15.0, clock)  # of some 400 steps; a trial takes 800
    needs = examine(replace(
        scene(window=True, drift=0.15, config=SHINY), deadline=deadline, harmonics=True))
    assert {one.name for one in needs.untried} >= {"exposure", "harmonics above degree 1"}
    assert (needs.config.background, needs.config.exposure) == ("on", "off")
    assert needs.config.sh_degree == SHINY.sh_degree
    assert needs.masks is None
    assert clock.now < 15


def test_a_time_that_suffices_changes_no_decision():
    free, limited = (examine(replace(scene(window=True), deadline=deadline))
                     for deadline in (Deadline(), Deadline(1e6)))
    assert free.config == limited.config
    assert [one.mean_db for one in free.decisions] == [one.mean_db for one in limited.decisions]
    assert limited.untried == ()
