"""Depth that does not fit the poses is named by what would make it fit."""

import dataclasses

import numpy as np
import pytest
from app_shots import shots

from recon_cli.datasets.depth_agreement import find_fault
from recon_cli.datasets.layouts import read_posed
from recon_cli.datasets.posed import PosedImage
from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens


@dataclasses.dataclass
class Depth:
    """Depth in memory, in place of a file."""

    values: np.ndarray | None
    lens: Lens

    def read(self):
        if self.values is None:
            raise FormatError("damaged")
        return self.values.astype(np.float32)

    def read_confidence(self):
        return None

    def own_lens(self, width, height):
        return self.lens.resized(width, height)


@pytest.fixture(scope="module", params=["office", "living"])
def taken(request, shared_data):
    return shots(shared_data / "rooms" / request.param, count=20, step=5, factor=2)


def posed(taken, change):
    rng = np.random.default_rng(0)
    lenses = [Lens("PINHOLE", *shot.size, shot.inner) for shot in taken]
    return [PosedImage(
        str(shot.number), None, lens, np.linalg.inv(shot.c2w), depth=Depth(
            change(shot.depth * rng.normal(1, 0.01, shot.depth.shape)), lens))
        for shot, lens in zip(taken, lenses, strict=True)]


@pytest.mark.parametrize(("change", "words"), [
    (lambda depth: depth, ""), (lambda depth: 1.03 * depth, ""),
    (lambda depth: depth / 10, "about 10 times"), (lambda depth: depth / 1000, "about 1e+03 times"),
    (lambda depth: depth * 10, "about 0.1 times"), (lambda depth: depth[::-1], "upside down"),
    (lambda depth: depth[:, ::-1], "left and right swapped")])
def test_units_and_orders_of_rows_are_told_apart(taken, change, words):
    found = find_fault(posed(taken, change))
    assert found == words or (words and words in found)


def test_depth_that_fits_better_the_farther_it_is_is_not_accused(taken):
    """On a sphere around each camera no motion shows, once the sphere is large."""
    def on_a_sphere(depth):
        rows, columns = np.mgrid[:depth.shape[0], :depth.shape[1]]
        return 2 / np.sqrt(1 + ((columns * 4 - 148) / 150)**2 + ((rows * 4 - 83) / 150)**2)

    assert find_fault(posed(taken, on_a_sphere)) == ""


def test_poses_of_another_walk_accuse_no_depth(taken):
    images = posed(taken, lambda depth: depth)
    rng = np.random.default_rng(1)
    order = rng.permutation(len(images))
    mixed = [dataclasses.replace(image, viewmat=images[other].viewmat)
             for image, other in zip(images, order, strict=True)]
    assert find_fault(mixed) == ""


def test_without_motion_or_readable_depth_nothing_is_said(taken):
    images = posed(taken, lambda depth: depth / 10)
    still = [dataclasses.replace(image, viewmat=images[0].viewmat) for image in images]
    assert find_fault(still) == ""
    assert find_fault([dataclasses.replace(image, depth=Depth(None, image.lens))
                       for image in images]) == ""
    assert find_fault(images[:1]) == ""
    assert find_fault([]) == ""


def test_depth_of_a_real_phone_fits(shared_data):
    assert find_fault(read_posed(shared_data / "record3d_door").images) == ""
