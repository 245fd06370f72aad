import contextlib
import shutil

import numpy as np
import posed_sets
import pycolmap
import pytest

from recon_cli.errors import FormatError, InputError
from recon_cli.io.colmap_model import read_model
from recon_cli.io.colmap_set import is_colmap, read_colmap
from recon_cli.scene.lens import MODELS

WIDTH, HEIGHT = posed_sets.WIDTH, posed_sets.HEIGHT
FORMS = ("bin", "txt")
PARAMS = (30.0, 31.0, 16.5, 11.0, 0.1, 0.02, 0.003, 0.004, 0.05, 0.06, 0.07, 0.08)
OLD_CAMERAS = "# Camera list\n3 PINHOLE 32 24 30 31 16.5 11\n"
OLD_IMAGES = """# Image list with two lines of data per image:
# Number of images: 2
7 1 0 0 0 1 2 3 3 a b.png
1.5 2.5 -1 3.5 4.5 9
5 0.7071067811865476 0 0 0.7071067811865476 0 0 1 3 c.png

"""
OLD_POINTS = "# Points\n9 1 2 3 4 5 6 0.5 7 1 5 0\n2 -1 -2 -3 255 0 1 0.25\n"


def moved(angle, place):
    rotation = pycolmap.Rotation3d(np.array([0, np.sin(angle), 0, np.cos(angle)]))  # xyzw
    return pycolmap.Rigid3d(rotation, np.array(place, float))


def rig_model(frames=3, kind="PINHOLE", params=PARAMS[:4]):
    """Frames of a rig of two cameras, the second beside the first and turned, and two points."""
    made = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for camera_id in (1, 2):
        made.add_camera(pycolmap.Camera(
            camera_id=camera_id, model=kind, width=WIDTH, height=HEIGHT, params=list(params)))
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id)
        if camera_id == 1:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, moved(0.3, [0.5, 0, 0]))
    made.add_rig(rig)
    for at in range(frames):
        frame = pycolmap.Frame(frame_id=at + 1, rig_id=1)
        frame.rig_from_world = moved(0.1 * at, [at, 0.25, 1])
        images = []
        for camera_id in (1, 2):
            image = pycolmap.Image(
                image_id=frames * (camera_id - 1) + at + 1, name=f"cam{camera_id}/{at}.png",
                camera_id=camera_id,
                points2D=[pycolmap.Point2D(np.array([1.5, 2.5]))])
            frame.add_data_id(image.data_id)
            image.frame_id = at + 1
            images.append(image)
        made.add_frame(frame)
        for image in images:
            made.add_image(image)
        made.register_frame(at + 1)
    for place, color in (([0, 2, 5], [255, 0, 7]), ([1, 2, 5], [1, 2, 3])):
        made.add_point3D(np.array(place, float), pycolmap.Track(), np.array(color, np.uint8))
    return made


def write(folder, made, form, place="sparse/0"):
    (folder / place).mkdir(parents=True, exist_ok=True)
    (made.write_binary if form == "bin" else made.write_text)(folder / place)
    for image in made.images.values():
        posed_sets.write_image(folder / "images" / image.name)
    return folder


@pytest.fixture(params=FORMS)
def form(request):
    return request.param


@pytest.fixture
def folder(tmp_path, form):
    return write(tmp_path, rig_model(), form)


def poses(posed):
    return {image.name: image.viewmat[:3] for image in posed.images}


def expected_poses(made):
    return {image.name: image.cam_from_world().matrix() for image in made.images.values()}


def assert_same_poses(found, expected):
    assert found.keys() == expected.keys()
    for name, matrix in expected.items():
        np.testing.assert_allclose(found[name], matrix, atol=1e-14)


def write_old(folder):
    """Writes a model by hand, as COLMAP did before rigs and frames."""
    (folder / "sparse").mkdir()
    for name, text in (
            ("cameras", OLD_CAMERAS), ("images", OLD_IMAGES), ("points3D", OLD_POINTS)):
        (folder / "sparse" / f"{name}.txt").write_text(text)
    for name in ("a b.png", "c.png"):
        posed_sets.write_image(folder / "images" / name)
    return folder


def test_the_poses_of_a_rig_agree_with_pycolmap(folder):
    assert_same_poses(poses(read_colmap(folder)), expected_poses(rig_model()))


def test_rigs_and_frames_say_the_same_where_the_images_file_is_missing(folder, form):
    (folder / "sparse" / "0" / f"images.{form}").unlink()
    made = rig_model()
    for image_id, (camera, viewmat) in read_model(folder / "sparse" / "0").unnamed.items():
        image = made.image(image_id)
        assert camera == image.camera_id
        np.testing.assert_allclose(viewmat[:3], image.cam_from_world().matrix(), atol=1e-14)


