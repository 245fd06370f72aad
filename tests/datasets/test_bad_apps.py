"""Damaged, incomplete and wrong captures: a typed error with a hint, or a counted omission."""

import json
import shutil
import zipfile

import cv2
import numpy as np
import pytest
from app_sets import APPS
from app_shots import shots
from facts import assert_facts, raises
from phone_writers import (
    nerfcapture,
    pack,
    polycam,
    r3d_entries,
    record3d,
    rtabmap,
    scanner_app,
    stray,
)
from PIL import Image
from solved_writers import metashape, reality_scan

from recon_cli.datasets.layouts import read_posed, recognise
from recon_cli.datasets.packed import is_packed, unpacked
from recon_cli.errors import FormatError, InputError


@pytest.fixture(scope="session")
def frames(shared_data):
    return shots(shared_data / "rooms" / "office", count=4)


def refused(folder, *facts):
    with raises(InputError, *facts):
        read_posed(folder)


def told(posed, *facts):
    assert_facts("\n".join(posed.notices), *facts)


def test_frames_of_a_half_written_export_are_left_out_and_counted(frames, tmp_path):
    polycam(tmp_path, frames)
    place = tmp_path / "keyframes"
    first, second, third, _ = sorted((place / "corrected_cameras").iterdir())
    first.write_text(first.read_text()[:40])
    second.unlink()
    (place / "corrected_images" / f"{third.stem}.jpg").unlink()
    posed = read_posed(tmp_path)
    assert len(posed.images) == 1
    told(posed, 1, "JSON")
    told(posed, 1, "camera")
    told(posed, "missing", 1, 2)


def test_without_corrected_pictures_the_drifting_pair_is_read_and_said_so(frames, tmp_path):
    polycam(tmp_path, frames)
    shutil.rmtree(tmp_path / "keyframes" / "corrected_images")
    posed = read_posed(tmp_path)
    assert posed.accuracy == "tracked"
    assert {image.path.parent.name for image in posed.images} == {"images"}
    told(posed, "corrected")
    assert not any(image.rim for image in posed.images)


def test_intrinsics_without_a_size_are_those_of_the_picture(frames, tmp_path):
    polycam(tmp_path, frames, sizes=False)
    assert read_posed(tmp_path).images[0].lens.width == frames[0].size[0]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e30, "x", None])
def test_a_pose_that_is_no_number_costs_its_frame(frames, tmp_path, value):
    scanner_app(tmp_path, frames)
    path = tmp_path / "frame_00003.json"
    text = json.loads(path.read_text())
    text["cameraPoseARFrame"][3] = value
    path.write_text(json.dumps(text))
    posed = read_posed(tmp_path)
    assert len(posed.images) == len(frames) - 1
    told(posed, 1, "pose", "finite", "rigid")


def test_the_place_in_the_list_is_the_number_in_the_name(shared_data):
    posed = read_posed(shared_data / "record3d_door")
    value = json.loads((shared_data / "record3d_door" / "metadata.json").read_text())
    assert len(posed.images) == 48
    for image in posed.images:
        pose = value["poses"][int(image.path.stem)]
        np.testing.assert_allclose(np.linalg.inv(image.viewmat)[:3, 3], pose[4:], atol=1e-9)
    lens = posed.images[0].lens
    np.testing.assert_allclose(lens.params, (1404.303, 1404.303, 724.646, 963.784), atol=1e-3)
    assert (lens.width, lens.height) == (1440, 1920)
    depth = posed.images[0].depth
    assert depth.read().shape == (256, 192)
    assert depth().shape == (1920, 1440)
    assert depth.own_lens(192, 256).params[2] == pytest.approx(724.646 * 192 / 1440, abs=1e-3)


def test_a_list_of_poses_that_is_too_short_is_said(frames, tmp_path):
    record3d(tmp_path, frames)
    path = tmp_path / "EXR_RGBD" / "metadata.json"
    value = json.loads(path.read_text())
    path.write_text(json.dumps(value | {"poses": value["poses"][:12]}))
    posed = read_posed(tmp_path)
    assert len(posed.images) == 2
    told(posed, 2, "list", "poses")


def test_one_matrix_serves_old_recordings(frames, tmp_path):
    record3d(tmp_path, frames, own=False)
    assert len(read_posed(tmp_path).lenses) == 1


def test_rows_in_another_order_keep_their_frames(frames, tmp_path):
    stray(tmp_path, frames, between=1)
    before = read_posed(tmp_path)
    path = tmp_path / "odometry.csv"
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *reversed(rows)]))
    after = read_posed(tmp_path)
    for one, two in zip(before.images, after.images, strict=True):
        assert one.frame == two.frame
        np.testing.assert_array_equal(one.viewmat, two.viewmat)


def test_rows_beyond_the_video_and_rows_twice_are_left_out(frames, tmp_path):
    stray(tmp_path, frames, between=1)
    path = tmp_path / "odometry.csv"
    rows = path.read_text().splitlines()
    path.write_text("\n".join([*rows, rows[1], rows[2].replace("000001", "000077"), "11.5, 0000"]))
    posed = read_posed(tmp_path)
    assert len(posed.images) == len(frames)
    told(posed, 1, 4, "video")
    told(posed, "number", "repeated")


