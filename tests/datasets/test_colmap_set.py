import shutil

import numpy as np
import posed_sets
import pytest
from colmap_sets import (
    FORMS,
    HEIGHT,
    PARAMS,
    WIDTH,
    rig_model,
    write,
    write_old,
)
from facts import assert_facts, raises
from PIL import Image

from recon_cli.datasets.colmap import is_colmap, read_colmap
from recon_cli.datasets.layouts import read_posed
from recon_cli.errors import FormatError, InputError
from recon_cli.io.colmap_model import read_model
from recon_cli.scene.camera import MODELS, PANORAMA


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


@pytest.mark.parametrize("kind", [name for name in MODELS if name != PANORAMA])
def test_every_camera_model_of_a_lens_is_read(tmp_path, form, kind):
    focals, count = MODELS[kind]
    params = (*PARAMS[:focals], *PARAMS[2:], 0.0, 0.0, 0.0, 0.0)[:count]
    write(tmp_path, rig_model(kind=kind, params=params), form)
    (lens,) = read_colmap(tmp_path).lenses
    assert (lens.model, lens.width, lens.height, lens.params) == (kind, WIDTH, HEIGHT, params)


def test_a_camera_model_that_no_lens_has_is_refused_by_name(tmp_path, form):
    write(tmp_path, rig_model(kind="EQUIRECTANGULAR", params=(WIDTH, HEIGHT)), form)
    with raises(FormatError, "EQUIRECTANGULAR"):
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
    assert_facts("\n".join(posed.notices), "images_2")
    assert any("0.5 times" in notice for notice in posed.notices)


