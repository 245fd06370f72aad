import numpy as np
import pycolmap
import pytest
from facts import raises
from PIL import Image

from recon_cli.errors import FormatError
from recon_cli.io.colmap import (
    read_images,
    read_observations,
    read_pinholes,
    read_points,
    read_scene,
    read_visibility,
)

WIDTH, HEIGHT = 8, 6
NAMES = [f"{index:06d}.png" for index in range(5)]
FILES = ("cameras.bin", "images.bin", "points3D.bin")


def model(*, kind="PINHOLE", params=(5.0, 5.5, 4.0, 3.0)):
    """Five images along x, turned a little further each, that see two points; made by pycolmap."""
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(pycolmap.Camera(
        camera_id=1, model=kind, width=WIDTH, height=HEIGHT, params=list(params)))
    for index, name in enumerate(NAMES):
        seen = [pycolmap.Point2D(np.array([1.5, 2.5])), pycolmap.Point2D(np.array([3.5, 2.5]))]
        half = 0.1 * index
        made.add_image_with_trivial_frame(
            pycolmap.Image(image_id=index + 1, name=name, camera_id=1, points2D=seen),
            pycolmap.Rigid3d(
                pycolmap.Rotation3d(np.array([0, np.sin(half), 0, np.cos(half)])),  # xyzw
                np.array([-float(index), 0.25, 1.0])))
    for column, color in enumerate(((255, 0, 7), (1, 2, 3))):
        track = pycolmap.Track()
        for image_id in (1, 2, 3):
            track.add_element(image_id, column)
        made.add_point3D(np.array([column, 2.0, 5.0]), track, np.array(color, np.uint8))
    return made


@pytest.fixture
def undistorted(tmp_path):
    """An undistorted folder as the sfm stage leaves it."""
    for name in ("sparse", "images", "denoised"):
        (tmp_path / name).mkdir()
    model().write(tmp_path / "sparse")
    for folder in ("images", "denoised"):
        for name in NAMES:
            Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / folder / name)
    return tmp_path


def read(undistorted, held_out=(), **options):
    return read_scene(
        undistorted, held_out=frozenset(held_out), **{"validation": 0.0, **options})


def test_the_inner_camera_is_read_unchanged(undistorted):
    camera = read(undistorted).train[0].camera
    assert (camera.width, camera.height) == (WIDTH, HEIGHT)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (5.0, 5.5, 4.0, 3.0)


def test_each_view_has_its_inner_camera_by_name(undistorted):
    pinholes = read_pinholes(undistorted / "sparse")
    assert sorted(pinholes) == NAMES
    assert all(one.params[1] == 5.5 for one in pinholes.values())


def test_a_turned_camera_looks_where_its_quaternion_says(undistorted):
    viewmat = read(undistorted).train[2].camera.viewmat
    c, s = np.cos(0.4), np.sin(0.4)
    expected = [[c, 0, s, -2], [0, 1, 0, 0.25], [-s, 0, c, 1], [0, 0, 0, 1]]
    np.testing.assert_allclose(viewmat, expected, atol=1e-15)


def test_poses_agree_with_pycolmap(undistorted):
    reference = pycolmap.Reconstruction(undistorted / "sparse")
    for view in read(undistorted).train:
        image = reference.find_image_with_name(view.name)
        np.testing.assert_allclose(
            view.camera.viewmat[:3], image.cam_from_world().matrix(), atol=1e-15)
        np.testing.assert_allclose(view.camera.center, image.projection_center(), atol=1e-15)


def test_which_view_sees_which_point_is_as_pycolmap_has_it(undistorted):
    seen = read_visibility(undistorted / "sparse")
    assert sorted(seen) == NAMES
    assert [seen[name].tolist() for name in NAMES] == [[0, 1]] * 3 + [[]] * 2
    names, _, observations = read_observations(undistorted / "sparse")
    for index, name in enumerate(names):
        expected = np.sort(observations.point[observations.view == index])
        assert seen[name].tolist() == expected.tolist()


@pytest.mark.parametrize("name", ["images.bin", "points3D.bin"])
def test_visibility_of_a_damaged_model_is_an_error(undistorted, name):
    path = undistorted / "sparse" / name
    path.write_bytes(path.read_bytes()[:-5])
    with raises(FormatError, name):
        read_visibility(undistorted / "sparse")


