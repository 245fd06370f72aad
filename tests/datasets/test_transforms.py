import json

import numpy as np
import posed_sets
import pytest
from facts import assert_facts, raises
from PIL import Image

from recon_cli.datasets.transforms import read_transforms
from recon_cli.errors import FormatError, InputError


def read(tmp_path, value=None):
    return read_transforms(posed_sets.make_transforms(tmp_path, value))


def edited(frame=2, frames=4, **entry):
    """Returns a file whose one frame has other or more entries."""
    value = posed_sets.transforms(frames)
    value["frames"][frame].update(entry)
    return value


def rewrite(folder, edit, name="transforms.json"):
    """Changes a transforms.json without touching the images."""
    value = json.loads((folder / name).read_text())
    edit(value)
    (folder / name).write_text(json.dumps(value))


def test_opengl_poses_become_opencv_ones(tmp_path):
    for place, image in enumerate(read(tmp_path).images):
        np.testing.assert_allclose(image.viewmat @ posed_sets.pose(place), np.eye(4), atol=1e-15)


def test_names_lose_the_folder_that_all_share(tmp_path):
    assert [image.name for image in read(tmp_path).images] == [
        "0000.png", "0001.png", "0002.png", "0003.png"]


def test_the_intrinsics_of_the_file_are_kept_as_they_are(tmp_path):
    (lens,) = read(tmp_path).lenses
    assert (lens.model, lens.params) == ("PINHOLE", (30.0, 30.0, 16.5, 11.0))


def test_a_frame_may_have_a_lens_of_its_own(tmp_path):
    posed = read(tmp_path, edited(fl_x=40.0, k1=0.1))
    assert [posed.lenses.index(image.lens) for image in posed.images] == [0, 0, 1, 0]
    assert posed.lenses[1].model == "OPENCV"
    assert posed.lenses[1].params == (40.0, 30.0, 16.5, 11.0, 0.1, 0, 0, 0)


@pytest.mark.parametrize(("more", "model", "coefficients"), [
    ({"camera_model": "OPENCV", "k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4}, "OPENCV",
     (0.1, 0.2, 0.3, 0.4)),
    ({"camera_model": "SIMPLE_RADIAL", "k1": 0.1}, "OPENCV", (0.1, 0, 0, 0)),
    ({"camera_model": "OPENCV", "k1": 0.1, "k3": 0.2}, "FULL_OPENCV",
     (0.1, 0, 0, 0, 0.2, 0, 0, 0)),
    ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4},
     "OPENCV_FISHEYE", (0.1, 0.2, 0.3, 0.4)),
    ({"is_fisheye": True}, "OPENCV_FISHEYE", (0, 0, 0, 0)),
    ({"camera_model": "PINHOLE"}, "PINHOLE", ())])
def test_every_camera_model_has_its_coefficients(tmp_path, more, model, coefficients):
    (lens,) = read(tmp_path, posed_sets.transforms(**more)).lenses
    assert (lens.model, lens.params[4:]) == (model, coefficients)


def test_an_angle_of_view_and_the_size_of_the_image_make_a_lens(tmp_path):
    value = posed_sets.transforms()
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del value[key]
    value["camera_angle_x"] = np.pi / 2
    (lens,) = read(tmp_path, value).lenses
    assert lens.params == pytest.approx((16.0, 16.0, 16.0, 12.0))


def test_images_that_are_gone_are_missing_and_need_no_lens(tmp_path):
    posed_sets.make_transforms(tmp_path)
    (tmp_path / "images" / "0001.png").unlink()
    posed = read_transforms(tmp_path)
    assert posed.missing == ("0001.png",)
    assert len(posed.images) == 3
    assert_facts("\n".join(posed.notices), 1, 4, "0001.png")


def test_a_set_without_any_of_its_images_is_refused(tmp_path):
    (tmp_path / "transforms.json").write_text(json.dumps(posed_sets.transforms()))
    with raises(InputError, 4, "0000.png"):
        read_transforms(tmp_path)


@pytest.mark.parametrize("name", [
    "../../etc/passwd", "/etc/passwd", "images/../../x.png", "C:\\x.png", "..\\x.png"])
def test_a_file_outside_the_data_set_is_refused(tmp_path, name):
    posed_sets.make_transforms(tmp_path)
    rewrite(tmp_path, lambda value: value["frames"][2].update(file_path=name))
    with raises(FormatError, "lies", "outside"):
        read_transforms(tmp_path)


@pytest.mark.parametrize("folder", [
    "/home/someone/scene/images/", "C:\\captures\\scene\\images\\", "../scene/images/", "frames/"])
