"""ingest of data sets that come with poses."""

import json
import logging

import numpy as np
import pytest
from app_shots import GL, jpeg, shots
from facts import assert_facts, raises
from ingest_media import blocks, listed, take, walk, write_video
from PIL import Image
from posed_sets import (
    FOCAL,
    HEIGHT,
    WIDTH,
    make_replica,
    make_scannet,
    make_transforms,
    plane_depth,
    pose,
    transforms,
    write_depth,
    write_image,
)

from recon_cli.config.stages import IngestConfig
from recon_cli.errors import FormatError, InputError
from recon_cli.workspace.records import POSES, read_poses


@pytest.fixture
def notices(caplog):
    caplog.set_level(logging.WARNING, logger="recon")
    return lambda: [record.getMessage() for record in caplog.records]


def known(out):
    return read_poses(out / POSES)


def test_a_replica_sequence_brings_poses_points_and_its_own_test_views(tmp_path, notices):
    summary = take(make_replica(tmp_path / "room"), tmp_path / "out")
    assert (summary.kind, summary.frames, summary.held_out) == ("replica", 6, 2)
    assert summary.metric
    assert_facts(notices()[0], "Replica", "sequence")
    assert_facts(notices()[-1], "--holdout")
    found, poses = listed(tmp_path / "out"), known(tmp_path / "out")
    names = [frame["name"] for frame in found["frames"]]
    assert names == sorted(names) == sorted(poses.viewmats)
    held = [frame["name"] for frame in found["frames"] if frame["held_out"]]
    assert all("test" in name for name in held)
    np.testing.assert_allclose(
        np.linalg.inv(poses.viewmats[held[0]]), pose(10), atol=1e-8)
    assert found["groups"][0]["lens"]["params"][2:] == [16.5, 11.0]  # half a pixel from the file's
    assert poses.metric
    assert summary.points == len(poses.points) > 100


@pytest.mark.parametrize(("apart", "kept"), [(0.0, False), (1e-7, False), (1e-4, True)])
def test_poses_that_are_turns_alone_are_said_and_not_used(tmp_path, notices, apart, kept):
    folder = make_transforms(tmp_path / "set")
    file = folder / "transforms.json"
    listing = json.loads(file.read_text())
    for place, frame in enumerate(listing["frames"]):
        for row, line in enumerate(frame["transform_matrix"][:3]):
            line[3] = 2.0 + apart * place * (row == 0)
    file.write_text(json.dumps(listing))
    summary = take(folder, tmp_path / "out")
    assert (tmp_path / "out" / POSES).exists() == kept
    assert (summary.metric is not None) == kept
    assert any("place" in text for text in notices()) != kept


def test_depth_of_views_that_are_held_out_lends_no_points(tmp_path):
    folder = make_replica(tmp_path / "room")
    take(folder, tmp_path / "one")
    for path in (folder / "test" / "results").glob("depth*"):
        path.unlink()
    take(folder, tmp_path / "two")
    np.testing.assert_array_equal(known(tmp_path / "one").points, known(tmp_path / "two").points)


def test_a_long_sequence_is_thinned_evenly_and_its_test_views_are_not(tmp_path, notices):
    folder = make_replica(tmp_path / "room", frames=12, tests=3)
    summary = take(folder, tmp_path / "out", config=IngestConfig(frames=4))
    assert (summary.frames, summary.held_out) == (7, 3)
    poses = known(tmp_path / "out").viewmats
    places = [np.linalg.inv(poses[name])[:3, 3] for name in sorted(poses)][:4]
    np.testing.assert_allclose(places, [pose(index)[:3, 3] for index in (1, 4, 7, 10)], atol=1e-8)
    assert_facts("\n".join(notices()), 4, 12, "frames")


def test_missing_images_of_a_transforms_file_are_counted_and_told(tmp_path, notices):
    folder = make_transforms(tmp_path / "fox", transforms(frames=6))
    (folder / "images" / "0002.png").unlink()
    summary = take(folder, tmp_path / "out", config=IngestConfig(holdout="every:4"))
    assert (summary.declared_frames, summary.frames, summary.lost_frames) == (6, 5, 1)
    assert "0002.png" in summary.skipped[0]
    assert any("missing" in text for text in notices())
    assert [frame["held_out"] for frame in listed(tmp_path / "out")["frames"]] == [
        True, False, False, False, True]
    found = known(tmp_path / "out").viewmats["0003.png"]
    np.testing.assert_allclose(found, np.linalg.inv(pose(3)), atol=1e-12)


