import math

import pytest
from facts import assert_facts

from recon_cli.room.scale_fusion import ScaleSource, fuse

POSES = ScaleSource("the tracked poses", 1.00, 0.01)
DEPTH = ScaleSource("sensor depth", 1.02, 0.02)


def test_a_single_source_is_taken_as_it_is():
    fused = fuse([DEPTH])
    assert fused.scale == pytest.approx(1.02)
    assert fused.error == pytest.approx(0.02)
    assert_facts(fused.describe()[0], "3.9%")


def test_sources_that_agree_are_averaged_by_their_inverse_variance():
    fused = fuse([POSES, DEPTH])
    # weights 4 to 1, in logarithms
    assert fused.scale == pytest.approx(1.02**0.2)
    assert fused.error == pytest.approx(0.01 * math.sqrt(0.8))
    assert fused.contradicting == ()


def test_sources_further_apart_than_their_errors_widen_the_interval():
    near, far = ScaleSource("a", 1.0, 0.01), ScaleSource("b", 1.035, 0.01)
    fused = fuse([near, far])
    # two values x apart with one error e: chi^2 is x^2 / (2 e^2), the error e / sqrt(2) times that
    assert fused.error == pytest.approx(math.log(1.035) / 2)


def test_the_one_of_three_that_contradicts_is_named_and_not_used():
    wrong = ScaleSource("sensor depth", 10.0, 0.005)
    other = ScaleSource("a door", 1.005, 0.01)
    fused = fuse([POSES, wrong, other])
    assert fused.contradicting == (wrong,)
    assert fused.scale == pytest.approx(math.sqrt(1.005))
    assert_facts("\n".join(fused.describe()), "900.0%")


def test_two_that_contradict_a_little_leave_the_trusted_one_with_an_interval_over_both():
    other = ScaleSource("sensor depth", 1.1, 0.005)
    fused = fuse([POSES, other])
    assert fused.scale == pytest.approx(1.0)
    assert math.exp(1.96 * fused.error) == pytest.approx(1.1)
    assert fused.contradicting == (other,)


def test_two_that_contradict_by_a_unit_leave_no_scale():
    fused = fuse([POSES, ScaleSource("sensor depth", 3.28, 0.005)])
    assert fused.scale is None
    sentence, = fused.describe()
    assert_facts(sentence, "tracked", "poses")
    assert_facts(sentence, "sensor")
    assert_facts(sentence, "--scale-between", "METRES")


def test_what_the_user_measured_decides():
    measured = ScaleSource("--scale-between", 3.28, 0.007)
    fused = fuse([measured, POSES, DEPTH], decisive="--scale-between")
    assert fused.scale == pytest.approx(3.28)
    assert fused.contradicting == (POSES, DEPTH)
