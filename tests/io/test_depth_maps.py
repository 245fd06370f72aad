"""Depth that ingest stores comes back as the sensor gave it."""

import json

import numpy as np
import pytest
from facts import raises

from recon_cli.errors import FormatError
from recon_cli.io.depth_maps import (
    LIST,
    read_depth,
    read_depth_list,
    write_depth,
    write_depth_list,
)
from recon_cli.scene.camera import Lens

LENS = Lens("PINHOLE", 4, 3, (5.0, 5.0, 2.0, 1.5))


def stored(folder, depth, **more):
    record = write_depth(folder, "a.png", depth.astype(np.float32), LENS, **more)
    write_depth_list(folder, {"a.png": record})
    (back,) = read_depth_list(folder).values()
    assert back == record
    return record, *read_depth(folder, "a.png", back)


def test_whole_millimetres_stay_exact(tmp_path):
    depth = np.arange(12).reshape(3, 4) * 0.401
    record, back, levels = stored(tmp_path, depth, unit=1e-3, reliable=5.0)
    assert (record.unit, record.reliable, levels) == (1e-3, 5.0, None)
    np.testing.assert_allclose(back, depth, atol=1e-7)


def test_metres_as_floats_lose_less_than_the_sensor_says(tmp_path):
    depth = np.random.default_rng(0).uniform(0.1, 6.3, (3, 4))
    record, back, _ = stored(tmp_path, depth, unit=1.0)
    np.testing.assert_allclose(back, depth, atol=6.3 / 65535)
    assert record.unit < 1e-4


def test_confidence_lies_beside_it(tmp_path):
    levels = np.arange(12, dtype=np.uint8).reshape(3, 4) % 3
    _, _, back = stored(tmp_path, np.ones((3, 4)), confidence=levels)
    np.testing.assert_array_equal(back, levels)


def test_no_depth_at_all_is_zero(tmp_path):
    assert not stored(tmp_path, np.zeros((3, 4)))[1].any()
    assert read_depth_list(tmp_path / "none") == {}


@pytest.mark.parametrize("change", [
    {"unit": 0}, {"unit": "1"}, {"lens": {}}, {"unit": -1.0}])
def test_a_damaged_list_is_refused(tmp_path, change):
    stored(tmp_path, np.ones((3, 4)))
    value = json.loads((tmp_path / LIST).read_text())
    value["a.png"] |= change
    (tmp_path / LIST).write_text(json.dumps(value))
    with raises(FormatError, "list", "depth"):
        read_depth_list(tmp_path)


def test_a_map_of_another_size_is_refused(tmp_path):
    record, *_ = stored(tmp_path, np.ones((3, 4)))
    write_depth(tmp_path, "a.png", np.ones((3, 5), np.float32), LENS)
    with raises(FormatError, "depth"):
        read_depth(tmp_path, "a.png", record)
