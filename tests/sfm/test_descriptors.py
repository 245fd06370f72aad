"""Matching of descriptors: closed form, COLMAP's rules and a loop in float64."""

import numpy as np
import pytest

from recon_cli.sfm import descriptors
from recon_cli.sfm.descriptors import MAX_DISTANCE, MAX_RATIO, match_descriptors


def unit(*places):
    """Descriptors of COLMAP's length along some axes."""
    rows = np.zeros((len(places), 128), np.uint8)
    for row, axes in zip(rows, places, strict=True):
        row[list(axes)] = 512 / np.sqrt(len(axes)) / 2  # half of the length, as bytes end at 255
    return rows


def drawn(count, seed, like=None, noise=4):
    """Random descriptors of about COLMAP's length; noisy copies of others in another order."""
    draws = np.random.default_rng(seed)
    if like is None:
        return np.sqrt(draws.dirichlet(np.full(128, 0.4), count) * 512**2).clip(0, 255).astype(
            np.uint8)
    copies = like[draws.permutation(len(like))[:count]] + draws.normal(0, noise, (count, 128))
    return np.rint(copies).clip(0, 255).astype(np.uint8)


def by_loops(first, second):
    """COLMAP's rules, a pair at a time."""
    distances = np.linalg.norm(first[:, None].astype(float) - second[None].astype(float), axis=2)

    def one_way(table):
        found = {}
        for row, line in enumerate(table):
            best = int(line.argmin())
            others = np.delete(line, best)
            second = others.min() if len(others) else np.inf
            if line[best] <= MAX_DISTANCE * 512 and line[best] < MAX_RATIO * second:
                found[row] = best
        return found

    there, back = one_way(distances), one_way(distances.T)
    return [[row, column] for row, column in sorted(there.items()) if back.get(column) == row]


@pytest.mark.parametrize("count", [1, 7, 300])  # below and above what is compared at a time
def test_matches_are_those_of_a_loop_over_all_distances(count):
    first = drawn(count, 0)
    second = np.concatenate([drawn(min(count, 150), 1, like=first, noise=9), drawn(80, 2)])
    # near copies: neither is clearly nearer than the other
    second = np.concatenate([second, second[: 1 + count // 4]])
    found = match_descriptors(first, second)
    assert found.tolist() == by_loops(first, second)
    if count == 300:
        assert 50 < len(found) < 150


def test_matches_do_not_depend_on_how_many_rows_are_compared_at_a_time(monkeypatch):
    first = drawn(200, 3)
    second = drawn(150, 4, like=first, noise=12)
    whole = match_descriptors(first, second)
    monkeypatch.setattr(descriptors, "ROWS", 37)
    assert np.array_equal(match_descriptors(first, second), whole)
    assert len(whole) > 50


def test_both_images_must_agree():
    # Both rows of the first are nearest to the one of the second, which is nearest to row 1.
    assert match_descriptors(unit((0, 1, 2), (0, 1)), unit((0, 1), (9,))).tolist() == [[1, 0]]


def test_swapped_images_give_the_same_pairs():
    first = drawn(120, 5)
    second = drawn(90, 6, like=first, noise=10)
    there, back = match_descriptors(first, second), match_descriptors(second, first)
    assert sorted(there.tolist()) == sorted(back[:, ::-1].tolist())


def test_an_image_without_features_matches_nothing():
    assert match_descriptors(np.zeros((0, 128), np.uint8), unit((1,))).shape == (0, 2)
    assert match_descriptors(unit((1,)), np.zeros((0, 128), np.uint8)).shape == (0, 2)
