"""The support of Gaussians, by scenes whose angles and errors are known."""

import numpy as np
import pytest
import torch
from facts import raises
from small_room import camera, dots, photo

from recon_cli.errors import FormatError
from recon_cli.trust.support import ViewSupport, error_image, measure_support

EYES = [[0, -2, 0], [2, 0, 0]]  # at right angles as seen from the origin


def measure(splats, views, **options):
    return measure_support(splats, views, sh_degree=0, backend="torch", **options)


def test_views_that_show_a_gaussian_are_counted_with_the_angle_that_they_span():
    splats = dots([[0, 0, 0]], radius=0.2)
    support = measure(splats, [photo(splats, camera(eye, [0, 0, 0])) for eye in EYES])
    assert support.count.tolist() == [2]
    assert np.degrees(float(support.span(splats.means)[0])) == pytest.approx(90, abs=0.1)
    one = measure(splats, [photo(splats, camera(EYES[0], [0, 0, 0]))])
    assert float(one.span(splats.means)[0]) == 0


def test_what_lies_behind_something_opaque_is_not_shown():
    splats = dots([[0, 0, 0], [0, 1, 0]], opacity=9.0)
    splats.log_scales[0] = 0.0  # large, in front of the other one
    assert measure(splats, [photo(splats, camera([0, -2, 0], [0, 0, 0]))]).count.tolist() == [1, 0]
    splats.logit_opacities[0] = 0.0
    assert measure(splats, [photo(splats, camera([0, -2, 0], [0, 0, 0]))]).count.tolist() == [1, 1]


def test_a_place_is_compared_with_the_nearest_ray_and_the_nearest_distance():
    splats = dots([[0, 0, 0]], radius=0.2)
    support = measure(splats, [photo(splats, camera(eye, [0, 0, 0])) for eye in EYES])
    turned = np.radians(30)
    sight = support.seen_from(splats.means, np.array([np.sin(turned), -np.cos(turned), 0.0]))
    assert np.degrees(float(sight.angle[0])) == pytest.approx(30, abs=0.1)
    assert float(sight.nearer[0]) == pytest.approx(np.log(2), abs=1e-5)  # half as far
    farther = support.seen_from(splats.means, np.array([0.0, -9.0, 0.0]))
    assert float(farther.nearer[0]) == 0


def test_rays_are_those_to_the_means_that_are_given():
    splats = dots([[0, 0, 0]], radius=0.2)
    support = measure(splats, [photo(splats, camera(eye, [0, 0, 0])) for eye in EYES])
    assert np.degrees(float(support.span(splats.means)[0])) == pytest.approx(90, abs=0.1)
    farther = splats.means + torch.tensor([[-2.0, 2.0, 0.0]])  # on the axis of both eyes' square
    assert np.degrees(float(support.span(farther)[0])) == pytest.approx(
        np.degrees(2 * np.arctan2(2**0.5, 3 * 2**0.5)), abs=0.1)
    assert np.degrees(float(support.span(splats.means)[0])) == pytest.approx(90, abs=0.1)


def test_an_unseen_gaussian_is_at_the_widest_angle():
    splats = dots([[0, 0, 0], [0, -9, 0]], radius=0.2)
    support = measure(splats, [photo(splats, camera([0, -2, 0], [0, 0, 0]))])
    sight = support.seen_from(splats.means, np.array([0.0, -2.0, 0.0]))
    assert support.count.tolist() == [1, 0]
    assert float(sight.angle[1]) == pytest.approx(np.pi)
    assert support.span(splats.means).tolist() == [0, 0]


def test_the_residual_is_the_error_of_the_pixels():
    splats = dots([[-0.5, 0, 0], [0.5, 0, 0]], radius=0.15)
    splats.sh_dc[:] = 0
    view = photo(splats, camera([0, -2, 0], [0, 0, 0]))
    off = view.image.copy()
    off[:, 16:] = (off[:, 16:] * 0.8).astype(np.uint8)  # the right one is 20% darker
    other = type(view)(view.camera, off)
    left, right = measure(splats, [other]).residual.tolist()
    assert left == pytest.approx(0, abs=2e-3)
    assert 0.03 < right < 0.12  # of up to .1, less towards its rim


def test_a_gain_is_no_error_where_exposures_are_trained():
    splats = dots([[0, 0, 0]], radius=0.3)
    view = photo(splats, camera([0, -2, 0], [0, 0, 0]))
    rgb = view.image.astype(np.float32) / 255 * 0.5
    assert error_image(rgb, view, gains=False)[0].max() > 0.02
    assert error_image(rgb, view, gains=True)[0].max() < 5e-3


def test_masked_pixels_count_for_no_residual():
    splats = dots([[0, 0, 0]], radius=0.3)
    view = photo(splats, camera([0, -2, 0], [0, 0, 0]))
    wrong = type(view)(view.camera, 255 - view.image, np.zeros(view.image.shape[:2], bool))
    assert measure(splats, [wrong]).residual.tolist() == [0]


def test_what_is_saved_is_read_back(tmp_path):
    splats = dots([[0, 0, 0], [0.2, 0, 0.1], [0, -9, 0]], radius=0.1)
    support = measure(splats, [photo(splats, camera(eye, [0, 0, 0])) for eye in EYES], digest="d")
    support.save(tmp_path / "s.safetensors")
    again = ViewSupport.load(tmp_path / "s.safetensors")
    assert again.digest == "d"
    assert again.count.tolist() == support.count.tolist()
    torch.testing.assert_close(again.residual, support.residual)
    torch.testing.assert_close(again.span(splats.means), support.span(splats.means))


@pytest.mark.parametrize("content", [None, b"", b"no safetensors"])
def test_a_damaged_file_is_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "s.safetensors").write_bytes(content)
    with raises(FormatError):
        ViewSupport.load(tmp_path / "s.safetensors")