def test_a_reduced_image_takes_its_lens_along(tmp_path):
    folder = make_transforms(tmp_path / "set", transforms(k1=0.05))
    take(folder, tmp_path / "out", config=IngestConfig(max_size=64))
    lens = listed(tmp_path / "out")["groups"][0]["lens"]
    assert lens["width"] == WIDTH  # small enough already
    for path in (folder / "images").iterdir():
        Image.open(path).resize((4 * WIDTH, 4 * HEIGHT)).save(path)
    value = transforms(k1=0.05, fl_x=4 * FOCAL, fl_y=4 * FOCAL, cx=66, cy=44,
                       w=4 * WIDTH, h=4 * HEIGHT)
    images = {path: path.read_bytes() for path in (folder / "images").iterdir()}
    make_transforms(folder, value)
    for path, data in images.items():
        path.write_bytes(data)
    take(folder, tmp_path / "two", config=IngestConfig(max_size=64))
    reduced = listed(tmp_path / "two")["groups"][0]["lens"]
    assert (reduced["width"], reduced["height"]) == (64, 48)
    np.testing.assert_allclose(reduced["params"][:5], [60, 60, 33, 22, 0.05])


def test_exif_turns_no_image_whose_pose_is_known(tmp_path):
    folder = make_transforms(tmp_path / "set")
    exif = Image.Exif()
    exif[0x0112] = 6
    for path in sorted((folder / "images").iterdir()):
        Image.open(path).save(path, exif=exif)
    summary = take(folder, tmp_path / "out")
    assert (summary.width, summary.height, summary.lost_frames) == (WIDTH, HEIGHT, 0)


def test_transparent_pixels_become_a_mask(tmp_path):
    folder = make_transforms(tmp_path / "set")
    rgba = np.full((HEIGHT, WIDTH, 4), 255, np.uint8)
    rgba[:, :8, 3] = 0
    Image.fromarray(rgba).save(folder / "images" / "0001.png")
    take(folder, tmp_path / "out")
    frames = listed(tmp_path / "out")["frames"]
    assert [frame["masked"] for frame in frames] == [False, True, False, False]
    mask = np.asarray(Image.open(tmp_path / "out" / "masks" / "0001.png"))
    np.testing.assert_array_equal(mask, rgba[:, :, 3])


def test_an_image_of_another_size_than_its_camera_is_refused(tmp_path):
    folder = make_scannet(tmp_path / "scene", frames=6)
    write_image(folder / "color" / "3.jpg", width=WIDTH + 2)
    with raises(FormatError, "3.jpg", "34x24", "32x24"):
        take(folder, tmp_path / "out")


def test_half_an_image_is_left_out_and_named(tmp_path, notices):
    folder = make_scannet(tmp_path / "scene", frames=6)
    half = folder / "color" / "3.jpg"
    Image.fromarray(blocks(HEIGHT, WIDTH)).save(half, quality=100)
    half.write_bytes(half.read_bytes()[:-400])
    summary = take(folder, tmp_path / "out")
    assert (summary.frames, summary.lost_frames, summary.skipped) == (4, 1, ("3.jpg",))
    assert any("3.jpg" in text for text in notices())


def test_a_data_set_is_taken_alone(tmp_path):
    folder = make_transforms(tmp_path / "set")
    video = write_video(tmp_path / "walk.mp4", walk(10))
    with raises(InputError, 2, "transforms"):
        take((folder, video), tmp_path / "out")


def test_an_interrupted_run_ends_the_same(tmp_path):
    folder = make_replica(tmp_path / "room")
    take(folder, tmp_path / "whole")
    take(folder, tmp_path / "out")
    kept = {path.name: path.read_bytes() for path in (tmp_path / "whole").iterdir()
            if path.is_file()}
    for name in ("frames.json", "poses.json", "points.safetensors"):
        (tmp_path / "out" / name).unlink()
    first = sorted((tmp_path / "out" / "frames").iterdir())[0]
    first.unlink()
    take(folder, tmp_path / "out")
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()
            if path.is_file()} == kept


def test_the_inner_folder_of_a_replica_sequence_is_not_taken_for_photos(tmp_path):
    folder = make_replica(tmp_path / "room")
    with raises(FormatError, "Replica", "sequence") as caught:
        take(folder / "results", tmp_path / "out")
    assert f"Give {folder}" in caught.value.hint