def test_paths_of_another_machine_are_found_by_their_names(tmp_path, folder):
    posed_sets.make_transforms(tmp_path)
    posed_sets.write_image(tmp_path / "masks" / "0002.png")

    def move(value):
        for frame in value["frames"]:
            frame["file_path"] = frame["file_path"].replace("images/", folder)
        value["frames"][2]["mask_path"] = "masks/0002.png"

    rewrite(tmp_path, move)
    posed = read_transforms(tmp_path)
    assert [image.path for image in posed.images] == [
        tmp_path / "images" / f"{number:04d}.png" for number in range(4)]
    assert posed.images[2].mask == tmp_path / "masks" / "0002.png"
    assert_facts("\n".join(posed.notices), 4, f"{folder}0000")


def test_among_files_of_one_name_the_folders_decide(tmp_path):
    posed_sets.make_transforms(tmp_path)
    posed_sets.write_image(tmp_path / "images_2" / "0001.png")
    rewrite(tmp_path, lambda value: value["frames"][1].update(file_path="D:\\x\\images\\0001.png"))
    assert read_transforms(tmp_path).images[1].path == tmp_path / "images" / "0001.png"
    rewrite(tmp_path, lambda value: value["frames"][1].update(file_path="D:\\x\\other\\0001.png"))
    with raises(FormatError, "lies", "outside"):
        read_transforms(tmp_path)


def test_an_image_that_is_listed_stands_for_no_other(tmp_path):
    posed_sets.make_transforms(tmp_path)
    rewrite(tmp_path, lambda value: value["frames"][1].update(file_path="other/0002.png"))
    posed = read_transforms(tmp_path)
    assert [image.path.name for image in posed.images] == ["0000.png", "0002.png", "0003.png"]
    assert len(posed.missing) == 1


def test_a_file_outside_is_not_found_by_its_name(tmp_path):
    posed_sets.make_transforms(tmp_path / "set")
    posed_sets.write_image(tmp_path / "secret.png")
    rewrite(tmp_path / "set", lambda value: value["frames"][1].update(file_path="../secret.png"))
    with raises(FormatError, "lies", "outside"):
        read_transforms(tmp_path / "set")


@pytest.mark.parametrize("name", [None, 3, "", "a\0b"])
def test_a_frame_without_a_file_name_is_refused(tmp_path, name):
    posed_sets.make_transforms(tmp_path)
    rewrite(tmp_path, lambda value: value["frames"][2].update(file_path=name))
    with raises(FormatError, 2, "frame"):
        read_transforms(tmp_path)


def test_a_file_name_longer_than_any_file_is_missing(tmp_path):
    posed_sets.make_transforms(tmp_path)
    rewrite(tmp_path, lambda value: value["frames"][2].update(file_path="images/" + "a" * 5000))
    assert len(read_transforms(tmp_path).missing) == 1


def test_names_with_backslashes_mean_folders(tmp_path):
    posed_sets.make_transforms(tmp_path)
    rewrite(tmp_path, lambda value: value["frames"][2].update(file_path="images\\0002.png"))
    assert read_transforms(tmp_path).images[2].name == "0002.png"


def test_an_image_listed_twice_with_one_pose_is_taken_once_and_said(tmp_path):
    posed_sets.make_transforms(tmp_path)
    rewrite(tmp_path, lambda value: value["frames"].append(value["frames"][1]))
    posed = read_transforms(tmp_path)
    assert len(posed.images) == 4
    (notice,) = posed.notices
    assert_facts(notice, 1, "images/0001.png")


def test_an_image_with_two_poses_is_refused(tmp_path):
    posed_sets.make_transforms(tmp_path)
    rewrite(tmp_path, lambda value: value["frames"][3].update(file_path="./images/0001.png"))
    with raises(FormatError, "0001.png"):
        read_transforms(tmp_path)


def test_lists_of_file_names_hold_out_the_test_views_and_leave_out_the_rest(tmp_path):
    names = [f"images/{number:04d}.png" for number in range(4)]
    posed = read(tmp_path, posed_sets.transforms(
        train_filenames=names[:1] + names[3:], val_filenames=names[1:2],
        test_filenames=["./" + names[3]]))
    assert [(image.name, image.held_out) for image in posed.images] == [
        ("0000.png", False), ("0003.png", True)]
    assert posed.splits
    assert_facts(posed.notices[0], 2, "frames", "left")


def test_validation_views_are_held_out_where_there_are_no_test_views(tmp_path):
    names = [f"images/{number:04d}.png" for number in range(4)]
    posed = read(tmp_path, posed_sets.transforms(
        train_filenames=names[:3], val_filenames=names[3:]))
    assert [image.held_out for image in posed.images] == [False, False, False, True]


def test_the_scenes_of_nerf_hold_out_their_test_views(tmp_path):
    for at, part in enumerate(("train", "val", "test")):
        (tmp_path / part).mkdir()
        frames = []
        for number in (0, 1):
            Image.new("RGBA", (32, 24)).save(tmp_path / part / f"r_{number}.png")
            frames.append({
                "file_path": f"./{part}/r_{number}", "rotation": 0.1,
                "transform_matrix": (posed_sets.pose(at) @ posed_sets.OPENGL).tolist()})
        (tmp_path / f"transforms_{part}.json").write_text(
            json.dumps({"camera_angle_x": 0.69, "frames": frames}))
    posed = read_transforms(tmp_path)
    assert [(image.name, image.held_out) for image in posed.images] == [
        ("train/r_0.png", False), ("train/r_1.png", False),
        ("test/r_0.png", True), ("test/r_1.png", True)]
    assert posed.lenses[0].params[0] == pytest.approx(16 / np.tan(0.345))


