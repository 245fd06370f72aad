import numpy as np
import pycolmap
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation
from synthetic import make_capture

from recon_cli.io.depth_maps import read_depth, write_depth, write_depth_list
from recon_cli.scene.camera import Lens
from recon_cli.sfm.poses.scale_evidence import scale_from_depth, scale_from_poses, up_from_poses

FRAMES = 120


def walk(seed=0):
    """World to camera of a walk round a room, [N, 4, 4]: up to 10 cm and 3 degrees a frame."""
    angle = np.linspace(0, 2 * np.pi, FRAMES)
    noise = np.random.default_rng(seed)
    views = np.tile(np.eye(4), (FRAMES, 1, 1))
    views[:, :3, :3] = (Rotation.from_euler("y", -angle[:, None]) * Rotation.from_rotvec(
        noise.normal(scale=0.02, size=(FRAMES, 3)))).as_matrix()
    centers = np.column_stack([2 * np.cos(angle), 0.1 * np.sin(5 * angle), 1.5 * np.sin(angle)])
    views[:, :3, 3] = -np.einsum("nij,nj->ni", views[:, :3, :3], centers)
    return views


def drifted(views, seed=0, metres=0.02, degrees=1.0):
    """The same with a smooth random walk, so far off at the end."""
    noise = np.random.default_rng(seed)

    def drift(end):
        way = np.cumsum(gaussian_filter1d(noise.normal(size=(FRAMES, 3)), 5, axis=0), axis=0)
        return (way - way[0]) * end / np.linalg.norm(way[-1] - way[0])

    poses = np.linalg.inv(views)
    poses[:, :3, :3] = Rotation.from_rotvec(
        drift(np.radians(degrees))).as_matrix() @ poses[:, :3, :3]
    poses[:, :3, 3] += drift(metres)
    return np.linalg.inv(poses)


def named(views):
    return {f"{index:06d}.png": view for index, view in enumerate(views)}


def scaled(views, factor):
    """The same cameras in units `factor` times as long, elsewhere and turned."""
    turn = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()
    poses = np.linalg.inv(views)
    poses[:, :3, 3] /= factor
    poses[:, :3, :] = turn @ poses[:, :3, :]
    poses[:, :3, 3] += (3, -2, 1)
    return np.linalg.inv(poses)


@pytest.mark.parametrize("seed", range(8))
def test_the_scale_of_drifted_poses_lies_in_its_interval(seed):
    views = walk()
    source = scale_from_poses(named(scaled(views, 2.5)), named(drifted(views, seed)))
    assert abs(source.scale / 2.5 - 1) < 1.96 * source.error
    assert abs(source.scale / 2.5 - 1) < 0.004
    assert source.error < 0.01


def test_a_jump_of_the_tracking_does_not_change_the_scale():
    views = walk()
    tracked = views.copy()
    jump = np.eye(4)
    jump[:3, 3] = 0.3
    tracked[50:] = tracked[50:] @ jump
    source = scale_from_poses(named(scaled(views, 2.5)), named(tracked))
    assert source.scale == pytest.approx(2.5, rel=0.004)


def test_poses_of_another_walk_give_no_scale():
    views = walk()
    reversed_turns = np.linalg.inv(views)
    reversed_turns[:, :3, :3] = walk(1)[::-1, :3, :3] @ Rotation.from_euler(
        "x", np.linspace(0, 4, FRAMES)[:, None]).as_matrix()
    assert scale_from_poses(named(views), named(np.linalg.inv(reversed_turns))) is None
    shuffled = np.random.default_rng(0).permutation(FRAMES)
    assert scale_from_poses(named(views), named(views[shuffled])) is None


def test_few_frames_give_no_scale():
    views = walk()
    assert scale_from_poses(named(views[:9]), named(views[:9])) is None


def test_up_is_that_of_the_device_whatever_the_frame_of_the_model():
    views = walk()
    turn = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()
    tracked = drifted(views)
    up = up_from_poses(named(scaled(views, 2.0)), named(tracked), (0.0, 1.0, 0.0))
    angle = np.arccos(np.clip(turn @ [0, 1, 0] @ np.array(up), -1, 1))
    off = Rotation.from_matrix(views[:, :3, :3].transpose(0, 2, 1) @ tracked[:, :3, :3])
    assert angle < off.magnitude().max()  # as far as the poses drift


def test_up_is_unknown_where_the_frames_disagree():
    views = walk()
    others = views[np.random.default_rng(0).permutation(FRAMES)]
    tilted = others.copy()
    tilted[:, :3, :3] = Rotation.random(FRAMES, random_state=0).as_matrix()
    assert up_from_poses(named(views), named(tilted), (0.0, 1.0, 0.0)) is None


def test_depth_tells_the_scale_at_the_points_of_a_model(tmp_path):
    """Each pixel of a map that a point falls on holds its depth, 2.5 times as long in metres."""
    _, truth = make_capture(tmp_path / "capture", frames=12)
    lens = Lens("PINHOLE", 256, 192, (320.0, 320.0, 128.0, 96.0))
    camera = pycolmap.Camera(model=lens.model, width=256, height=192, params=lens.params)
    maps = {}
    for number in truth.reg_image_ids():
        image = truth.image(number)
        depth = np.zeros((192, 256), np.float32)
        seen = [truth.point3D(p.point3D_id).xyz for p in image.points2D if p.has_point3D()]
        local = np.asarray(image.cam_from_world() * np.array(seen))
        at = np.asarray(camera.img_from_cam(local)).astype(int)
        # the nearest point of a pixel last
        for (x, y), z in sorted(
                zip(at.tolist(), local[:, 2], strict=True), key=lambda one: -one[1]):
            if 0 <= x < 256 and 0 <= y < 192:
                depth[y, x] = 2.5 * z
        maps[image.name] = write_depth(
            tmp_path, image.name, depth, lens, confidence=np.full((192, 256), 2, np.uint8))
    write_depth_list(tmp_path, maps)
    source = scale_from_depth(truth, tmp_path)
    assert source.scale == pytest.approx(2.5, rel=1e-3)
    assert source.error >= 0.005
    rng = np.random.default_rng(0)
    others = {name: write_depth(tmp_path, name, rng.uniform(0.5, 1.5, (192, 256)).astype(
        np.float32) * read_depth(tmp_path, name, one)[0], lens) for name, one in maps.items()}
    write_depth_list(tmp_path, others)
    assert scale_from_depth(truth, tmp_path) is None  # of something else
    low = {name: write_depth(tmp_path, name, np.ones((192, 256), np.float32), lens,
                             confidence=np.zeros((192, 256), np.uint8)) for name in maps}
    write_depth_list(tmp_path, low)
    assert scale_from_depth(truth, tmp_path) is None  # nothing sure