def test_intrinsics_of_another_size_are_scaled_or_refused(frames, tmp_path):
    stray(tmp_path, frames, own=False)
    fx, fy, cx, cy = frames[-1].inner
    path = tmp_path / "camera_matrix.csv"
    path.write_text(f"{4 * fx}, 0, {4 * cx}\n0, {4 * fy}, {4 * cy}\n0, 0, 1\n")
    posed = read_posed(tmp_path)
    np.testing.assert_allclose(posed.images[0].lens.params, frames[-1].inner, rtol=1e-9)
    told(posed, 0.25)
    path.write_text(f"{4 * fx}, 0, {4 * cx}\n0, {4 * fy}, {8 * cy}\n0, 0, 1\n")
    refused(tmp_path, "shape")
    path.write_text("1, 2, 3\n")
    refused(tmp_path, "camera_matrix.csv", 9)
    path.unlink()
    refused(tmp_path, "camera_matrix.csv", "missing")


def test_times_without_a_match_are_left_out(frames, tmp_path):
    APPS["arkitscenes"].write(tmp_path, frames)
    path = next(tmp_path.rglob("lowres_wide.traj"))
    rows = path.read_text().splitlines()
    path.write_text("\n".join(rows[:3]))
    posed = read_posed(tmp_path)
    assert len(posed.images) == 3
    told(posed, 1, "pose", "time")


def test_poses_between_are_interpolated(frames, tmp_path):
    APPS["arkitscenes"].write(tmp_path, frames)
    path = next(tmp_path.rglob("lowres_wide.traj"))
    w2c = np.linalg.inv(frames[0].c2w)
    turn = cv2.Rodrigues(w2c[:3, :3])[0].ravel()
    rows = []
    for step in (-1, 1):  # the camera moves by .2 m over .1 s, and does not turn
        center = frames[0].c2w[:3, 3] + [0.1 * step, 0, 0]
        rows.append([frames[0].time + 0.05 * step, *turn, *(-w2c[:3, :3] @ center)])
    path.write_text("\n".join(" ".join(f"{one:.9f}" for one in row) for row in rows))
    (image,) = read_posed(tmp_path).images
    np.testing.assert_allclose(np.linalg.inv(image.viewmat), frames[0].c2w, atol=1e-6)


def test_names_by_id_old_formats_and_the_base_of_a_robot_are_read(frames, tmp_path):
    for number, more in enumerate((
            {"by_id": True}, {"ids": False}, {"camera": False}, {"name": "walk 1"})):
        folder = tmp_path / str(number)
        folder.mkdir()
        rtabmap(folder, frames, **more)
        assert recognise(folder) == "rtabmap"
        images = read_posed(folder).images
        for image, shot in zip(images, frames, strict=True):
            np.testing.assert_allclose(np.linalg.inv(image.viewmat), shot.c2w, atol=3e-6)


def test_eight_bits_of_depth_are_not_used(frames, tmp_path):
    nerfcapture(tmp_path, frames, scale=1.0, key="depth_integer_scale")
    posed = read_posed(tmp_path)
    assert posed.metric
    assert not any(image.depth for image in posed.images)
    told(posed, "depth", 4)


def test_depth_without_a_unit_is_not_used(frames, tmp_path):
    nerfcapture(tmp_path, frames)
    path = tmp_path / "transforms.json"
    value = json.loads(path.read_text())
    del value["integer_depth_scale"]
    path.write_text(json.dumps(value))
    posed = read_posed(tmp_path)
    assert posed.up == (0, 1, 0)
    told(posed, "unit", "integer_depth_scale")


def test_photos_that_are_elsewhere_are_counted(frames, tmp_path):
    reality_scan(tmp_path, frames)
    (tmp_path / "photo_02.jpg").unlink()
    told(read_posed(tmp_path), "missing", 1, 4)
    for path in tmp_path.glob("*.jpg"):
        path.unlink()
    refused(tmp_path, 4, "pictures")


def test_photos_are_found_by_other_suffixes_and_paths(frames, tmp_path):
    reality_scan(tmp_path, frames)
    (tmp_path / "images").mkdir()
    for path in tmp_path.glob("*.jpg"):
        Image.open(path).save(tmp_path / "images" / f"{path.stem}.png")
        path.unlink()
    text = (tmp_path / "cameras.csv").read_text().replace("photo_", r"D:\scan\PHOTO_")
    (tmp_path / "cameras.csv").write_text(text)
    assert len(read_posed(tmp_path).images) == len(frames)


