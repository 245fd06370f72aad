"""Fewer Gaussians: what merging keeps, and that the result looks alike."""

import archive_splats
import pytest
import torch
from scenes import camera_at

from recon_cli.render.registry import render
from recon_cli.scene.splats import Splats
from recon_cli.splats import coarsen as coarsening
from recon_cli.splats.coarsen import coarsen

pytestmark = pytest.mark.floors


def one(mean=(0.0, 0, 3), scales=(0.3, 0.2, 0.1), opacity=0.2, color=(1.0, 0, 0)):
    return Splats(
        torch.tensor([mean]), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([scales]).log(),
        torch.logit(torch.tensor([opacity])), torch.tensor([color]), torch.zeros(0, 0, 3))


def both(first, second):
    return Splats(**{
        name: torch.cat([value, second.parameters()[name]])
        for name, value in first.parameters().items()})


def areas(splats):
    return splats.scales.double().sort(dim=1).values[:, 1:].prod(dim=1)


def moments(splats):
    """Returns what merging keeps: sums of mass, of first and second moments and of colours."""
    mass = splats.opacities.double() * areas(splats)
    w, x, y, z = torch.nn.functional.normalize(splats.quats.double()).unbind(1)
    turn = torch.stack([
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).reshape(-1, 3, 3)
    axes = turn * splats.scales.double()[:, None]
    means = splats.means.double()
    second = axes @ axes.transpose(1, 2) + means[:, :, None] * means[:, None]
    return [mass.sum(), (mass[:, None] * means).sum(0), (mass[:, None, None] * second).sum(0),
            (mass[:, None] * splats.sh_dc.double()).sum(0)]


def test_two_equal_ones_become_one_of_twice_the_opacity():
    merged = coarsen(both(one(), one()), 1)
    assert len(merged) == 1
    torch.testing.assert_close(merged.means, one().means)
    torch.testing.assert_close(merged.scales.sort().values, one().scales.sort().values)
    assert merged.opacities.item() == pytest.approx(0.4, abs=1e-6)


def test_two_apart_become_one_in_their_middle_as_long_as_both():
    pair = both(one((-1.0, 0, 3), (0.1,) * 3, 0.3), one((1.0, 0, 3), (0.1,) * 3, 0.1))
    merged = coarsen(pair, 1)
    torch.testing.assert_close(merged.means, torch.tensor([[-0.5, 0, 3]]))
    # variance within, and of masses 3 and 1 at -1 and 1
    longest = (0.01 + 0.75) ** 0.5
    assert merged.scales.max().item() == pytest.approx(longest, rel=1e-5)
    assert merged.opacities.item() == pytest.approx(0.4 * 0.01 / (longest * 0.1), rel=1e-5)


@pytest.mark.parametrize("count", [900, 300, 7, 1])
def test_moments_are_kept(count):
    splats = archive_splats.room(1000, degree=0)
    splats.logit_opacities -= 7  # so that no merged opacity is clipped
    merged = coarsen(splats, count)
    assert len(merged) == count
    mass = moments(splats)[0].item()
    for expected, found in zip(moments(splats), moments(merged), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * mass)


def test_copies_in_one_place_are_merged_too():
    splats = one()
    many = Splats(**{name: value.repeat(200, *[1] * (value.ndim - 1))
                     for name, value in splats.parameters().items()})
    assert len(coarsen(many, 3)) == 3


def test_light_ones_that_all_neighbours_prefer_do_not_hold_up_the_rest(monkeypatch):
    splats = archive_splats.room(3000, degree=0)
    splats.logit_opacities[:] = torch.linspace(-12, 6, 3000)  # each prefers the lightest around
    calls = []
    merge_once = coarsening._merge_once

    def counting(*arguments):
        calls.append(arguments)
        return merge_once(*arguments)

    monkeypatch.setattr(coarsening, "_merge_once", counting)
    assert len(coarsen(splats, 100)) == 100
    assert len(calls) < 20


def test_coefficients_are_averaged_and_everything_has_them():
    splats = archive_splats.room(50, degree=2)
    splats = Splats(**{**splats.parameters(), "sh_rest": splats.sh_rest[:20]})
    merged = coarsen(splats, 30)
    assert merged.sh_rest.shape == (30, 8, 3)
    assert torch.isfinite(merged.sh_rest).all()


@pytest.mark.integration
def test_a_quarter_looks_more_like_all_than_a_quarter_that_was_chosen():
    splats = archive_splats.room(8000, degree=0)
    splats.log_scales -= 0.7

    def seen(other):
        return render(other, camera_at(60, 44, focal=50), torch.zeros(3), 0).rgb

    def psnr(other):
        return -10 * torch.log10((seen(other) - seen(splats)).square().mean()).item()

    kept = splats.select(torch.arange(0, 8000, 4))
    kept.log_scales += 0.5 * torch.log(torch.tensor(4.0))  # as large together
    assert psnr(coarsen(splats, 2000)) > psnr(kept) + 3
