"""The reference's plan, at its own length and scaled down."""

import pytest
from facts import raises

from recon_cli.config.stages import RunConfig, TrainConfig
from recon_cli.errors import ConfigError
from recon_cli.train.fit.schedule import ContinuedSchedule, Schedule, next_iteration


def test_a_run_of_30000_follows_the_reference():
    plan = Schedule(RunConfig(densify="reference", iterations=30_000))
    assert [i for i in range(1, 30_001) if plan.resets(i)] == [3000, 6000, 9000, 12000]
    densified = [i for i in range(1, 30_001) if plan.densifies(i)]
    assert (densified[0], densified[-1], len(densified)) == (500, 14_900, 145)
    assert [plan.sh_degree(i) for i in (1, 1000, 1001, 2001, 3001, 30_000)] == [0, 0, 1, 2, 3, 3]
    assert plan.means_rate(0) == pytest.approx(1.6e-4)
    assert plan.means_rate(30_000) == pytest.approx(1.6e-6)
    assert not plan.deletes_large(3000)
    assert plan.deletes_large(3001)


def test_a_short_run_reaches_the_full_degree_and_still_recovers_from_its_last_reset():
    plan = Schedule(RunConfig(densify="reference", iterations=3000))
    assert plan.sh_degree(3000) == 3
    assert [i for i in range(1, 3001) if plan.resets(i)] == [1000]
    shorter = Schedule(RunConfig(densify="reference", iterations=1500))
    assert not any(shorter.resets(i) for i in range(1, 1501))


def test_the_degree_is_capped_by_the_option():
    plan = Schedule(RunConfig(densify="reference", iterations=100, sh_degree=1))
    assert plan.sh_degree(100) == 1


def test_fewer_steps_of_the_protocol_are_the_first_of_its_30000():
    whole = Schedule(RunConfig(densify="reference", protocol="3dgs", iterations=30_000))
    assert whole == Schedule(whole.config)
    plain = Schedule(RunConfig(densify="reference", iterations=30_000))
    part = Schedule(RunConfig(densify="reference", protocol="3dgs", iterations=7000))
    for at in (1, 500, 3000, 3001, 6999, 7000):
        for name in ("resets", "densifies", "gathers", "sh_degree", "means_rate", "level",
                     "deletes_large", "rate_factor"):
            assert getattr(part, name)(at) == getattr(plain, name)(at), (name, at)
    assert part.mid == 7000
    assert whole.mid == plain.mid == 18_000


def test_a_run_of_one_step_has_a_plan():
    plan = Schedule(RunConfig(densify="reference", iterations=1))
    assert plan.mid == 1
    assert plan.sh_degree(1) == 0


def test_a_middle_before_the_end_of_densification_is_refused():
    with raises(ConfigError, "densification"):
        TrainConfig(mid=0.3)


def test_a_budget_starts_small_and_coarse_and_ends_calm():
    plan = Schedule(RunConfig(iterations=1000, max_gaussians=5000))
    factors = [plan.level(i) for i in range(1, 1001)]
    assert sorted(set(factors), reverse=True) == [2, 1]
    assert factors == sorted(factors, reverse=True)
    counts = [plan.target(i, 1000) for i in range(1, 1001)]
    assert counts == sorted(counts)
    assert (counts[0], counts[599], counts[-1]) == (1000, 5000, 5000)
    assert plan.rate_factor(700) == 1
    assert plan.rate_factor(1000) == pytest.approx(0.1)
    assert [plan.sh_degree(i) for i in (1, 151, 301, 451, 1000)] == [0, 1, 2, 3, 3]
    assert not any(plan.resets(i) or plan.deletes_large(i) for i in range(1, 1001))


def test_rates_do_not_fall_where_the_fall_would_be_too_short_to_settle_anything():
    assert Schedule(RunConfig(iterations=240)).rate_factor(240) == 1
    assert Schedule(RunConfig(iterations=260)).rate_factor(260) == pytest.approx(0.1)


@pytest.mark.parametrize("iterations", [1, 7, 35, 55, 1000, 2999])
def test_nothing_is_added_after_the_state_that_pruning_branches_off(iterations):
    plan = Schedule(RunConfig(iterations=iterations, densify_every=1))
    added = [i for i in range(1, iterations + 1) if plan.densifies(i)]
    assert max(added, default=0) <= plan.mid


def test_the_target_never_falls_below_what_the_run_began_with():
    plan = Schedule(RunConfig(iterations=1000, max_gaussians=5000))
    assert plan.target(900, 5000) == 5000


def test_a_run_that_goes_on_is_one_of_its_own_in_full_size_and_degree():
    config = RunConfig(iterations=3000, max_gaussians=5000)
    plan, alone = ContinuedSchedule(config, first=2000), Schedule(RunConfig(iterations=1000))
    for i in range(1, 1001):
        assert plan.means_rate(2000 + i) == 0.7 * alone.means_rate(i)  # nothing is far off
        assert plan.rate_factor(2000 + i) == alone.rate_factor(i)
        assert plan.densifies(2000 + i) == alone.densifies(i)
        assert (plan.level(2000 + i), plan.sh_degree(2000 + i)) == (1, 3)
    assert plan.mid == 2000 + alone.mid
    counts = [plan.target(i, 4000) for i in range(2001, 3001)]
    assert counts == sorted(counts)
    assert (counts[0], counts[599]) == (4000, 5000)


@pytest.mark.parametrize("steps", [1, 7, 90, 1000])
def test_nothing_is_added_after_the_middle_of_a_run_that_goes_on(steps):
    plan = ContinuedSchedule(RunConfig(iterations=2000 + steps, densify_every=1), first=2000)
    added = [i for i in range(2001, 2001 + steps) if plan.densifies(i)]
    assert max(added, default=0) <= plan.mid <= 2000 + steps


def test_a_run_that_goes_on_stops_early_by_shares_of_its_own_steps():
    plan = ContinuedSchedule(RunConfig(iterations=3000), first=2000)
    looks = [(2000 + 50 * (i + 1), 20.0) for i in range(20)]
    jumps = [next_iteration(plan, at, looks[:i + 1]) for i, (at, _) in enumerate(looks)]
    assert [at for (at, _), to in zip(looks, jumps, strict=True) if to == 2800] == [
        2650, 2700, 2750]
    assert set(jumps) == {None, 2800}


@pytest.mark.parametrize(("iterations", "at_once"), [(1, 0.03), (400, 0.03), (2400, 0.4 / 14)])
def test_short_runs_replace_few_gaussians_at_once(iterations, at_once):
    assert Schedule(RunConfig(iterations=iterations)).replaced == pytest.approx(at_once)


@pytest.mark.parametrize("first", [0, 3000])
def test_a_long_run_replaces_no_more_gaussians_in_all_than_a_short_one(first):
    for steps in (2400, 30_000):
        plan = ContinuedSchedule(RunConfig(iterations=first + steps), first=first)
        times = sum(plan.densifies(i) for i in range(first + 1, first + steps + 1))
        assert times > 10
        assert plan.replaced * times == pytest.approx(0.4, rel=0.05)


def test_images_are_reduced_up_to_the_very_step_that_ends_their_share():
    plan = Schedule(RunConfig(densify="budget", iterations=100))
    ((share, factor),) = plan.recipe.levels
    last = round(100 * share)
    assert [plan.level(step) for step in (1, last, last + 1, 100)] == [factor, factor, 1, 1]
