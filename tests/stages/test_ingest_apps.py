"""ingest of captures of scanning apps: every frame keeps its picture, its pose and its depth."""

import numpy as np
import pytest
from app_sets import APPS
from app_shots import shots
from ingest_media import take
from phone_writers import pack, relative, stray
from PIL import Image

from recon_cli.config.stages import IngestConfig
from recon_cli.io.depth_maps import read_depth, read_depth_list
from recon_cli.sfm.poses.align_world import world_transform
from recon_cli.workspace.records import POSES, read_frame_list, read_poses

PICTURE = 12  # of 255, mean: JPEG and H.264 of small pictures; the wrong picture is 30 off


@pytest.fixture(scope="session")
def frames(shared_data):
    """Shots of which each has intrinsics of its own."""
    return shots(shared_data / "rooms" / "office", count=3)


@pytest.fixture(scope="session")
def still(shared_data):
    return shots(shared_data / "rooms" / "office", count=3, moving=False)


def best_shot(pixels, taken):
    """Returns the shot that a picture shows, and how far it is off."""
    off = [np.abs(pixels.astype(float) - shot.rgb[:pixels.shape[0], :pixels.shape[1]]).mean()
           for shot in taken]
    return taken[int(np.argmin(off))], min(off)


@pytest.mark.integration
@pytest.mark.parametrize("name", APPS)
def test_pictures_and_poses_belong_together_and_end_with_z_up(name, frames, still, tmp_path):
    app = APPS[name]
    taken = frames if app.own else still
    app.write(tmp_path / "capture", taken)
    summary = take(tmp_path / "capture", tmp_path / "out")
    assert summary.kind == app.name
    assert summary.metric == app.metric
    poses, listed = read_poses(tmp_path / "out" / POSES), read_frame_list(tmp_path / "out")
    world = world_transform(
        np.zeros((0, 3)), poses.viewmats, scale_between=None, metric=poses.metric,
        given_up=poses.up,
        level_views=None if poses.up is None else np.array(list(poses.viewmats.values())))
    first, found = relative(taken) if app.world is None else app.world, []
    for frame in listed.frames:
        pixels = np.asarray(Image.open(tmp_path / "out" / "frames" / frame.name))
        shot, off = best_shot(pixels, taken)
        if name == "stray" and off > PICTURE:
            continue  # the flat frames between
        assert off < PICTURE
        placed = np.linalg.inv(world.similarity.viewmat(poses.viewmats[frame.name]))
        apart = np.linalg.norm(placed[:3, 3] - world.similarity.points(
            (first @ shot.c2w)[:3, 3]))
        second = "camera2" in frame.source or app.cameras == 2
        assert apart < (0.11 if second else 1e-5)
        found.append(shot.number)
        if app.up is not None:
            np.testing.assert_allclose(placed[2, :3], shot.c2w[2, :3], atol=1e-5)  # heights of axes
        lens = listed.groups[frame.group].lens
        assert (lens.width, lens.height) == pixels.shape[1::-1]
    assert set(found) == {shot.number for shot in taken}


@pytest.mark.integration
@pytest.mark.parametrize("name", [name for name, app in APPS.items() if app.depth])
def test_depth_is_stored_at_the_size_of_the_sensor(name, frames, tmp_path):
    APPS[name].write(tmp_path / "capture", frames)
    summary = take(tmp_path / "capture", tmp_path / "out")
    maps, listed = read_depth_list(tmp_path / "out"), read_frame_list(tmp_path / "out")
    pictures = {frame.name for frame in listed.frames if name != "stray" or int(
        frame.name.split(".")[0]) % 3 == 0}
    assert set(maps) == pictures
    assert summary.points > 100
    for frame, record in maps.items():
        depth, levels = read_depth(tmp_path / "out", frame, record)
        assert depth.shape == (record.lens.height, record.lens.width)
        assert record.reliable == 5
        assert record.confidence == (levels is not None)
        lens = listed.groups[next(
            one.group for one in listed.frames if one.name == frame)].lens
        assert record.lens.params[0] / record.lens.width == pytest.approx(
            lens.params[0] / lens.width, rel=1e-9)
        shot = min(frames, key=lambda one, depth=depth: abs(
            np.median(depth) - np.median(one.depth)))
        # NeRFCapture's is enlarged by a factor that is not whole, which moves the median.
        assert np.median(depth) == pytest.approx(np.median(shot.depth), abs=1e-2)


@pytest.mark.integration
def test_a_packed_recording_gives_what_the_folder_gives(frames, tmp_path):
    APPS["r3d"].write(tmp_path / "folder", frames)
    take(tmp_path / "folder", tmp_path / "one")
    for name in ("walk.r3d", "walk.zip"):
        take(pack(tmp_path / name, frames), tmp_path / name.replace(".", "-"))
        out = tmp_path / name.replace(".", "-")
        assert (out / POSES).read_bytes() == (tmp_path / "one" / POSES).read_bytes()
        assert not (out / "unpacked").exists()
        for path in (tmp_path / "one" / "depth").iterdir():
            assert (out / "depth" / path.name).read_bytes() == path.read_bytes()


@pytest.mark.integration
def test_fewer_frames_of_a_video_are_still_those_of_their_rows(shared_data, tmp_path):
    frames = shots(shared_data / "rooms" / "office")
    stray(tmp_path / "walk", frames, between=1)
    take(tmp_path / "walk", tmp_path / "out", config=IngestConfig(frames=4))
    poses = read_poses(tmp_path / "out" / POSES)
    assert len(poses.viewmats) == 4
    for name, viewmat in poses.viewmats.items():
        pixels = np.asarray(Image.open(tmp_path / "out" / "frames" / name))
        shot, off = best_shot(pixels, frames)
        assert off < PICTURE
        assert int(name.split(".")[0]) == shot.number
        center = np.linalg.inv(viewmat)[:3, 3]
        np.testing.assert_allclose(center, (APPS["stray"].world @ shot.c2w)[:3, 3], atol=1e-5)


def test_the_rim_of_undistorted_pictures_is_masked(frames, tmp_path):
    APPS["polycam"].write(tmp_path / "capture", frames)
    take(tmp_path / "capture", tmp_path / "out")
    for frame in read_frame_list(tmp_path / "out").frames:
        mask = np.asarray(Image.open(tmp_path / "out" / "masks" / frame.name))
        assert mask.shape[0] == 170  # of which 2% are 4 pixels; of 768 they would be 15
        assert not mask[:4].any()
        assert not mask[:, -4:].any()
        assert mask[4:-4, 4:-4].all()
