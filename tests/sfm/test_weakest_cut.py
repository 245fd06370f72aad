import dataclasses

import numpy as np
import pytest
from facts import assert_facts

from recon_cli.sfm import limits
from recon_cli.sfm.verdict import weakest_cut
from recon_cli.sfm.verdict.evidence import MatchEvidence

COUNT = 20
NAMES = tuple("abcdefghijklmnopqrst")


def evidence(share, *, matches=lambda first, second: 300 // (second - first)) -> MatchEvidence:
    """Twenty images in a row, of whose matches share(first, second) show one point.

    The further apart two images are, the fewer matches they have.
    """
    first, second = np.triu_indices(COUNT, 1)
    pairs = list(zip(first.tolist(), second.tolist(), strict=True))
    counts = np.array([matches(*pair) for pair in pairs])
    joined = np.array([round(count * share(*pair)) for count, pair in zip(
        counts.tolist(), pairs, strict=True)])
    return MatchEvidence(
        names=NAMES, registered=np.ones(COUNT, bool), centers=np.zeros((COUNT, 3)),
        keypoints=np.full(COUNT, 1000), visible=np.ones((COUNT, 50), bool),
        tried=np.ones((COUNT, COUNT), bool), pairs=np.array(pairs), matches=counts,
        agreeing=joined, explained=joined, traced=counts, joined=joined,
        positions=np.zeros((50, 3)), depths=np.ones(COUNT), doubled={})


def halves(across: float):
    """Returns a share of 1 within {0..7} and {8..19}, and of `across` between them."""
    return lambda first, second: across if (first < 8) != (second < 8) else 1.0


@pytest.mark.parametrize("across", [0.0, 0.25, 0.5])
def test_the_link_between_two_halves_has_the_share_that_is_joined_across(across):
    link, astray = weakest_cut.find_weakest_cut(evidence(halves(across)))
    assert link.share == pytest.approx(across, abs=0.01)
    assert link.sides == (tuple(NAMES[:8]), tuple(NAMES[8:]))
    assert link.pairs == 8 * 12
    assert astray == ()


def test_where_all_agrees_the_weakest_link_is_whole():
    link, astray = weakest_cut.find_weakest_cut(evidence(lambda _a, _b: 1.0))
    assert link.share == 1
    assert astray == ()


def test_an_image_that_all_others_contradict_is_astray_and_leaves_a_good_model():
    link, astray = weakest_cut.find_weakest_cut(
        evidence(lambda first, second: 0.1 if 7 in (first, second) else 0.9))
    assert [item.name for item in astray] == ["h"]
    assert astray[0].share == pytest.approx(0.1, abs=0.02)
    assert link.share == pytest.approx(0.9, abs=0.01)


def test_more_images_than_a_tenth_are_half_a_model_and_not_astray():
    link, astray = weakest_cut.find_weakest_cut(
        evidence(lambda first, second: 0.1 if (first < 3) != (second < 3) else 0.9))
    assert astray == ()
    assert link.share == pytest.approx(0.1, abs=0.01)
    assert link.sides[0] == ("a", "b", "c")


def test_wrong_images_all_over_the_model_are_not_dropped_one_by_one():
    """Every third image is wrong, but only a tenth of all could be dropped."""
    link, astray = weakest_cut.find_weakest_cut(
        evidence(lambda first, second: 0.1 if first % 3 == 0 or second % 3 == 0 else 0.9))
    assert len(astray) <= weakest_cut.MAX_OUTLIERS * COUNT
    assert link.share is not None
    assert link.share < limits.MIN_ONE_POINT


def test_places_that_look_alike_do_not_speak_against_a_right_model():
    """The ends match each other too, by as many matches as images four apart, and rightly apart."""
    def alike(first: int, second: int) -> bool:
        return first < 6 and second >= 14

    link, astray = weakest_cut.find_weakest_cut(evidence(
        lambda first, second: 0.0 if alike(first, second) else 1.0,
        matches=lambda first, second: 75 if alike(first, second) else 300 // (second - first)))
    assert link.share == 1
    assert astray == ()


def test_a_break_between_images_that_follow_each_other_is_not_hidden_by_a_closed_loop():
    """The row is a ring: the tie of its ends is as strong as those of neighbours, and holds."""
    def matches(first: int, second: int) -> int:
        return 300 // min(second - first, COUNT - second + first)

    def share(first: int, second: int) -> float:
        return 0.0 if first < 10 <= second < first + 6 else 1.0

    order = np.arange(COUNT)
    link, _ = weakest_cut.find_weakest_cut(evidence(share, matches=matches), order)
    assert link.share == 0
    first, second = link.sides
    assert ("j" in first) == ("k" in second), "it is cut where it is broken"


def test_an_image_that_shares_no_point_with_the_others_is_astray():
    made = evidence(lambda _a, _b: 1.0)
    visible = np.ones((COUNT, 50), bool)
    visible[6], visible[:, 0] = False, np.arange(COUNT) == 6
    link, astray = weakest_cut.find_weakest_cut(dataclasses.replace(made, visible=visible))
    assert [item.name for item in astray] == ["g"]
    assert link.share == 1


def test_pairs_that_show_no_points_say_nothing():
    made = evidence(halves(0.0))
    few = np.full_like(made.matches, limits.MIN_PAIR_INLIERS - 1)
    link, _ = weakest_cut.find_weakest_cut(dataclasses.replace(
        made, traced=few, joined=np.zeros_like(few), explained=made.matches))
    assert link.share is None
    assert link.explained == 1


def test_without_matches_nothing_is_known():
    made = evidence(halves(0.0), matches=lambda _a, _b: 1)
    link, _ = weakest_cut.find_weakest_cut(made)
    assert (link.share, link.explained) == (None, None)
    assert_facts(link.reason, 15, "matched")


@pytest.mark.parametrize("across", [0.0, 0.25, 0.5])
def test_matches_that_the_cameras_do_not_explain_break_a_link_whose_points_agree(across):
    made = evidence(lambda _a, _b: 1.0)
    first, second = (made.pairs < 8).T
    explained = np.where(first == second, made.matches, np.round(across * made.matches))
    link, astray = weakest_cut.find_weakest_cut(
        dataclasses.replace(made, explained=explained.astype(int)))
    assert link.share == 1
    assert link.explained == pytest.approx(across, abs=0.01)
    assert link.sides == (tuple(NAMES[:8]), tuple(NAMES[8:]))
    assert astray == ()


def test_a_link_whose_points_are_two_is_weaker_than_one_whose_matches_are_not_explained():
    made = evidence(halves(0.5))
    late = (made.pairs < 15).sum(axis=1) == 1
    link, _ = weakest_cut.find_weakest_cut(
        dataclasses.replace(made, explained=np.where(late, 0, made.matches)))
    assert link.sides == (tuple(NAMES[:8]), tuple(NAMES[8:]))


def test_one_pair_that_the_cameras_do_not_explain_may_only_look_alike():
    made = evidence(lambda _a, _b: 1.0)
    alike = (made.pairs == [0, 19]).all(axis=1)
    matches = np.where(alike, 5000, made.matches)
    link, _ = weakest_cut.find_weakest_cut(dataclasses.replace(
        made, matches=matches, explained=np.where(alike, 0, matches)))
    assert link.explained == 1
