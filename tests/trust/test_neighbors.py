"""What views show that are not rendered, by cameras whose neighbours are known."""

import numpy as np
import pytest
import torch
from small_room import camera, dots, room

from recon_cli.trust.neighbors import (
    pose_distances,
    rendered_count,
    spread_views,
    support_of_all,
)
from recon_cli.trust.support import ViewSupport


@pytest.mark.parametrize(("views", "count"), [
    (1, 1), (15, 15), (29, 29), (30, 15), (44, 22), (45, 15), (62, 21), (300, 100)])
def test_a_third_of_the_views_is_rendered_but_of_few_all(views, count):
    assert rendered_count(views) == count


def test_poses_lie_apart_by_angle_and_by_way_over_the_size_of_the_room():
    splats = dots([[0, 0, 2], [0, 0, -2]])
    eyes = [camera([-1, 0, 0], [5, 0, 0]), camera([1, 0, 0], [5, 0, 0]),
            camera([-1, 0, 0], [-1, 5, 0])]
    apart = pose_distances(eyes, splats)
    middle = np.array([-1 / 3, 0, 0])
    size = float(np.linalg.norm(np.array([0, 0, 2]) - middle))
    assert apart[0, 1] == pytest.approx(2 / size, rel=1e-5)
    assert apart[0, 2] == pytest.approx(np.pi / 2)
    np.testing.assert_allclose(apart, apart.T, atol=1e-6)


def test_of_a_rig_every_camera_is_rendered():
    splats = dots(room(step=0.5))
    steps = np.linspace(-1, 1, 10)
    targets = ([5, 0, 1.2], [0, 5, 1.2], [-5, 0, 1.2])
    rig = [camera([0, y, 1.2], target) for y in steps for target in targets]
    chosen = spread_views(pose_distances(rig, splats), 10)
    assert chosen == sorted(set(chosen))
    assert len(chosen) == 10
    counts = np.bincount([number % 3 for number in chosen], minlength=3)
    assert counts.min() >= 2, counts  # every third would be one camera alone


def test_a_view_shows_what_its_neighbours_show_as_far_as_it_lies_in_its_frame():
    cameras = [camera([0, y, 0], [5, y, 0]) for y in (-3, -1, 0, 1, 3)]  # 4/3 to the side at 2 away
    beside = [[2, 4 / 3 + 0.09, 0], [2, 4 / 3 + 0.11, 0]]  # of the frame from (0, 0, 0)
    means = [[2, 0, 0], [2, 0.5, 0], [-2, 0, 0], *beside, [2, -0.5, 0], [2, 0.2, 0]]
    splats = dots(means, radius=0.1)
    rows = [torch.tensor(own) for own in ([5], [0, 2, 6], [1, 3, 4, 6], [5])]
    centers = np.stack([cameras[number].center for number in (0, 1, 3, 4)])
    support = ViewSupport.from_rows(rows, centers, torch.rand(len(means)), "digest")
    found = support_of_all(
        support, splats, cameras, pose_distances(cameras, splats), [0, 1, 3, 4])
    assert [own.tolist() for own in found.rows] == [
        [5], [0, 2, 6],
        [0, 1, 3, 6],  # not 2, which lies behind, nor 4, nor 5, which no neighbour shows
        [1, 3, 4, 6], [5]]
    assert found.count.tolist() == [2, 2, 1, 2, 1, 2, 3]
    np.testing.assert_allclose(found.centers, [one.center for one in cameras])
    assert torch.equal(found.residual, support.residual)
    assert found.digest == "digest"


def test_where_every_view_is_rendered_nothing_changes():
    splats = dots(room(step=0.5))
    cameras = [camera([0, y, 1.2], [2, y, 1.2]) for y in (-0.5, 0, 0.5)]
    rows = [torch.arange(number, len(splats), 3) for number in range(3)]
    support = ViewSupport.from_rows(
        rows, np.stack([one.center for one in cameras]), torch.zeros(len(splats)))
    again = support_of_all(support, splats, cameras, pose_distances(cameras, splats), [0, 1, 2])
    assert all(torch.equal(*pair) for pair in zip(support.rows, again.rows, strict=True))
    assert torch.equal(support.count, again.count)
