"""How far an export reaches is said where viewers would show the room as a dot."""

import torch

from recon_cli.export.bounds import describe_bounds
from recon_cli.scene.backdrop import Backdrop
from recon_cli.scene.splats import Splats


def room(*, far: int = 0, backdrop: Backdrop | None = None) -> Splats:
    """A grid of 10 x 10 x 10 Gaussians in a cube of 9, of which some are a thousand away."""
    axis = torch.arange(10.0)
    means = torch.cartesian_prod(axis, axis, axis)
    means[:far] = 1000.0
    n = len(means)
    return Splats(means, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 3), -2.0),
                  torch.zeros(n), torch.zeros(n, 3), torch.zeros(n, 0, 3), backdrop=backdrop)


BACKDROP = Backdrop(0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 100.0)


def test_a_scene_that_is_all_room_needs_no_word():
    assert describe_bounds(room()) == ""


def test_a_backdrop_is_named_with_the_option_that_leaves_it_out():
    text = describe_bounds(room(backdrop=BACKDROP))
    assert "nine tenths of the Gaussians lie between 0 0 0 and 9 9 9" in text
    assert "--drop-backdrop" in text
    assert "(9 units are left)" in text
    assert "--crop" not in text


def test_gaussians_far_away_are_a_matter_of_crop():
    text = describe_bounds(room(far=3))
    assert "reach 1,000 units" in text
    assert "--crop" in text
    assert "--drop-backdrop" not in text


def test_a_scene_of_one_gaussian_has_no_size():
    assert describe_bounds(room().select(torch.tensor([0]))) == ""
