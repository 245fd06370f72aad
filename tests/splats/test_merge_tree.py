"""A tree of Gaussians: the scene is its ends, and every other one stands for its children."""

import numpy as np
import pytest
import torch
from archive_splats import room

from recon_cli.scene.splats import Splats
from recon_cli.splats.coarsen import Moments
from recon_cli.splats.merge_tree import build_tree


def children_of(tree, node):
    start, count = tree.child_start[node], tree.child_count[node]
    return np.arange(start, start + count)


def sorted_rows(splats):
    table = torch.cat([value.reshape(len(splats), -1) for value in splats.parameters().values()], 1)
    return table[np.lexsort(table.numpy().T)]


@pytest.mark.parametrize("degree", [0, 2])
def test_its_ends_are_the_scene_and_each_node_has_one_parent_before_it(degree):
    splats = room(500, degree=degree)
    tree = build_tree(splats)
    assert torch.equal(
        sorted_rows(tree.splats.select(torch.from_numpy(tree.child_count == 0))),
        sorted_rows(splats))
    parents = np.zeros(len(tree.splats), int)
    for node in range(len(tree.splats)):
        assert (children_of(tree, node) > node).all()
        parents[children_of(tree, node)] += 1
    assert parents[0] == 0
    assert (parents[1:] == 1).all()
    assert (tree.child_count != 1).all()
    assert len(tree.splats) < 1.5 * len(splats)


def test_a_node_has_the_mass_and_the_mean_of_its_ends():
    tree = build_tree(room(300, degree=0))
    moments = Moments.from_splats(tree.splats)

    def ends(node):
        below = children_of(tree, node)
        return [node] if not len(below) else [end for child in below for end in ends(child)]

    opaque = 0.99  # above, opacity is cut off, and mass with it
    for node in np.flatnonzero(tree.child_count)[-40:]:
        if tree.splats.opacities[node] < opaque:
            rows = ends(node)
            mass = moments.mass[rows]
            assert moments.mass[node] == pytest.approx(mass.sum(), rel=1e-3)
            assert moments.mean[node] == pytest.approx(
                (mass[:, None] * moments.mean[rows]).sum(axis=0) / mass.sum(), rel=1e-3, abs=1e-4)


def test_a_single_gaussian_is_a_root_without_children():
    tree = build_tree(room(1, degree=1))
    assert (len(tree.splats), tree.child_count[0], tree.child_start[0]) == (1, 0, 0)


def test_where_only_some_have_coefficients_all_get_them():
    splats = room(60, degree=1)
    few = Splats(**{**splats.parameters(), "sh_rest": splats.sh_rest[:20]})
    tree = build_tree(few)
    assert tree.splats.sh_rest.shape == (len(tree.splats), 3, 3)
