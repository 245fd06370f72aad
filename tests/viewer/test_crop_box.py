"""The box in the viewer is the box of `recon export --crop`."""

import numpy as np
import torch
from scenes import random_splats

from recon_cli.export.reduce import crop
from recon_cli.viewer.content import CropBox, box_around


def test_what_is_shown_is_what_export_keeps_of_the_same_words():
    splats = random_splats(500, seed=4, dtype=torch.float32)
    box = CropBox.between((-0.51234567, -1.0, 1e-5), (0.75, 0.33333333, 9.87654))
    numbers = tuple(float(word) for word in box.arguments.split())
    kept = crop(splats, numbers)
    assert 0 < len(kept) < 500
    torch.testing.assert_close(kept.means, splats.means[torch.from_numpy(box.contains(splats))])


def test_the_first_box_holds_the_room_and_not_what_lies_far_outside():
    splats = random_splats(1000, seed=5, dtype=torch.float32)
    splats.means[:10] = 1000.0
    inside = box_around(splats).contains(splats)
    assert not inside[:10].any()
    assert inside[10:].mean() > 0.8


def test_a_box_has_twelve_edges_along_the_axes():
    edges = CropBox((0.0, 0.0, 0.0), (1.0, 2.0, 3.0)).edges()
    along = edges[:, 1] - edges[:, 0]
    assert edges.shape == (12, 2, 3)
    assert sorted(np.abs(along).sum(axis=1).tolist()) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4
    assert ((along != 0).sum(axis=1) == 1).all()


def test_a_box_that_is_turned_inside_out_holds_nothing():
    assert CropBox((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)).is_valid
    assert not CropBox((0.0, 2.0, 0.0), (1.0, 1.0, 1.0)).is_valid
