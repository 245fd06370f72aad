"""The options of a run as a later version reads them, and the memory that it will take."""

import json
from dataclasses import replace

import pytest
from facts import raises

from recon_cli.config.stages import RunConfig
from recon_cli.errors import FormatError, TrainingError
from recon_cli.train.fit.train_data import (
    estimate_memory,
    gaussians_within,
    read_config,
    refuse_what_does_not_fit,
    write_config,
)


def rewrite(folder, **values):
    write_config(folder, RunConfig(iterations=7))
    path = folder / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_an_option_that_no_longer_exists_is_ignored(tmp_path):
    rewrite(tmp_path, sh_uniform=0.02)
    assert read_config(tmp_path) == RunConfig(iterations=7)


def test_a_value_that_is_no_longer_known_is_refused_with_the_way_out(tmp_path):
    rewrite(tmp_path, densify="mcmc")
    with raises(FormatError, "mcmc") as caught:
        read_config(tmp_path)
    assert "recon train --again" in caught.value.hint


def needed(**changes):
    values = {"views": 100, "width": 640, "height": 360, "gaussians": 100_000, "fused": True}
    return estimate_memory(**(values | changes))


def test_images_are_counted_as_bytes_with_their_reduced_ones():
    assert needed(gaussians=0).images == 100 * 640 * 360 * 3 * 5 / 4


def test_a_mask_is_a_byte_a_pixel():
    assert needed(masks=8).images - needed().images == 8 * 640 * 360 * 5 / 4


def test_images_that_would_take_half_of_the_memory_lie_in_a_file():
    images = needed().images
    assert needed(views=1000, free=20 * images + 2) == replace(needed(views=1000), in_file=False)
    stored = needed(views=1000, free=20 * images - 2)
    assert stored.in_file
    assert stored.images == 256 << 20
    assert stored.describe() != replace(stored, in_file=False).describe()
    assert needed(views=10_000, free=20 * images).total == stored.total


def test_a_gaussian_takes_at_most_one_and_a_half_kilobytes():
    assert needed().gaussians <= 1500 * 100_000


def test_a_gaussian_without_higher_harmonics_takes_a_quarter():
    # 14 of 59 numbers and the copy of a quaternion instead of 45 coefficients
    assert needed(sh_degree=0).gaussians == 100_000 * 4 * (5 * 14 + 4)
    assert needed(sh_degree=3).gaussians == 100_000 * 4 * (5 * 59 + 45)


def test_what_fits_is_not_refused():
    refuse_what_does_not_fit(needed(), needed().total)


@pytest.mark.parametrize(("changes", "option"), [
    ({"gaussians": 50_000_000}, "--max-gaussians"),
    ({"views": 3000, "width": 4000, "height": 3000}, "--max-size"),
    ({"views": 2, "width": 16_000, "height": 12_000}, "--max-size"),
])
def test_the_error_says_what_to_lower(changes, option):
    with raises(TrainingError, "MB", "free") as caught:
        refuse_what_does_not_fit(needed(**changes), 8_000_000_000)
    assert option in caught.value.hint


@pytest.mark.parametrize("fused", [True, False])
def test_as_many_gaussians_fit_as_there_is_room_for_and_no_more(fused):
    one, free = needed(gaussians=1, fused=fused), 1_500_000_000
    most = gaussians_within(one, free)
    refuse_what_does_not_fit(needed(gaussians=most, fused=fused), free)
    with pytest.raises(TrainingError):
        refuse_what_does_not_fit(needed(gaussians=most + 1, fused=fused), free)
    assert gaussians_within(one, 1000) == 0