def test_models_from_before_rigs_are_read(folder, form):
    for name in ("rigs", "frames"):
        (folder / "sparse" / "0" / f"{name}.{form}").unlink()
    assert_same_poses(poses(read_colmap(folder)), expected_poses(rig_model()))


def test_a_model_written_by_hand_is_read(tmp_path):
    posed = read_colmap(write_old(tmp_path))
    assert [image.name for image in posed.images] == ["a b.png", "c.png"]
    np.testing.assert_allclose(posed.images[0].viewmat, [
        [1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    np.testing.assert_allclose(posed.images[1].viewmat, [
        [0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]], atol=1e-15)
    assert posed.lenses[0].params == (30, 31, 16.5, 11)
    np.testing.assert_array_equal(posed.points, [[-1, -2, -3], [1, 2, 3]])
    np.testing.assert_array_equal(posed.colors, [[255, 0, 1], [4, 5, 6]])


def test_points_and_colours_are_read(folder):
    posed = read_colmap(folder)
    np.testing.assert_array_equal(posed.points, [[0, 2, 5], [1, 2, 5]])
    np.testing.assert_array_equal(posed.colors, [[255, 0, 7], [1, 2, 3]])


def test_a_model_without_points_has_none(folder, form):
    (folder / "sparse" / "0" / f"points3D.{form}").unlink()
    assert read_colmap(folder).points is None


@pytest.mark.parametrize("kind", MODELS)
def test_every_camera_model_of_a_lens_is_read(tmp_path, form, kind):
    focals, count = MODELS[kind]
    params = (*PARAMS[:focals], *PARAMS[2:])[:count]
    write(tmp_path, rig_model(kind=kind, params=params), form)
    (lens,) = read_colmap(tmp_path).lenses
    assert (lens.model, lens.width, lens.height, lens.params) == (kind, WIDTH, HEIGHT, params)


def test_a_camera_model_that_no_lens_has_is_refused_by_name(tmp_path, form):
    write(tmp_path, rig_model(kind="FOV", params=(30, 31, 16.5, 11, 0.1)), form)
    with pytest.raises(FormatError, match="camera model FOV"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("place", [
    "sparse/0", "sparse", "sparse_text", "colmap/sparse/0", "colmap/sparse", "."])
def test_a_model_is_found_in_the_usual_places(tmp_path, place):
    write(tmp_path, rig_model(), "bin", place)
    assert is_colmap(tmp_path)
    assert len(read_colmap(tmp_path).images) == 6


@pytest.mark.parametrize("place", ["input", "."])
def test_images_are_found_where_other_programs_put_them(folder, place):
    if place == ".":
        for part in ("cam1", "cam2"):
            (folder / "images" / part).rename(folder / part)
    else:
        (folder / "images").rename(folder / place)
    assert len(read_colmap(folder).images) == 6


def test_a_model_folder_may_be_named_itself(folder):
    assert len(read_colmap(folder / "sparse" / "0").images) == 6


def test_an_undistorted_model_of_our_own_is_taken_before_the_distorted_one(tmp_path):
    write(tmp_path, rig_model(kind="SIMPLE_RADIAL", params=(30, 16, 12, 0.1)), "bin", "sparse")
    write(tmp_path / "undistorted", rig_model(), "bin", "sparse")
    assert read_colmap(tmp_path).lenses[0].model == "PINHOLE"


def test_reduced_images_alone_scale_the_lens_and_are_said(folder):
    (folder / "images").rename(folder / "images_2")
    for path in (folder / "images_2").rglob("*.png"):
        posed_sets.write_image(path, WIDTH // 2, HEIGHT // 2)
    shutil.copytree(folder / "images_2", folder / "images_8")
    posed = read_colmap(folder)
    assert posed.lenses[0].params == (15, 15.5, 8.25, 5.5)
    assert "the images are those in images_2" in posed.notices
    assert any("0.5 times" in notice for notice in posed.notices)


def test_an_image_of_another_size_than_the_others_is_refused(folder):
    posed_sets.write_image(folder / "images" / "cam1" / "1.png", WIDTH // 2, HEIGHT // 2)
    with pytest.raises(FormatError, match=r"1\.png is 16x12 pixels, but its camera 32x24"):
        read_colmap(folder)


def test_images_of_another_shape_are_refused(folder):
    for path in (folder / "images").rglob("*.png"):
        posed_sets.write_image(path, HEIGHT, WIDTH)
    with pytest.raises(FormatError, match="24x32 pixels, but its camera 32x24"):
        read_colmap(folder)


def test_images_that_are_gone_are_missing(folder):
    (folder / "images" / "cam1" / "1.png").unlink()
    posed = read_colmap(folder)
    assert posed.missing == ("cam1/1.png",)
    assert len(posed.images) == 5


def test_a_model_without_any_of_its_images_is_refused(folder):
    shutil.rmtree(folder / "images")
    with pytest.raises(InputError, match="none of their files is there"):
        read_colmap(folder)


def test_masks_named_as_colmap_does_are_kept(folder):
    posed_sets.write_image(folder / "masks" / "cam1" / "0.png.png")
    masks = {image.name: image.mask for image in read_colmap(folder).images}
    assert masks.pop("cam1/0.png") == folder / "masks" / "cam1" / "0.png.png"
    assert set(masks.values()) == {None}


def test_other_models_beside_the_first_are_said(folder):
    write(folder, rig_model(frames=2), "bin", "sparse/1")
    assert "only the first of 2 models in sparse was read" in read_colmap(folder).notices


def test_an_image_outside_the_data_set_is_refused(tmp_path):
    write_old(tmp_path)
    path = tmp_path / "sparse" / "images.txt"
    path.write_text(path.read_text().replace("c.png", "../../../secret.png"))
    with pytest.raises(FormatError, match="lies outside"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.99])
def test_a_binary_file_cut_short_anywhere_is_damaged(tmp_path, name, share):
    write(tmp_path, rig_model(), "bin")
    cut(tmp_path / "sparse" / "0" / f"{name}.bin", share)
    with pytest.raises(FormatError, match="not a whole COLMAP model"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["rigs", "frames"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.99])
def test_rigs_and_frames_cut_short_anywhere_are_damaged(tmp_path, name, share):
    write(tmp_path, rig_model(), "bin")
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    cut(tmp_path / "sparse" / "0" / f"{name}.bin", share)
    with pytest.raises(FormatError, match="not a whole COLMAP model"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("value", [0, 127, 255])
def test_whatever_stands_in_a_byte_is_read_or_refused(tmp_path, name, value):
    write(tmp_path, rig_model(frames=1), "bin")
    path = tmp_path / "sparse" / "0" / f"{name}.bin"
    data = path.read_bytes()
    for at in range(len(data)):
        path.write_bytes(data[:at] + bytes([value]) + data[at + 1:])
        with contextlib.suppress(InputError):
            read_colmap(tmp_path)


@pytest.mark.parametrize(("name", "old", "new", "line"), [
    ("cameras", "30 31", "30 wide", 2), ("cameras", "30 31 16.5 11", "30 31 16.5", 2),
    ("cameras", "32 24", "32", 2), ("cameras", "30 31", "nan 31", 2),
    ("cameras", "32 24", "32 inf", 2),
    ("images", "1 0 0 0 1 2 3", "1 0 0 zero 1 2 3", 3), ("images", "3 c.png", "", 5),
    ("images", "1 0 0 0 1 2 3", "0 0 0 0 1 2 3", 3), ("images", "0 0 1 3 c", "0 0 inf 3 c", 5),
    ("points3D", "4 5 6", "4 5 600", 2), ("points3D", "-1 -2 -3", "-1 nan -3", 3),
    ("points3D", "255 0 1 0.25", "255", 3)])
def test_a_malformed_line_of_text_is_named(tmp_path, name, old, new, line):
    write_old(tmp_path)
    path = tmp_path / "sparse" / f"{name}.txt"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(FormatError, match=rf"{name}\.txt, line {line}[, :]"):
        read_colmap(tmp_path)


@pytest.mark.parametrize(("name", "old", "new"), [
    ("rigs", "CAMERA 2 1", "CAMERA 2"), ("frames", "CAMERA 2 4", "CAMERA"),
    ("frames", "2 CAMERA", "two CAMERA")])
def test_a_malformed_line_of_rigs_or_frames_is_named(tmp_path, name, old, new):
    write(tmp_path, rig_model(), "txt")
    (tmp_path / "sparse" / "0" / "images.txt").unlink()
    path = tmp_path / "sparse" / "0" / f"{name}.txt"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(FormatError, match=rf"{name}\.txt, line \d+, is malformed"):
        read_colmap(tmp_path)


def test_an_image_of_an_unknown_camera_is_refused(tmp_path):
    write_old(tmp_path)
    path = tmp_path / "sparse" / "cameras.txt"
    path.write_text(path.read_text().replace("3 PINHOLE", "4 PINHOLE"))
    with pytest.raises(FormatError, match="unknown camera 3"):
        read_colmap(tmp_path)


def test_an_empty_model_is_refused(tmp_path, form):
    write(tmp_path, pycolmap.Reconstruction(), form)
    with pytest.raises(FormatError, match="no image has a pose"):
        read_colmap(tmp_path)


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[:int(share * len(data))])
