"""A deadline: what is left of it, its parts, and the pace that ends late work early."""

import math

import pytest

from recon_cli.deadline import Deadline, OutOfTime


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


def test_a_part_is_a_share_of_all_the_seconds_and_ends_no_later_than_the_whole():
    clock = Clock()
    whole = Deadline(60.0, clock)
    assert (whole.spent, whole.left, whole.limited) == (0, 60, True)
    clock.now += 30
    part = whole.part(0.2)
    assert (part.left, whole.left) == (12, 30)
    clock.now += 25
    assert part.left == -13
    assert whole.part(0.2).left == 5


def test_without_a_number_nothing_is_late():
    clock = Clock()
    free = Deadline(clock=clock)
    check = free.part(0.1).keep_pace(10)
    clock.now += 1e9
    check(1)
    free.refuse_late(1e9)
    assert not free.limited
    assert free.left == math.inf


@pytest.mark.parametrize(("each", "cut_at"), [(0.09, None), (0.2, 5), (20.0, 1)])
def test_work_is_cut_as_soon_as_its_pace_shows_that_it_ends_late(each, cut_at):
    clock = Clock()
    check = Deadline(10.0, clock).keep_pace(100)
    for done in range(1, 101):
        clock.now += each
        try:
            check(done)
        except OutOfTime:
            assert done == cut_at
            return
    assert cut_at is None