def test_points_and_colors_are_read_in_the_order_of_their_ids(undistorted):
    scene = read(undistorted)
    np.testing.assert_array_equal(scene.points, [[0, 2, 5], [1, 2, 5]])
    np.testing.assert_array_equal(scene.colors, [[255, 0, 7], [1, 2, 3]])


def test_held_out_views_are_the_test_and_the_unregistered_ones_are_named(undistorted):
    scene = read(undistorted, held_out=["000001.png", "000099.png"], validation=0.25)
    assert [view.name for view in scene.test] == ["000001.png"]
    assert scene.unregistered_test == ("000099.png",)
    assert len(scene.validation) == 1
    assert len(scene.train) == 3


def test_twins_come_from_the_denoised_folder_unless_another_is_named(undistorted):
    assert read(undistorted).train[0].denoised == undistorted / "denoised" / NAMES[0]
    other = read(undistorted, denoised=undistorted / "images")
    assert other.train[0].denoised == undistorted / "images" / NAMES[0]


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(undistorted, name):
    (undistorted / "sparse" / name).unlink()
    with raises(FormatError, name):
        read(undistorted)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.99])
def test_a_file_cut_short_anywhere_is_damaged(undistorted, name, share):
    path = undistorted / "sparse" / name
    data = path.read_bytes()
    path.write_bytes(data[:int(share * len(data))])
    with raises(FormatError, "COLMAP"):
        read(undistorted)


@pytest.mark.parametrize("name", FILES)
def test_a_file_with_something_behind_its_end_is_damaged(undistorted, name):
    with (undistorted / "sparse" / name).open("ab") as file:
        file.write(b"\0")
    with raises(FormatError, 1, "bytes"):
        read(undistorted)


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_noise_is_refused(undistorted, name):
    path = undistorted / "sparse" / name
    path.write_bytes(b"\xff" * path.stat().st_size)
    with pytest.raises(FormatError):
        read(undistorted)


def test_a_distorted_camera_is_refused(undistorted):
    model(kind="OPENCV", params=(5, 5, 4, 3, 0, 0, 0, 0)).write(undistorted / "sparse")
    with raises(FormatError, "undistorted", "pinhole"):
        read(undistorted)


def test_a_model_without_points_is_refused(undistorted):
    made = model()
    for point in list(made.point3D_ids()):
        made.delete_point3D(point)
    made.write(undistorted / "sparse")
    with raises(FormatError, 0, "points"):
        read(undistorted)


@pytest.mark.parametrize("folder", ["images", "denoised"])
def test_a_missing_image_is_named(undistorted, folder):
    (undistorted / folder / NAMES[3]).unlink()
    with raises(FormatError, f"{folder}/{NAMES[3]}"):
        read(undistorted)


@pytest.mark.parametrize("folder", ["images", "denoised"])
def test_an_image_of_another_size_than_its_camera_is_refused(undistorted, folder):
    Image.new("RGB", (WIDTH + 1, HEIGHT)).save(undistorted / folder / NAMES[3])
    with raises(FormatError, "9x6", "8x6"):
        read(undistorted)


def test_a_mask_belongs_to_the_view_of_its_name(undistorted):
    (undistorted / "masks").mkdir()
    Image.new("L", (WIDTH, HEIGHT)).save(undistorted / "masks" / NAMES[3])
    masks = {view.name: view.mask for view in read(undistorted).train}
    assert masks.pop(NAMES[3]) == undistorted / "masks" / NAMES[3]
    assert set(masks.values()) == {None}


def test_without_a_folder_of_masks_every_pixel_counts(undistorted):
    assert all(view.mask is None for view in read(undistorted).train)


def test_a_mask_of_another_size_than_its_camera_is_refused(undistorted):
    (undistorted / "masks").mkdir()
    Image.new("L", (WIDTH, HEIGHT + 1)).save(undistorted / "masks" / NAMES[3])
    with raises(FormatError, "8x7", "8x6"):
        read(undistorted)


def test_an_empty_model_can_be_read_as_such(tmp_path):
    pycolmap.Reconstruction().write(tmp_path)
    assert read_images(tmp_path / "images.bin") == []
    points, colors = read_points(tmp_path / "points3D.bin")
    assert points.shape == colors.shape == (0, 3)
