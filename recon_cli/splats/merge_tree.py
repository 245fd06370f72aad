"""A tree of Gaussians that stand for others from afar, for viewers that refine where one looks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.scene.splats import Splats, joined, with_rows
from recon_cli.splats.coarsen import GROUP, Moments, Rows, match_pairs, merge_pairs


@dataclass(frozen=True, eq=False)
class MergeTree:
    """M Gaussians: the root, then level by level; the children of one follow each other."""

    splats: Splats  # M; those without children are the scene, unchanged
    child_count: NDArray[np.int64]  # [M]
    child_start: NDArray[np.int64]  # [M] number of the first child; 0 where there is none


def build_tree(splats: Splats) -> MergeTree:
    """Returns the tree of N Gaussians, at least one; all have coefficients if any has.

    Neighbours are merged as by `coarsen`. One that found no partner is a child further up.
    """
    count = len(splats)
    if not len(splats.sh_rest):
        splats = splats.with_degree(0)
    scene = Splats.from_parameters({
        **splats.parameters(), "sh_rest": with_rows(splats.sh_rest, count)})
    moments, nodes = Moments.from_splats(scene), np.arange(count)
    parts, members, sizes = [scene], [np.zeros(0, np.int64)], [np.zeros(count, np.int64)]
    made = count
    while len(nodes) > 1:
        moments, label = _group(moments, max(1, len(nodes) // GROUP))
        size = np.bincount(label)
        several = size > 1
        members.append(nodes[np.argsort(label, kind="stable")][np.repeat(several, size)])
        sizes.append(size[several])
        parts.append(moments.select(several).splats())
        above = np.empty(len(size), np.int64)
        above[label] = nodes  # those that stay alone
        above[several] = made + np.arange(several.sum())
        made += int(several.sum())
        nodes = above
    order, starts = _by_level(int(nodes[0]), np.concatenate(members), np.concatenate(sizes))
    return MergeTree(
        joined(parts)[0].select(torch.from_numpy(order)), np.concatenate(sizes)[order], starts)


def _group(moments: Moments, target: int) -> tuple[Moments, Rows]:
    """Returns `target` Gaussians, and which of them each of the given ones [N] went into."""
    label = np.arange(len(moments.mass))
    while len(moments.mass) > target:
        first, second = match_pairs(moments, len(moments.mass) - target)
        alone = np.ones(len(moments.mass), np.bool_)
        alone[first] = alone[second] = False
        now = np.empty(len(alone), np.int64)
        now[alone] = np.arange(alone.sum())
        now[first] = now[second] = alone.sum() + np.arange(len(first))
        moments, label = merge_pairs(moments, first, second), now[label]
    return moments, label


def _by_level(root: int, members: Rows, sizes: Rows) -> tuple[Rows, Rows]:
    """Returns the nodes [M] from the root down, and where the children of each begin in that order.

    `sizes` [M] is the number of children of each node, `members` those of all in turn.
    """
    begins = np.cumsum(sizes) - sizes
    level, order, starts, placed = np.array([root]), [], [], 1
    while len(level):
        order.append(level)
        size = sizes[level]
        ends = np.cumsum(size)
        starts.append(np.where(size > 0, placed + ends - size, 0))
        inside = np.arange(ends[-1]) - np.repeat(ends - size, size)
        level = members[np.repeat(begins[level], size) + inside]
        placed += len(level)
    return np.concatenate(order), np.concatenate(starts)
