import numpy as np
import pytest
from made_model import MadeModel, along, moved, wall

from recon_cli.sfm.verdict import visual_aliasing
from recon_cli.sfm.verdict.evidence import gather_evidence


def measured(made: MadeModel, folder) -> visual_aliasing.Overlap:
    model = made.model()
    evidence = gather_evidence(model, made.write_database(folder / "db"), made.names)
    overlap = visual_aliasing.measure_overlap(model, evidence)
    return visual_aliasing.Overlap(overlap.expected.sum(axis=0), overlap.confirmed.sum(axis=0))


def test_two_cameras_side_by_side_should_show_the_same_and_do(tmp_path):
    result = measured(MadeModel(wall(-4, 5, count=1500), along([0.0, 0.2])), tmp_path)
    assert result.expected[0, 1] > 50  # of 72 cells in two images
    assert result.confirmed[0, 1] == result.expected[0, 1]
    assert (result.expected == result.expected.T).all()


def test_cells_without_a_common_point_are_expected_and_not_found(tmp_path):
    """Two cameras see the left half as one landmark each, the right half as two."""
    points = wall(-4, 4, count=1500)
    made = MadeModel(
        points, along([0.0, 0.2]),
        landmark=lambda image, point: point if points[point, 0] < 0 else (image, point))
    result = measured(made, tmp_path)
    assert result.confirmed[0, 1] / result.expected[0, 1] == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize("other", [
    moved(0, 0, 0, degrees=60), moved(-2.5, 0, 0), moved(0, 0, -6)],
    ids=["turned away", "far to the side", "far behind"])
def test_nothing_is_expected_of_cameras_that_see_things_differently(other, tmp_path):
    first, = along([0.0])
    turned = MadeModel(wall(-2, 2, count=1500), [first, first * other])
    expected = measured(turned, tmp_path).expected[0, 1]
    assert expected == 0


def test_a_pair_that_was_never_matched_says_nothing(tmp_path):
    made = MadeModel(wall(-4, 5, count=1500), along([0.0, 0.1, 0.2]), reach=1)
    result = measured(made, tmp_path)
    assert result.expected[0, 1] > 0
    assert result.expected[0, 2] == 0


def test_a_camera_behind_a_wall_of_its_own_expects_nothing_back(tmp_path):
    """It looks through its wall at what the other sees; the other does not see that wall."""
    near = wall(-0.5, 0.5, count=1500) * [1, 0.1, 0.1] + [0, 0, -1]  # half a metre ahead of it
    points = np.concatenate([wall(-3, 3, count=1500), near])
    poses = [*along([0.0]), moved(0, 0, 1)]
    through = MadeModel(points, poses)
    assert measured(through, tmp_path).expected[0, 1] > 0
    (tmp_path / "db").unlink()
    behind = MadeModel(points, poses, hidden={1: np.arange(1500)})
    assert measured(behind, tmp_path).expected[0, 1] == 0
