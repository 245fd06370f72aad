import numpy as np
import pytest

from recon_cli.sfm.verdict import view_graph

PAIRS = np.array([[0, 1], [1, 2], [0, 2], [3, 4], [4, 5], [3, 5], [2, 3]])
TRIANGLES = view_graph.weights(6, PAIRS, np.array([9, 9, 9, 9, 9, 9, 1]))  # two, tied by one weight
HALVES = np.array([True, True, True, False, False, False])


def test_the_weight_of_a_pair_stands_on_both_sides_of_the_diagonal():
    matrix = view_graph.weights(3, np.array([[0, 2]]), np.array([7]))
    assert matrix.tolist() == [[0, 0, 7], [0, 0, 0], [7, 0, 0]]


def test_pieces_come_largest_first_with_lone_images_at_the_end():
    matrix = view_graph.weights(6, np.array([[4, 5], [0, 2], [2, 3]]), np.array([1, 1, 1]))
    assert [piece.tolist() for piece in view_graph.components(matrix)] == [[0, 2, 3], [4, 5], [1]]


def test_a_graph_without_images_has_no_pieces():
    assert view_graph.components(np.zeros((0, 0))) == []


def test_a_cut_is_as_loose_as_its_weight_is_small_for_the_lighter_side():
    assert view_graph.across(TRIANGLES, HALVES) == 1
    assert view_graph.conductance(TRIANGLES, HALVES) == pytest.approx(1 / (2 * 27 + 1))
    assert view_graph.conductance(np.zeros((6, 6)), HALVES) == 0


def test_a_sweep_gives_the_weight_across_every_cut_of_an_order():
    order = np.array([5, 0, 3, 1, 4, 2])
    expected = []
    for head in range(1, 6):
        cut = np.zeros(6, bool)
        cut[order[:head]] = True
        expected.append(view_graph.across(TRIANGLES, cut))
    assert view_graph.sweep(TRIANGLES, order).tolist() == expected


def test_the_first_loose_order_parts_two_groups_that_hardly_hold_together():
    first = next(view_graph.loose_orders(TRIANGLES))
    assert set(first[:3].tolist()) in ({0, 1, 2}, {3, 4, 5})


def test_the_first_disputed_order_finds_a_dispute_where_the_ties_are_strong():
    """Eight images all tied alike; a tenth of what ties the odd to the even ones agrees."""
    first, second = np.triu_indices(8, 1)
    pairs = np.column_stack([first, second])
    whole = view_graph.weights(8, pairs, np.full(28, 100))
    part = view_graph.weights(8, pairs, np.where((first + second) % 2, 10, 100))
    order = next(view_graph.disagreement_orders(part, whole))
    cut = np.argmin(view_graph.sweep(part, order) / view_graph.sweep(whole, order))
    assert set(order[:cut + 1].tolist()) in ({0, 2, 4, 6}, {1, 3, 5, 7})


@pytest.mark.parametrize("count", [0, 1])
def test_a_single_image_cannot_be_cut(count):
    assert list(view_graph.loose_orders(np.zeros((count, count)))) == []


def test_images_without_any_weight_are_ordered_all_the_same():
    order = next(view_graph.disagreement_orders(np.zeros((4, 4)), np.zeros((4, 4))))
    assert sorted(order.tolist()) == [0, 1, 2, 3]


def test_a_forest_holds_each_group_by_its_strongest_ties():
    pairs = np.array([[0, 1], [1, 2], [0, 2], [3, 4]])
    forest = view_graph.spanning_forest(view_graph.weights(5, pairs, np.array([9, 5, 7, 1])))
    assert np.argwhere(np.triu(forest)).tolist() == [[0, 1], [0, 2], [3, 4]]
    assert (forest == forest.T).all()


def test_the_strongest_ties_are_those_of_either_image_and_the_forest():
    star = view_graph.weights(4, np.array([[0, 1], [0, 2], [0, 3], [1, 2]]), np.array([9, 8, 7, 1]))
    assert np.argwhere(np.triu(view_graph.strongest_ties(star, 1))).tolist() == [
        [0, 1], [0, 2], [0, 3]]
    assert (view_graph.strongest_ties(star, 4) == (star > 0)).all()


def test_every_edge_of_a_forest_is_a_cut_into_two_trees():
    forest = view_graph.spanning_forest(TRIANGLES)
    cuts = list(view_graph.tree_cuts(forest))
    assert len(cuts) == 5
    assert any((cut == HALVES).all() or (cut == ~HALVES).all() for cut in cuts)