def test_masks_by_stem_are_used_and_what_is_left_is_named(tmp_path, notices):
    folder = make_transforms(tmp_path / "set")
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:5] = 0
    for name in ("masks/0001.png", "depth/0000.png"):
        (folder / name).parent.mkdir()
        Image.fromarray(mask).save(folder / name)
    (folder / "bundle.out").write_text("# Bundle file v0.3\n")
    take(folder, tmp_path / "out")
    assert [frame["masked"] for frame in listed(tmp_path / "out")["frames"]] == [
        False, True, False, False]
    told = "\n".join(notices())
    for words in ("1 of its images have masks", "depth/ holds 1 depth maps",
                  "bundle.out is cameras in Bundler's format and is not used"):
        assert words in told


def test_images_of_twelve_bits_are_brightened_and_said(tmp_path, notices):
    folder = make_transforms(tmp_path / "set")
    for index, path in enumerate(sorted((folder / "images").iterdir())):
        wide = blocks(HEIGHT, WIDTH, seed=index)[..., 0].astype(np.uint16) * 16
        Image.fromarray(wide).save(path)
    take(folder, tmp_path / "out")
    assert any("12 bits" in notice for notice in notices())
    stored = np.asarray(Image.open(tmp_path / "out" / "frames" / "0000.png"))
    assert stored.max() > 200


def test_depth_of_an_unknown_unit_is_not_read_and_said_so(tmp_path, notices):
    value = transforms()
    for frame in value["frames"]:
        frame["depth_path"] = "images/0.depth.png"
    take(make_transforms(tmp_path / "set", value), tmp_path / "out")
    assert_facts("\n".join(notices()), 4, "depth", "frames")


def room_with_depth(folder, room, unit, suffix=".npy"):
    """Writes a transforms.json of a room in metres, whose depth has values of `unit` metres."""
    taken = shots(room, count=12, step=5, factor=4)
    frames = []
    for shot in taken:
        jpeg(folder / "images" / f"{shot.number:02d}.jpg", shot.rgb)
        depth = folder / "depth" / f"{shot.number:02d}{suffix}"
        depth.parent.mkdir(exist_ok=True)
        if suffix == ".npy":
            np.save(depth, (shot.depth / unit).astype(np.float32))
        else:
            Image.fromarray(np.rint(shot.depth / unit).astype(np.uint16)).save(depth)
        fx, fy, cx, cy = shot.inner
        frames.append({
            "file_path": f"images/{shot.number:02d}.jpg", "depth_file_path": f"depth/{depth.name}",
            "transform_matrix": (shot.c2w @ GL).tolist(), "w": shot.size[0], "h": shot.size[1],
            "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


@pytest.mark.integration
@pytest.mark.parametrize(("unit", "suffix"), [
    (1e-3, ".png"), (1.0, ".npy"), (1 / 4000, ".png"), (1 / 5000, ".png")])
def test_depth_in_another_unit_gives_points_where_the_room_is(
    tmp_path, shared_data, notices, unit, suffix
):
    folder = room_with_depth(tmp_path / "set", shared_data / "rooms" / "office", unit, suffix)
    assert take(folder, tmp_path / "out").metric
    low, high = np.quantile(known(tmp_path / "out").points, (0.02, 0.98), axis=0)
    assert (low > -0.3).all()
    assert (high < (5.2, 4.5, 2.9)).all()  # the room is 4.9 x 4.2 x 2.6 m
    assert (high - low).max() > 3
    assert any("The depth fits" in text for text in notices()) == (unit != 1e-3)


@pytest.mark.integration
def test_depth_that_fits_in_no_unit_gives_neither_points_nor_metres(
    tmp_path, shared_data, notices
):
    folder = room_with_depth(tmp_path / "set", shared_data / "rooms" / "office", 0.0254)
    summary = take(folder, tmp_path / "out")
    assert not summary.metric
    assert summary.points is None
    assert_facts("\n".join(notices()), "depth", "not", 25)


def test_depth_that_nothing_shows_leaves_the_unit_open(tmp_path, notices):
    value = transforms(frames=4)
    for number, frame in enumerate(value["frames"]):
        frame["depth_file_path"] = f"depth/{number}.png"
        write_depth(tmp_path / "set" / "depth" / f"{number}.png", plane_depth(pose(0)), 1000)
        frame["transform_matrix"] = [
            [*row[:3], row[3] + 1e-5 * number] for row in value["frames"][0]["transform_matrix"][:3]
        ] + [[0, 0, 0, 1]]
    summary = take(make_transforms(tmp_path / "set", value), tmp_path / "out")
    assert not summary.metric
    assert summary.points > 100
    assert_facts("\n".join(notices()), "whether", "depth", "fits")
