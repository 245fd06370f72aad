import numpy as np
import pytest

from recon_cli.sfm import weakest_cut
from recon_cli.sfm.evidence import MatchEvidence
from recon_cli.sfm.visual_aliasing import Overlap

NONE = Overlap(np.zeros((12, 12)), np.zeros((12, 12)))


def evidence(share, *, matches: int = 100) -> MatchEvidence:
    """Twelve images, each pair with as many matches, of which share(first, second) agree."""
    first, second = np.triu_indices(12, 1)
    return MatchEvidence(
        names=tuple("abcdefghijkl"),
        registered=np.ones(12, bool),
        centers=np.zeros((12, 3)),
        keypoints=np.full(12, 1000),
        visible=np.ones((12, 50), bool),
        tried=np.ones((12, 12), bool),
        pairs=np.column_stack([first, second]),
        matches=np.full(66, matches),
        agreeing=np.array(
            [round(matches * share(a, b)) for a, b in zip(first, second, strict=True)]))


def halves(across: float):
    """Returns a share of 1 within {0..4} and {5..11}, and of `across` between them."""
    return lambda first, second: across if (first < 5) != (second < 5) else 1.0


@pytest.mark.parametrize("across", [0.0, 0.25, 0.49])
def test_the_link_between_two_halves_has_the_share_that_agrees_across(across):
    link, astray = weakest_cut.find_weakest_cut(evidence(halves(across)), NONE)
    assert link.share == pytest.approx(across)
    assert link.sides == (tuple("abcde"), tuple("fghijkl"))
    assert (link.pairs, link.matches) == (35, 3500)
    assert astray == ()


def test_where_all_agrees_the_weakest_link_is_whole():
    link, astray = weakest_cut.find_weakest_cut(evidence(lambda _a, _b: 1.0), NONE)
    assert link.share == 1
    assert astray == ()


def test_an_image_that_all_others_contradict_is_astray_and_leaves_a_good_model():
    link, astray = weakest_cut.find_weakest_cut(
        evidence(lambda first, second: 0.1 if 7 in (first, second) else 0.9), NONE)
    assert [(item.name, item.matches) for item in astray] == [("h", 1100)]
    assert astray[0].share == pytest.approx(0.1)
    assert link.share == pytest.approx(0.9)


def test_more_images_than_a_tenth_are_half_a_model_and_not_astray():
    link, astray = weakest_cut.find_weakest_cut(
        evidence(lambda first, second: 0.1 if (first < 2) != (second < 2) else 0.9), NONE)
    assert astray == ()
    assert link.share == pytest.approx(0.1)
    assert link.sides[0] == ("a", "b")


def test_two_halves_that_show_what_they_should_are_whole_whatever_the_matches_say():
    expected = np.full((12, 12), 20.0)
    link, _ = weakest_cut.find_weakest_cut(evidence(halves(0.2)), Overlap(expected, 0.9 * expected))
    assert link.share is None or link.share >= weakest_cut.MIN_AGREEING
    link, _ = weakest_cut.find_weakest_cut(evidence(halves(0.2)), Overlap(expected, 0.4 * expected))
    assert link.share == pytest.approx(0.2)


def test_a_link_of_too_few_matches_cannot_be_told():
    link, _ = weakest_cut.find_weakest_cut(evidence(halves(0.0), matches=0), NONE)
    assert link.share is None
    assert "no two parts have 30 verified matches" in link.reason