def test_depth_is_read_by_its_unit_and_makes_the_set_metric(tmp_path):
    depth = posed_sets.plane_depth(posed_sets.pose(2))
    posed_sets.write_depth(tmp_path / "depth" / "2.png", depth, 1000)
    np.save(tmp_path / "depth" / "1.npy", depth.astype(np.float32))
    value = edited(depth_file_path="depth/2.png")
    value["frames"][1].update(depth_file_path="depth/1.npy", depth_unit_scale_factor=1.0)
    posed = read(tmp_path, value)
    assert posed.metric
    np.testing.assert_allclose(posed.images[2].depth(), depth, atol=0.0006)
    np.testing.assert_allclose(posed.images[1].depth(), depth, rtol=1e-6)
    assert posed.images[0].depth is None


def test_masks_are_kept(tmp_path):
    posed_sets.write_image(tmp_path / "masks" / "2.png")
    posed = read(tmp_path, edited(mask_path="masks/2.png"))
    assert [image.mask for image in posed.images] == [
        None, None, tmp_path / "masks" / "2.png", None]


@pytest.mark.parametrize("key", ["depth_file_path", "mask_path"])
def test_depth_or_a_mask_that_is_named_but_gone_is_refused(tmp_path, key):
    with raises(FormatError, "0002.png", key):
        read(tmp_path, edited(**{key: "gone.png"}))


def test_sparse_points_are_read_as_they_are(tmp_path):
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
        "end_header\n1 2 3 4 5 6\n")
    posed = read(tmp_path, posed_sets.transforms(
        ply_file_path="points.ply", applied_transform=[[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]))
    np.testing.assert_array_equal(posed.points, [[1, 2, 3]])
    np.testing.assert_array_equal(posed.colors, [[4, 5, 6]])


def test_images_all_reduced_by_one_factor_scale_the_lens(tmp_path):
    posed_sets.make_transforms(tmp_path)
    for path in (tmp_path / "images").iterdir():
        posed_sets.write_image(path, 16, 12)
    posed = read_transforms(tmp_path)
    assert posed.lenses[0].params == (15, 15, 8.25, 5.5)


def test_one_image_of_another_size_is_refused(tmp_path):
    posed_sets.make_transforms(tmp_path)
    posed_sets.write_image(tmp_path / "images" / "0002.png", 31, 24)
    with raises(FormatError, "0002.png", "31x24", "32x24"):
        read_transforms(tmp_path)


def test_a_file_that_is_no_image_is_named(tmp_path):
    posed_sets.make_transforms(tmp_path)
    (tmp_path / "images" / "0002.png").write_text("no image")
    with raises(FormatError, "0002.png"):
        read_transforms(tmp_path)


def test_the_file_itself_may_be_named(tmp_path):
    posed_sets.make_transforms(tmp_path, name="transforms_mine.json")
    assert len(read_transforms(tmp_path / "transforms_mine.json").images) == 4


def test_test_views_whose_images_are_gone_hold_out_nothing(tmp_path):
    posed_sets.make_transforms(tmp_path, name="transforms_train.json")
    gone = json.dumps(posed_sets.transforms()).replace("images/", "test/")
    (tmp_path / "transforms_test.json").write_text(gone)
    posed = read_transforms(tmp_path)
    assert not posed.splits
    assert len(posed.missing) == 4


def nodes(value):
    """Yields each place in a tree of lists and dictionaries."""
    for key in value if isinstance(value, dict) else range(len(value)):
        yield value, key
        if isinstance(value[key], dict | list):
            yield from nodes(value[key])


@pytest.mark.integration
def test_whatever_stands_in_a_place_of_the_file_is_read_or_refused(tmp_path):
    posed_sets.make_transforms(tmp_path)
    value = posed_sets.transforms(
        2, k1=0.1, camera_model="OPENCV", train_filenames=["images/0000.png"],
        ply_file_path="gone.ply")
    refused = 0
    for parent, key in list(nodes(value)):
        kept = parent[key]
        for junk in (None, True, -1, 10**400, float("nan"), "x", [], {}, ["../x"], {"a": []}):
            parent[key] = junk
            (tmp_path / "transforms.json").write_text(json.dumps(value))
            try:
                read_transforms(tmp_path)
            except InputError:
                refused += 1
        parent[key] = kept
    assert refused > 300


def test_a_real_phone_capture_lists_more_than_it_holds(shared_data):
    posed = read_transforms(shared_data / "fox")
    assert (len(posed.images), len(posed.missing)) == (50, 17)
    assert posed.lenses[0].model == "OPENCV"
