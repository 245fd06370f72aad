import numpy as np
import pytest
from facts import raises
from made_model import MadeModel, along, wall

from recon_cli.errors import SfmError
from recon_cli.sfm.features.still_points import MAX_STILL, find_still_share
from recon_cli.sfm.verdict.verdict import check_weak_link, examine


def walk_under_text(points: int) -> MadeModel:
    """A walk along a wall with so many points, under a text: points as far as the stars."""
    text = 1e6 * np.column_stack([
        np.random.default_rng(0).uniform(-0.4, 0.4, (300, 2)), np.ones(300)])
    return MadeModel(np.concatenate([wall(-4, 12, count=points), text]),
                     along(np.arange(16) * 0.5))


def test_no_point_of_a_walk_stays_in_its_place():
    walk = MadeModel(wall(-4, 12, count=900), along(np.arange(16) * 0.5))
    assert find_still_share(walk.model()) == 0


def test_the_points_of_a_text_stay_in_their_places():
    share = find_still_share(walk_under_text(600).model())
    assert share == pytest.approx(300 / (300 + 600 * 14 / 16), rel=0.1)


@pytest.mark.integration
def test_a_model_that_a_text_holds_together_is_refused(tmp_path):
    made = walk_under_text(600)
    verdict = examine(made.model(), made.write_database(tmp_path / "database.db"), made.names)
    assert verdict.still > MAX_STILL
    with raises(SfmError, "move"):
        check_weak_link(verdict, accept=False)


@pytest.mark.integration
def test_a_few_points_that_stay_do_no_harm(tmp_path):
    made = walk_under_text(9000)
    verdict = examine(made.model(), made.write_database(tmp_path / "database.db"), made.names)
    assert 0 < verdict.still < MAX_STILL
    assert verdict.trusted