def test_map_coordinates_are_moved_to_the_cameras(frames, tmp_path):
    shift = np.array([412_345.0, 5_412_345.0, 320.0])
    reality_scan(tmp_path, frames, shift=shift)
    posed = read_posed(tmp_path)
    told(posed, "subtracted")
    centers = np.stack([np.linalg.inv(image.viewmat)[:3, 3] for image in posed.images])
    truth = np.stack([frame.c2w[:3, 3] for frame in frames])
    assert np.abs(centers).max() < 10
    np.testing.assert_allclose(centers - centers[0], truth - truth[0], atol=1e-6)


def test_coordinates_of_the_globe_say_where_up_is(frames, tmp_path):
    shift = np.array([4_000_000.0, 600_000.0, 4_900_000.0])
    metashape(tmp_path, frames, shift=shift)
    posed = read_posed(tmp_path)
    np.testing.assert_allclose(posed.up, shift / np.linalg.norm(shift), atol=1e-5)


def test_coefficients_of_r8_are_taken_where_others_can_stand_for_them(frames, tmp_path):
    reality_scan(tmp_path, frames)
    path = tmp_path / "cameras.csv"
    head, *rows = path.read_text().splitlines()

    def write(k1, k4):
        path.write_text("\n".join([head, *(
            ",".join([*row.split(",")[:10], str(k1), "0", "0", str(k4), "0", "0"])
            for row in rows)]))

    write(-0.05, 0.001)
    lens = read_posed(tmp_path).images[0].lens
    assert lens.model == "FULL_OPENCV"
    write(0, 8.0)
    refused(tmp_path, "intrinsics")


def test_metashape_swaps_the_tangential_coefficients(frames, tmp_path):
    metashape(tmp_path, frames)
    path = tmp_path / "cameras.xml"
    path.write_text(path.read_text().replace("<b1>", "<p1>0.002</p1><p2>-0.003</p2><b1>"))
    lens = read_posed(tmp_path).images[0].lens
    assert lens.model == "OPENCV"
    assert lens.params[6:] == (-0.003, 0.002)


def test_pictures_of_a_headset_that_are_cut_short_are_left_out(frames, tmp_path):
    APPS["quest"].write(tmp_path, frames)
    path = next((tmp_path / "left_camera_mruk_rgba").iterdir())
    path.write_bytes(path.read_bytes()[:-1])
    posed = read_posed(tmp_path)
    told(posed, 1, ".rgba")
    told(posed, 1, "failed")


def unpack(path, tmp_path):
    with unpacked(path, tmp_path / "out") as folder:
        return read_posed(folder)


def test_a_packed_recording_that_is_damaged_is_refused(frames, tmp_path):
    path = pack(tmp_path / "walk.r3d", frames)
    assert len(unpack(path, tmp_path).images) == len(frames)
    data = path.read_bytes()
    for wrong in (data[:len(data) // 2], b"no zip", b"",
                  data[:2000] + bytes(500) + data[2500:]):
        path.write_bytes(wrong)
        assert is_packed(path)
        with pytest.raises(FormatError) as caught:
            unpack(path, tmp_path)
        assert caught.value.hint
        assert not (tmp_path / "out" / "unpacked").exists()


@pytest.mark.integration
def test_a_bomb_is_refused_before_it_is_unpacked(frames, tmp_path):
    path = tmp_path / "bomb.r3d"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in r3d_entries(frames).items():
            archive.writestr(name, data)
        for number in range(4):
            archive.writestr(f"rgbd/9{number}.jpg", bytes(1 << 26))
    with raises(FormatError):
        unpack(path, tmp_path)


@pytest.mark.parametrize("name", [
    "../rgbd/0.jpg", "../metadata", "../../escaped", "/rgbd/0.jpg", "..\\rgbd\\0.jpg",
    "C:/metadata"])
def test_a_recording_with_a_name_that_leads_out_is_refused(frames, tmp_path, name):
    path = tmp_path / "walk.r3d"
    with zipfile.ZipFile(path, "w") as archive:
        for entry, data in r3d_entries(frames).items():
            archive.writestr(entry, data)
        archive.writestr(name, b"x")
    before = set(tmp_path.rglob("*"))
    with raises(FormatError, "leads") as caught:
        unpack(path, tmp_path)
    assert caught.value.hint
    assert set(tmp_path.rglob("*")) - before == {tmp_path / "out"}


@pytest.mark.integration
def test_a_stream_that_unpacks_to_something_else_is_refused(frames, tmp_path):
    import lzfse

    APPS["r3d"].write(tmp_path, frames)
    path = next(tmp_path.rglob("*.depth"))
    depth = next(image for image in read_posed(tmp_path).images
                 if image.path.stem == path.stem).depth
    good = path.read_bytes()
    for data in (good[:-20], b"", b"bvx2" + bytes(100), lzfse.compress(bytes(1 << 24))):
        path.write_bytes(data)
        with raises(FormatError, "depth"):
            depth.read()


def test_other_archives_and_files_are_no_recordings(tmp_path):
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as archive:
        archive.writestr("a.jpg", b"x")
    (tmp_path / "walk.mp4").write_bytes(b"\0\0\0\x18ftypmp42")
    assert recognise(tmp_path / "photos.zip") is None
    assert recognise(tmp_path / "walk.mp4") is None
