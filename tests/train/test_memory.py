"""The memory that a run will take, told and refused before it starts."""

import pytest

from recon_cli.errors import TrainingError
from recon_cli.train.memory import estimate, refuse_what_does_not_fit, room


def needed(**changes):
    values = {"views": 100, "width": 640, "height": 360, "gaussians": 100_000, "fused": True}
    return estimate(**(values | changes))


def test_images_are_counted_as_bytes():
    assert needed(gaussians=0).images == 100 * 640 * 360 * 3


def test_a_mask_is_a_byte_a_pixel():
    assert needed(masks=7).images - needed().images == 7 * 640 * 360


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
    with pytest.raises(TrainingError, match="MB are free") as caught:
        refuse_what_does_not_fit(needed(**changes), 8_000_000_000)
    assert option in caught.value.hint


@pytest.mark.parametrize("fused", [True, False])
def test_as_many_gaussians_fit_as_there_is_room_for_and_no_more(fused):
    one, free = needed(gaussians=1, fused=fused), 1_500_000_000
    most = room(one, free)
    refuse_what_does_not_fit(needed(gaussians=most, fused=fused), free)
    with pytest.raises(TrainingError):
        refuse_what_does_not_fit(needed(gaussians=most + 1, fused=fused), free)
    assert room(one, 1000) == 0
