import numpy as np
import pycolmap
import pytest

from recon_cli.io.depth_maps import write_depth, write_depth_list
from recon_cli.io.images import write_png
from recon_cli.scene.camera import Lens
from recon_cli.scene.voxels import SURFACE_CELL
from recon_cli.sfm.poses.depth_points import add_depth_points

LENS = Lens("PINHOLE", 64, 48, (60.0, 60.0, 32.0, 24.0))
NAMES = tuple(f"{index}.png" for index in range(4))
WALL = 5.0  # units of the model before the cameras, of half a metre each
METRES = 0.5
COLOR = (200, 100, 50)


@pytest.fixture
def scene(tmp_path):
    """Four cameras before a wall, frames of one colour, and a model without points."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=256, height=192, params=(240.0, 240.0, 128.0, 96.0)))
    (tmp_path / "frames").mkdir()
    for index, name in enumerate(NAMES):
        view = np.eye(4)[:3]
        view[0, 3] = -0.2 * index
        model.add_image_with_trivial_frame(
            pycolmap.Image(image_id=index + 1, name=name, camera_id=1), pycolmap.Rigid3d(view))
        write_png(tmp_path / "frames" / name, np.full((192, 256, 3), COLOR, np.uint8))
    return model, tmp_path


def write(folder, depth, *, levels=None, reliable=None, names=NAMES):
    confidence = None if levels is None else np.full(depth.shape, levels, np.uint8)
    write_depth_list(folder, {
        name: write_depth(folder, name, depth, LENS, confidence=confidence, reliable=reliable)
        for name in names})


def flat():
    return np.full((48, 64), METRES * WALL, np.float32)


def placed(model):
    return np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)


def test_points_lie_on_the_wall_in_the_units_of_the_model_with_the_colour_of_the_frames(scene):
    model, folder = scene
    write(folder, flat())
    count = add_depth_points(model, folder, folder / "frames", METRES)
    points = placed(model)
    assert len(points) == count > 150
    np.testing.assert_allclose(points[:, 2], WALL, atol=1e-3)  # 16 bits
    assert all(tuple(point.color) == COLOR for point in model.points3D.values())
    # one for each cell
    cells = np.floor(points / (WALL * SURFACE_CELL)).astype(int)
    assert len(np.unique(cells, axis=0)) == count


def test_what_is_not_sure_or_too_far_gives_no_points(scene):
    model, folder = scene
    write(folder, flat(), levels=1)
    assert add_depth_points(model, folder, folder / "frames", METRES) == 0
    write(folder, flat(), reliable=2.0)
    assert add_depth_points(model, folder, folder / "frames", METRES) == 0
    write(folder, flat(), levels=2, reliable=5.0)
    assert add_depth_points(model, folder, folder / "frames", METRES) > 0


def test_depth_beside_an_edge_is_left_out(scene):
    model, folder = scene
    depth = flat()
    depth[:, 32:] /= 2
    write(folder, depth)
    add_depth_points(model, folder, folder / "frames", METRES)
    points = placed(model)
    assert set(np.round(points[:, 2], 1)) == {WALL, WALL / 2}


def test_what_a_single_frame_shows_and_what_the_model_has_gives_no_points(scene):
    model, folder = scene
    write(folder, flat())
    full = pycolmap.Reconstruction(model)
    count = add_depth_points(full, folder, folder / "frames", METRES)
    known = placed(full)[0]
    model.add_point3D(known, pycolmap.Track(), np.zeros(3, np.uint8))
    assert add_depth_points(model, folder, folder / "frames", METRES) == count - 1
    model = pycolmap.Reconstruction(model)
    write_depth_list(folder, {  # each frame shows another wall
        name: write_depth(folder, name, flat() * np.float32(1 + 0.2 * place), LENS)
        for place, name in enumerate(NAMES)})
    assert add_depth_points(model, folder, folder / "frames", METRES) == 0


def test_the_depth_of_held_out_frames_is_not_used(scene):
    model, folder = scene
    write(folder, flat())
    assert add_depth_points(model, folder, folder / "frames", METRES, without=NAMES) == 0
    x = {}
    for held_out in ((), NAMES[2:]):
        one = pycolmap.Reconstruction(model)
        add_depth_points(one, folder, folder / "frames", METRES, without=held_out)
        x[held_out] = placed(one)[:, 0].max()
    # the two on the right show .4 units more of the wall
    assert x[()] - x[NAMES[2:]] == pytest.approx(0.4, abs=2 * WALL * SURFACE_CELL)


def test_without_depth_nothing_is_added(scene):
    model, folder = scene
    assert add_depth_points(model, folder, folder / "frames", METRES) == 0
