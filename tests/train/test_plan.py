"""Decisions that the user left open: in closed form, on a model of known cost."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from facts import raises
from scenes import camera_at
from tiny_task import tiny_task

from recon_cli.config.stages import RunConfig, TrainConfig
from recon_cli.deadline import Deadline, OutOfTime
from recon_cli.errors import ConfigError
from recon_cli.scene.train_view import TrainView
from recon_cli.time_estimate import Cost, TimeEstimator
from recon_cli.train import plan
from recon_cli.train.cost import REPORT, SAVE, step_kind
from recon_cli.train.fit.train_data import read_config
from recon_cli.train.parts.decisions import NO_TIME, skip_trial
from recon_cli.train.parts.stereo import SurfacePoints
from recon_cli.train.parts.trials import Needs
from recon_cli.train.plan import QUALITIES, Facts, make_plan
from recon_cli.workspace.summaries import TrainPlan

FACTS = Facts(detail=60_000, views=40, points=9000, room=10**9)


def estimator(step, seconds=0.5):
    """The estimator of runs whose steps take the same at each level."""
    steps = dict.fromkeys(map(step_kind, (1, 2, 4)), step)
    return TimeEstimator({**steps, REPORT: Cost(), SAVE: Cost()}, seconds=seconds)


COST = estimator(Cost(0.01))  # ten milliseconds a step, whatever the count


def test_iterations_and_minutes_exclude_each_other():
    with raises(ConfigError, 100, 2, "iterations") as caught:
        TrainConfig(iterations=100, minutes=2)
    assert "--minutes" in caught.value.hint


@pytest.mark.parametrize("quality", ["draft", "normal", "high"])
def test_the_quality_sets_what_is_not_given(quality):
    made = make_plan(TrainConfig(quality=quality), FACTS, COST)
    assert made.iterations == QUALITIES[quality].iterations
    assert made.max_size == QUALITIES[quality].max_size
    given = make_plan(
        TrainConfig(quality=quality, iterations=7, max_size=99, max_gaussians=50), FACTS, COST)
    assert (given.iterations, given.max_size, given.max_gaussians) == (7, 99, 50)


def test_the_defaults_of_a_run_are_those_of_the_normal_quality():
    assert (RunConfig().iterations, RunConfig().max_size) == (
        QUALITIES["normal"].iterations, QUALITIES["normal"].max_size)


@pytest.mark.integration
@pytest.mark.parametrize("minutes", [0.1, 1.0, 10.0])
def test_minutes_are_filled_calibration_included(minutes):
    made = make_plan(TrainConfig(minutes=minutes), FACTS, COST)
    assert made.iterations == pytest.approx((60 * minutes - 0.5) / (0.01 * plan._LONGER), abs=2)
    assert made.seconds + COST.seconds <= 60 * minutes


class FakeClock:
    """A clock that parts of a training move on."""

    def __init__(self):
        self.now = 0.0

    def __call__(self):
        return self.now

    def photos(self, seconds, views=60):
        """Stands for a search in so many views, which takes so many seconds unless it is cut."""
        class Search:
            points = np.zeros((9000, 3))

            def once(_, _search, deadline=None):  # noqa: N805
                pace = (deadline or Deadline()).keep_pace(views)
                for done in range(1, views + 1):
                    self.now += seconds / views
                    pace(done)
                return SurfacePoints.nothing()

        return Search()


def planned(tmp_path, monkeypatch, *, minutes, trials=0.0, surfaces=0.0, loading=0.0, detail=60_000,
            **options):
    """The plan, notices and seconds before the first step of a run whose parts take so long."""
    clock, notices = FakeClock(), []
    task = tiny_task(RunConfig(stereo="on"))
    task = replace(task, train=20 * task.train, evidence=clock.photos(surfaces))
    scene = SimpleNamespace(
        train=(), validation=(), points=np.zeros((9000, 3)), colors=np.zeros((9000, 3), np.uint8))

    def load(*_):
        clock.now += loading
        return task

    def choose(*_, deadline, **__):
        decisions = []
        for name in ("exposure", "vignette"):
            try:
                deadline.refuse_late(trials / 2)
                clock.now += trials / 2
            except OutOfTime:
                decisions.append(skip_trial(name, NO_TIME))
        return Needs(RunConfig(stereo="on", exposure="off", vignette="off"), tuple(decisions))

    def measure(*_):
        clock.now += COST.seconds
        return COST

    for name, value in {
            "gaussians_that_fit": lambda *_: 10**9, "load_task": load, "choose_parts": choose,
            "count_detail": lambda _: detail, "_measure_cost": measure,
            "Deadline": partial(Deadline, clock=clock)}.items():
        monkeypatch.setattr(plan, name, value)
    ctx = SimpleNamespace(notice=notices.append)
    plan.plan_task(TrainConfig(minutes=minutes, **options), scene, tmp_path, ctx)
    return TrainPlan.read(tmp_path), notices, clock.now


@pytest.mark.integration
def test_minutes_include_a_search_for_surfaces_that_only_the_longer_run_has_room_for(
        tmp_path, monkeypatch):
    likely = plan.probe_config(TrainConfig(minutes=5.0), Facts(16_000, 80, 9000, 10**9))
    assert likely.max_gaussians // 2 < 9000  # all of it sparse points
    made, notices, before = planned(
        tmp_path, monkeypatch, minutes=5.0, surfaces=20.0, detail=16_000)
    assert before == pytest.approx(20 + COST.seconds)
    assert 270 < made.seconds <= 300 - before
    assert notices == []


@pytest.mark.parametrize("slow", [
    {"trials": 63.0}, {"surfaces": 23.0}, {"trials": 63.0, "surfaces": 23.0, "loading": 2.0},
    {"trials": 400.0, "surfaces": 400.0}])
def test_trials_and_surfaces_take_a_fifth_of_the_minutes_and_steps_at_least_half(
        tmp_path, monkeypatch, slow):
    made, notices, before = planned(tmp_path, monkeypatch, minutes=1.0, **slow)
    one_photo = slow.get("surfaces", 0.0) / 60  # before which it is not cut
    assert before - slow.get("loading", 0.0) <= 0.2 * 60 + COST.seconds + one_photo
    assert made.seconds >= 0.5 * 60
    assert before + made.seconds == pytest.approx(60, rel=0.02)
    said, = notices
    for part, cause in (("exposure", "trials"), ("vignette", "trials"), ("stereo", "surfaces")):
        assert (part in said) is (cause in slow)
    assert read_config(tmp_path).stereo == ("off" if "surfaces" in slow else "on")


@pytest.mark.integration
def test_the_part_that_is_asked_for_is_searched_whatever_it_takes(tmp_path, monkeypatch):
    made, notices, before = planned(
        tmp_path, monkeypatch, minutes=1.0, surfaces=23.0, stereo="on")
    assert before > 23
    assert read_config(tmp_path).stereo == "on"
    assert made.seconds >= 30
    assert notices == []


@pytest.mark.integration
def test_half_of_the_minutes_are_steps_even_where_loading_took_the_rest(tmp_path, monkeypatch):
    made, _, before = planned(tmp_path, monkeypatch, minutes=1.0, loading=50.0)
    assert before > 50
    assert made.seconds == pytest.approx(30, rel=0.02)


@pytest.mark.integration
@pytest.mark.parametrize(("minutes", "blurred"), [(0.05, True), (0.2, False)])
def test_steps_under_a_sixth_of_a_normal_run_are_said_before_the_first(
        tmp_path, monkeypatch, minutes, blurred):
    made, notices, _ = planned(tmp_path, monkeypatch, minutes=minutes)
    assert (made.iterations < 0.15 * QUALITIES["normal"].iterations) is blurred
    assert any("2,400" in text for text in notices) is blurred


def test_a_hundredth_of_a_minute_gives_the_smallest_run():
    made = make_plan(TrainConfig(minutes=0.01), FACTS, COST)
    assert made.iterations == 100
    assert made.max_gaussians >= 5000


@pytest.mark.integration
def test_no_time_makes_a_run_endless():
    assert make_plan(TrainConfig(minutes=1e6), FACTS, COST).iterations == 100_000


def test_the_same_numbers_given_make_the_same_config():
    asked = TrainConfig(minutes=0.3, seed=4)
    made = make_plan(asked, FACTS, COST)
    again = TrainConfig(iterations=made.iterations, max_gaussians=made.max_gaussians,
                        max_size=made.max_size, seed=4)
    assert plan.run_config(asked, made) == plan.run_config(
        again, make_plan(again, FACTS, COST))


def test_the_cap_grows_with_the_root_of_the_steps_and_with_the_detail():
    asked = TrainConfig()
    assert plan.cap(asked, FACTS, 2400) == 60_000
    assert plan.cap(asked, FACTS, 600) == 30_000
    assert plan.cap(asked, replace(FACTS, detail=30_000), 2400) == 30_000
    assert plan.cap(asked, replace(FACTS, views=2), 2400) == 15_000
    assert plan.cap(asked, replace(FACTS, detail=0), 2400) == 5000
    assert plan.cap(TrainConfig(max_gaussians=77), FACTS, 6000) == 77


def test_memory_lowers_the_cap():
    made = make_plan(TrainConfig(), replace(FACTS, room=12_345), COST)
    assert made.max_gaussians == 12_345
    assert make_plan(TrainConfig(), replace(FACTS, room=0), COST).max_gaussians == 4


def test_a_count_that_grows_begins_with_half_of_its_cap_and_never_with_more_than_points():
    config = RunConfig(max_gaussians=80_000)
    assert plan.first_count(config, 100_000) == 40_000
    assert plan.first_count(config, 9000) == 9000
    assert plan.first_count(replace(config, max_gaussians=50), 100_000) == 50
    assert plan.first_count(replace(config, densify="reference"), 100_000) == 80_000


def view(image, mask=None):
    height, width = image.shape[:2]
    return TrainView(camera_at(width, height, focal=30.0), image, mask)


def test_detail_counts_the_pixels_at_edges():
    flat = np.full((20, 30, 3), 90, np.uint8)
    edge = flat.copy()
    edge[:, 15:] = 190
    assert plan.count_detail([view(flat)]) == 0
    assert plan.count_detail([view(edge)]) == 2 * 20  # a column on either side
    assert plan.count_detail([view(flat), view(edge)]) == 20
    hidden = np.ones((20, 30), bool)
    hidden[:10] = False
    assert plan.count_detail([view(edge, hidden)]) == 20


def test_two_faces_of_panoramas_count_as_one_view():
    task = SimpleNamespace(train=[None] * 12)
    facts = [plan.gather_facts(task, SimpleNamespace(
        train=[SimpleNamespace(face_of=face)] * 12, points=np.zeros((7, 3))), 10**9, detail=40)
        for face in (None, "a.png")]
    assert facts == [Facts(40, 12, 7, 10**9), Facts(80, 6, 7, 10**9)]


def test_faint_noise_is_no_detail():
    noise = np.random.default_rng(0).normal(100, 2, (40, 60, 1)).repeat(3, 2)
    assert plan.count_detail([view(noise.round().astype(np.uint8))]) < 0.01 * 2400


def test_only_memory_limits_the_count_of_the_protocol_3dgs_and_its_time_is_told_by_a_likely_one():
    facts = replace(FACTS, room=4_000_000)
    linear = estimator(Cost(each=0.001))
    free = make_plan(TrainConfig(protocol="3dgs").settle(), facts, linear)
    assert (free.iterations, free.max_gaussians) == (30_000, 2_000_000)
    assert free.first_gaussians == facts.points  # all of them, as in the reference
    ours = make_plan(TrainConfig(protocol="recon").settle(), facts, linear)
    assert ours.max_gaussians < 250_000
    assert free.seconds < 2 * ours.seconds
    limited = make_plan(TrainConfig(protocol="3dgs", max_gaussians=50_000).settle(), facts, linear)
    assert limited.max_gaussians == 50_000
