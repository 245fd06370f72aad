"""Depth is used in the unit that fits the poses, and named where none does."""

import dataclasses
import re

import numpy as np
import pytest
from app_shots import shots

from recon_cli.datasets.depth_agreement import fit_depth
from recon_cli.datasets.layouts import read_posed
from recon_cli.datasets.posed import PosedImage
from recon_cli.errors import FormatError
from recon_cli.scene.camera import Lens


@dataclasses.dataclass
class Depth:
    """Depth in memory, in place of a file."""

    values: np.ndarray | None
    lens: Lens
    unit: float = 1e-3

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


def posed(taken, change, unit=1e-3, noise=0.01):
    rng = np.random.default_rng(0)
    lenses = [Lens("PINHOLE", *shot.size, shot.inner) for shot in taken]
    return [PosedImage(
        str(shot.number), None, lens, np.linalg.inv(shot.c2w), depth=Depth(
            change(shot.depth * rng.normal(1, noise, shot.depth.shape)), lens, unit))
        for shot, lens in zip(taken, lenses, strict=True)]


@pytest.mark.parametrize(("own", "read"), [
    (1.0, 1e-3), (1 / 5000, 1e-3), (1 / 4000, 1e-3), (1 / 6553.5, 1e-3), (1e-3, 1.0),
    (1e-3, 1 / 5000), (1 / 4000, 1 / 5000), (1 / 5000, 1 / 6553.5), (1e-4, 1e-3)])
def test_depth_in_another_unit_is_used_in_the_one_that_fits(taken, own, read):
    fit = fit_depth(posed(taken, lambda metres: metres / own * read, read))
    assert fit.factor == pytest.approx(own / read)
    assert fit.shown
    assert fit.words
    assert not fit.fault


def test_depth_of_a_lens_with_one_focal_length_is_looked_up_where_it_lies(taken):
    images = []
    for image in posed(taken, lambda metres: metres * 5):  # in 1/5000 m, read in 1/1000 m
        fx, _, cx, cy = image.lens.params
        lens = Lens("SIMPLE_RADIAL", image.lens.width, image.lens.height, (fx, cx, cy, 0.0))
        images.append(dataclasses.replace(
            image, lens=lens, depth=dataclasses.replace(image.depth, lens=lens)))
    assert fit_depth(images).factor == pytest.approx(0.2)


@pytest.mark.parametrize(("scale", "noise"), [(1, 0.01), (1.05, 0.01), (0.95, 0.01), (1, 0.08)])
def test_depth_that_fits_by_a_tenth_stays_as_it_is(taken, scale, noise):
    fit = fit_depth(posed(taken, lambda depth: depth * scale, noise=noise))
    assert (fit.factor, fit.shown, fit.fault, fit.words) == (1, True, "", "")


@pytest.mark.parametrize("off", [1.2, 0.5, 39.37, 10, 0.02])
def test_depth_in_no_usual_unit_is_not_used_and_the_factor_named(taken, off):
    fit = fit_depth(posed(taken, lambda depth: depth / off))
    assert (fit.factor, fit.shown, fit.contradicts) == (1, False, False)
    said = float(re.search(r"about ([\d.e+-]+) times", fit.fault)[1])
    assert said == pytest.approx(off, rel=0.1)


@pytest.mark.integration
@pytest.mark.parametrize(("change", "words"), [
    (lambda depth: depth[::-1], "upside down"),
    (lambda depth: depth[:, ::-1], "left and right swapped")])
def test_depth_whose_rows_or_columns_are_in_another_order_is_not_used(taken, change, words):
    fit = fit_depth(posed(taken, change))
    assert not fit.shown
    assert words in fit.fault


def test_points_of_the_set_tell_the_unit_where_cameras_do_not_move(taken):
    images = posed(taken, lambda depth: depth * 5)
    one = images[0]
    rows, columns = (axis.ravel() for axis in np.mgrid[2:40:3, 2:70:3])
    fx, fy, cx, cy = one.depth.own_lens(*one.depth.values.shape[::-1]).params
    z = taken[0].depth[rows, columns]
    local = np.column_stack([(columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z, z])
    points = (local - one.viewmat[:3, 3]) @ one.viewmat[:3, :3]
    still = [dataclasses.replace(image, viewmat=one.viewmat, depth=one.depth)
             for image in images[:4]]
    assert fit_depth(still, points).factor == pytest.approx(0.2)
    assert not fit_depth(still).shown


@pytest.mark.integration
def test_depth_that_fits_better_the_farther_it_is_is_not_accused(taken):
    """On a sphere around each camera no motion shows, once the sphere is large."""
    def on_a_sphere(depth):
        rows, columns = np.mgrid[:depth.shape[0], :depth.shape[1]]
        return 2 / np.sqrt(1 + ((columns * 4 - 148) / 150)**2 + ((rows * 4 - 83) / 150)**2)

    assert not fit_depth(posed(taken, on_a_sphere)).shown


@pytest.mark.integration
def test_poses_of_another_walk_are_told_from_a_wrong_unit(taken):
    images = posed(taken, lambda depth: depth)
    rng = np.random.default_rng(1)
    order = rng.permutation(len(images))
    mixed = [dataclasses.replace(image, viewmat=images[other].viewmat)
             for image, other in zip(images, order, strict=True)]
    fit = fit_depth(mixed)
    assert not fit.shown
    assert fit.factor == 1
    assert fit.contradicts or not fit.fault


@pytest.mark.integration
def test_without_motion_or_readable_depth_nothing_is_said(taken):
    images = posed(taken, lambda depth: depth / 10)
    still = [dataclasses.replace(image, viewmat=images[0].viewmat) for image in images]
    damaged = [dataclasses.replace(image, depth=Depth(None, image.lens)) for image in images]
    for some in (still, damaged, images[:1], []):
        fit = fit_depth(some)
        assert (fit.factor, fit.shown, fit.fault) == (1, False, "")


@pytest.mark.integration
def test_depth_of_a_real_phone_is_used_as_it_is(shared_data):
    fit = fit_depth(read_posed(shared_data / "record3d_door").images)
    assert (fit.factor, fit.fault) == (1, "")