def test_an_image_of_another_size_than_the_others_is_refused(folder):
    posed_sets.write_image(folder / "images" / "cam1" / "1.png", WIDTH // 2, HEIGHT // 2)
    with raises(FormatError, "1.png", "16x12", "32x24"):
        read_colmap(folder)


def test_images_of_another_shape_are_refused(folder):
    for path in (folder / "images").rglob("*.png"):
        posed_sets.write_image(path, HEIGHT, WIDTH)
    with raises(FormatError, "24x32", "32x24"):
        read_colmap(folder)


def test_images_that_are_gone_are_missing(folder):
    (folder / "images" / "cam1" / "1.png").unlink()
    posed = read_colmap(folder)
    assert posed.missing == ("cam1/1.png",)
    assert len(posed.images) == 5


def test_a_model_without_any_of_its_images_is_refused(folder):
    shutil.rmtree(folder / "images")
    with raises(InputError, "files"):
        read_colmap(folder)


def test_masks_named_as_colmap_does_are_kept(folder):
    posed_sets.write_image(folder / "masks" / "cam1" / "0.png.png")
    masks = {image.name: image.mask for image in read_posed(folder).images}
    assert masks.pop("cam1/0.png") == folder / "masks" / "cam1" / "0.png.png"
    assert set(masks.values()) == {None}


def test_of_several_models_the_largest_is_read_and_the_others_are_said(folder):
    write(folder, rig_model(frames=5), "bin", "sparse/1")
    write(folder, rig_model(frames=2), "txt", "sparse/10")
    posed = read_colmap(folder)
    assert len(posed.images) == 10
    (notice,) = posed.notices
    assert_facts(notice, "sparse/1", 10, 3, "sparse/0", 6, "sparse/10", 4)


def test_a_model_among_several_may_be_named_itself(folder):
    write(folder, rig_model(frames=5), "bin", "sparse/1")
    assert len(read_colmap(folder / "sparse" / "0").images) == 6


def test_a_model_may_be_numbered_from_one(folder):
    (folder / "sparse" / "0").rename(folder / "sparse" / "1")
    assert is_colmap(folder)
    assert len(read_colmap(folder).images) == 6


@pytest.mark.parametrize("change", [
    lambda path: path.with_suffix(".jpg"), lambda path: path.with_suffix(".PNG")])
def test_images_with_another_suffix_or_case_are_found_and_said(folder, change):
    for path in list((folder / "images").rglob("*.png")):
        image = Image.open(path)
        path.unlink()
        image.save(change(path))
    posed = read_colmap(folder)
    assert_same_poses(poses(posed), expected_poses(rig_model()))
    assert all(image.path == change(folder / "images" / image.name) for image in posed.images)
    assert_facts("\n".join(posed.notices), 6, "paths", "here")


def test_absolute_paths_of_another_machine_are_found_by_their_ends(tmp_path):
    write_old(tmp_path)
    text = (tmp_path / "sparse" / "images.txt").read_text()
    for name in ("a b.png", "c.png"):
        text = text.replace(name, f"/home/other/scene/images/{name}")
    (tmp_path / "sparse" / "images.txt").write_text(text)
    posed = read_colmap(tmp_path)
    assert [image.path.name for image in posed.images] == ["a b.png", "c.png"]
    (tmp_path / "images" / "c.png").unlink()
    assert read_colmap(tmp_path).missing == ("/home/other/scene/images/c.png",)


def test_an_absolute_path_never_opens_a_file_outside(tmp_path):
    (tmp_path / "set").mkdir()
    write_old(tmp_path / "set")
    posed_sets.write_image(tmp_path / "c.png")
    images = tmp_path / "set" / "sparse" / "images.txt"
    images.write_text(images.read_text().replace("c.png", f"{tmp_path}/c.png"))
    (tmp_path / "set" / "images" / "c.png").unlink()
    posed = read_colmap(tmp_path / "set")
    assert [image.name for image in posed.images] == ["a b.png"]


def test_a_model_whose_images_are_called_otherwise_names_what_is_there(folder):
    shutil.rmtree(folder / "images")
    posed_sets.write_image(folder / "images" / "other.png")
    with raises(InputError, "images/other.png"):
        read_colmap(folder)


@pytest.mark.parametrize("kept", ["none", "first", "last"])
def test_a_text_model_without_lines_of_observations_loses_no_image(tmp_path, kept):
    write(tmp_path, rig_model(), "txt")
    path = tmp_path / "sparse" / "0" / "images.txt"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    wanted = {"none": (), "first": (0,), "last": (len(lines) // 2 - 1,)}[kept]
    path.write_text("".join(
        f"{line}\n" for at, line in enumerate(lines) if at % 2 == 0 or at // 2 in wanted))
    assert_same_poses(poses(read_colmap(tmp_path)), expected_poses(rig_model()))


def test_a_name_of_numbers_is_not_taken_for_observations(tmp_path):
    write_old(tmp_path)
    path = tmp_path / "sparse" / "images.txt"
    path.write_text("7 1 0 0 0 1 2 3 3 12 34.png\n5 1 0 0 0 0 0 1 3 7\n")
    for name in ("12 34.png", "7"):
        posed_sets.write_image(tmp_path / "images" / f"{name}.png".replace(".png.png", ".png"))
    assert [image.name for image in read_colmap(tmp_path).images] == ["12 34.png", "7"]


def test_a_count_of_thousands_of_digits_is_more_than_the_file_holds(tmp_path):
    write_old(tmp_path)
    path = tmp_path / "sparse" / "images.txt"
    path.write_text(path.read_text().replace("images: 2", f"images: {'9' * 5000}"))
    with raises(FormatError, 2, "ends"):
        read_colmap(tmp_path)


def scan(folder, points, *, colors=True):
    """Writes points3D.ply beside a model, as INRIA's trainer reads it."""
    rows = np.zeros(len(points), [*((axis, "<f4") for axis in "xyz"), *(
        (name, "u1") for name in ("red", "green", "blue") if colors)])
    for axis, values in zip("xyz", np.transpose(points), strict=True):
        rows[axis] = values
    names = {"f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *(
        f"property {names[kind[1:]]} {name}" for name, kind in rows.dtype.descr), "end_header", ""]
    (folder / "sparse" / "0" / "points3D.ply").write_bytes(
        "\n".join(header).encode() + rows.tobytes())


def surface():
    return np.random.default_rng(0).uniform((-1, 1, 4), (2, 3, 6), (500, 3))


@pytest.mark.parametrize("alone", [True, False])
def test_a_cloud_beside_the_model_takes_the_place_of_its_points(folder, form, alone):
    scan(folder, surface())
    if alone:
        (folder / "sparse" / "0" / f"points3D.{form}").unlink()
    posed = read_colmap(folder)
    np.testing.assert_allclose(posed.points, surface(), atol=1e-6)
    assert posed.colors.shape == (500, 3)
    assert any("points3D.ply" in notice and "500" in notice for notice in posed.notices)


def test_points_of_a_cloud_without_colours_are_gray(folder):
    scan(folder, surface(), colors=False)
    assert (read_colmap(folder).colors == 128).all()


@pytest.mark.parametrize("move", [1000.0, 40.0])
def test_a_cloud_of_another_world_is_told_and_not_used(folder, move):
    scan(folder, surface() + move)
    posed = read_colmap(folder)
    assert len(posed.points) == 2
    assert_facts("\n".join(posed.notices), "points3D.ply")


def test_a_damaged_cloud_is_told_and_not_used(folder):
    (folder / "sparse" / "0" / "points3D.ply").write_bytes(b"ply\nno header")
    posed = read_colmap(folder)
    assert len(posed.points) == 2
    assert_facts("\n".join(posed.notices), "points3D.ply")
