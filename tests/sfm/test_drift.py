import numpy as np
import pytest
from made_model import WIDTH, MadeModel, along, wall

from recon_cli.sfm.checks import MAX_SHIFT, bent
from recon_cli.sfm.verdict import check_weak_link, examine


@pytest.fixture
def walk():
    return MadeModel(wall(-4, 12, count=2400), along(np.arange(16) * 0.5))


def shifted(made, share):
    """The model with its principal point moved sideways by a share of the image's width."""
    model = made.model()
    camera = model.camera(1)
    camera.principal_point_x += share * WIDTH
    return model


def test_a_lens_that_stays_near_where_it_began_is_not_bent(walk, tmp_path):
    database = walk.write_database(tmp_path / "database.db")
    assert bent(walk.model(), database) == []
    assert bent(shifted(walk, 0.9 * MAX_SHIFT), database) == []


def test_a_model_whose_lens_went_far_is_not_trusted_but_not_refused(walk, tmp_path):
    database = walk.write_database(tmp_path / "database.db")
    verdict = examine(shifted(walk, -0.11), database, walk.names)
    assert not verdict.trusted
    assert "The principal point of camera 1 has gone 11%" in verdict.problems[-1]
    check_weak_link(verdict, accept=False)
