from types import SimpleNamespace

import numpy as np
import pytest

from recon_cli.sfm.outlier_cameras import jumps


def path(centers, names=None):
    count = len(centers)
    return SimpleNamespace(
        names=tuple(names or [f"{index:06d}.png" for index in range(count)]),
        registered=np.ones(count, bool),
        centers=np.column_stack([centers, np.zeros((count, 2))]))


def test_a_step_far_longer_than_those_around_it_is_a_jump():
    jump, = jumps(path([*range(10), *range(29, 40)]), {})
    assert (jump.before, jump.after) == ("000009.png", "000010.png")
    assert jump.ratio == pytest.approx(20)


def test_a_walk_that_speeds_up_slowly_has_no_jump():
    assert jumps(path(1.15 ** np.arange(40)), {}) == ()


def test_a_long_step_over_a_long_time_is_no_jump():
    names = [f"{index:06d}.png" for index in [*range(10), *range(29, 40)]]
    assert jumps(path([*range(10), *range(29, 40)], names), {}) == ()


def test_photos_without_times_or_numbers_say_nothing_of_steps():
    names = [f"photo_{index:02d}.png" for index in range(21)]
    centers = [*range(10), *range(29, 40)]
    assert jumps(path(centers, names), {}) == ()
    assert jumps(path(centers, names), dict.fromkeys(names)) == ()
    times = {name: float(index) for index, name in enumerate(names)}
    assert len(jumps(path(centers, names), times)) == 1


def test_the_times_set_the_order():
    names = [f"{index:06d}.png" for index in range(20)]
    times = {name: 19.0 - index for index, name in enumerate(names)}
    assert jumps(path(range(20), names), times) == ()


def test_a_few_cameras_have_no_usual_step():
    assert jumps(path([0, 1, 2, 90]), {}) == ()
