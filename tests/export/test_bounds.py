"""What lies outside the room is moved inwards, and how far an export reaches is said."""

import math

import numpy as np
import pytest
import torch
from facts import assert_facts
from tiny_stages import CONTEXT

from recon_cli.export.bounds import SPHERES, Room, bound_scene, describe_bounds, describe_loss
from recon_cli.render import render
from recon_cli.scene.backdrop import Backdrop, fibonacci_sphere
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.splats import Splats, joined
from recon_cli.workspace.summaries import ExportChange


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
    assert_facts(text, 0, 9, "Gaussians", "between")
    assert "--backdrop drop" in text
    assert_facts(text, 9, "units", "left")
    assert "--crop" not in text


def test_gaussians_far_away_are_a_matter_of_crop():
    text = describe_bounds(room(far=3))
    assert_facts(text, "1,000")
    assert "--crop" in text
    assert "--backdrop drop" not in text


def test_a_scene_of_one_gaussian_has_no_size():
    assert describe_bounds(room().select(torch.tensor([0]))) == ""


# ---- moved inwards ----

ROOM = Room(np.zeros(3), 12.0)  # around a shell of radius 10
AHEAD = np.array([[1.0, 0, 0], [0, 1.0, 0], [-1.0, 0, 0], [0, -1.0, 0]])


def camera(place, ahead) -> Camera:
    viewmat = looking_at(np.asarray(place, float), np.asarray(place) + ahead, np.array([0, 0, 1.0]))
    return Camera(60, 40, 40.0, 40.0, 30.0, 20.0, viewmat)


CAMERAS = [camera((0.0, 0, 0), ahead) for ahead in AHEAD]


def dots(places, size: float, opacity: float, color: float) -> Splats:
    n = len(places)
    return Splats(torch.tensor(places).float(), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
                  torch.full((n, 3), math.log(size)), torch.full((n,), opacity).logit(),
                  torch.full((n, 3), color), torch.zeros(n, 0, 3))


def open_room(**more) -> Splats:
    """A shell with a gap towards +x, through which a far sheet and one behind it show."""
    shell = 10 * fibonacci_sphere(2000)
    shell = shell[(shell[:, 0] < 8) | (np.abs(shell[:, 2]) > 4)]
    behind = [[distance, y, z] for distance in (900.0, 1000.0)
              for y in np.arange(-500.0, 501, 50) for z in np.arange(-300.0, 301, 50)]
    hidden = [[0.0, 0, 800]]  # above all cameras
    parts = [dots(shell, 0.4, 0.98, 0.5), dots(behind[:273], 30.0, 0.6, 1.0),
             dots(behind[273:], 30.0, 0.6, -1.0), dots(hidden, 10.0, 0.9, 0.0)]
    scene, _ = joined(parts)
    scene.backdrop = more.get("backdrop")
    return scene


def images(splats: Splats, cameras) -> list[np.ndarray]:
    return [render(splats, one, splats.background, 0, backend="torch").rgb.numpy()
            for one in cameras]


def sphere(means: torch.Tensor) -> float:
    """As three.js takes it: around the middle of the box."""
    return float((means - (means.amax(0) + means.amin(0)) / 2).norm(dim=1).max())


@pytest.mark.parametrize("backdrop", [None, Backdrop(0.33, 0.33, 0.33, 0.0, 0.0, 0.0, 1.0)])
def test_what_lies_outside_is_moved_inwards_and_looks_as_before(backdrop):
    scene = open_room(backdrop=backdrop)
    bounded = bound_scene(scene, ROOM, CAMERAS, CONTEXT)
    inside = scene.means.norm(dim=1) <= ROOM.radius
    assert sphere(scene.with_sphere().means) > 30 * sphere(scene.means[inside])
    assert sphere(bounded.means) <= SPHERES[-1] * sphere(scene.means[inside]) * (1 + 1e-5)
    assert bounded.backdrop is None
    for before, after in zip(images(scene, CAMERAS), images(bounded, CAMERAS), strict=True):
        assert np.abs(after - before).mean() < 0.004  # the order of both sheets is kept
    # the room itself stays, bit for bit, and what no view shows goes
    assert torch.equal(bounded.means[bounded.means.norm(dim=1) <= 10.5], scene.means[inside])
    above = bounded.means[:, 2] > bounded.means[:, :2].norm(dim=1)
    assert not (above & (bounded.means.norm(dim=1) > 10.5)).any()


def test_sheets_whose_order_is_lost_would_be_noticed():
    scene = open_room()
    mixed = bound_scene(scene, ROOM, CAMERAS, CONTEXT)
    far = mixed.means.norm(dim=1) > ROOM.radius
    mixed.means[far] *= 20 / mixed.means[far].norm(dim=1, keepdim=True)  # one distance for all
    before, after = images(scene, CAMERAS[:1])[0], images(mixed, CAMERAS[:1])[0]
    assert np.abs(after - before).mean() > 0.01


def test_a_scene_that_ends_at_its_walls_stays_as_it_is():
    walls = dots(10 * fibonacci_sphere(500), 0.4, 0.98, 0.5)
    assert bound_scene(walls, ROOM, CAMERAS, CONTEXT) is walls


def test_the_room_holds_the_cameras_and_its_corners():
    corners = np.array(np.meshgrid(*[[-2.0, 2.0]] * 3)).reshape(3, -1).T
    walls = np.concatenate([corners, 2 * fibonacci_sphere(92)])
    window = np.array([[100.0, 0, 0]] * 5)
    room = Room.from_points(np.concatenate([walls, window]), np.zeros((3, 3)))
    assert np.linalg.norm(corners, axis=1).max() < room.radius < 10
    path = np.array([[-50.0, 0, 0], [50.0, 0, 0]])
    assert Room.from_points(walls, path).radius > 50
    assert Room.from_points(np.zeros((0, 3)), path).radius > 50


def test_a_loss_that_views_can_see_is_said():
    def change(option: str, db: float) -> ExportChange:
        return ExportChange(option=option, gaussians=1, gaussians_before=2, degree=0,
                            degree_before=0, psnr_change_db=db)

    assert describe_loss([change("backdrop", -0.09), change("crop", -3.0)]) == ""
    text = describe_loss([change("backdrop", -0.51)])
    assert "0.51 dB" in text
    assert "--backdrop keep" in text
