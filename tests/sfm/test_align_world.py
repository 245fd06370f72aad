"""The world frame of a model: up, floor, walls and scale."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from facts import assert_facts, raises
from rooms import degrees_between, make_room
from scipy.spatial.transform import Rotation
from synthetic import make_capture, place_job
from test_similarity import random_similarity

from recon_cli.errors import ConfigError, SfmError
from recon_cli.room.scale import ScaleBetween
from recon_cli.room.scale_fusion import ScaleSource
from recon_cli.scene.similarity import Similarity
from recon_cli.sfm.poses.align_world import WorldFrame, refuse_contradiction, world_transform
from recon_cli.sfm.segments.shared_points import to_sim3d
from recon_cli.sfm.views import undistort


def world_of(room, *, gravity=True, between=None, metric=False) -> WorldFrame:
    return world_transform(
        room.points, room.named(), level_views=room.viewmats if gravity else None,
        scale_between=between, metric=metric)


def distance(room, a: str, b: str) -> float:
    """Metres between two cameras."""
    centers = [np.linalg.inv(room.named()[name])[:3, 3] for name in (a, b)]
    return room.truth.scale * float(np.linalg.norm(centers[0] - centers[1]))


A, B = "000000.png", "000025.png"


def test_a_room_with_a_known_distance_comes_out_upright_in_metres_with_the_floor_at_0():
    room = make_room()
    world = world_of(room, between=ScaleBetween(A, B, distance(room, A, B)))
    assert world.similarity.scale == pytest.approx(room.truth.scale, rel=1e-9)
    into_room = room.truth.after(world.similarity.inverse())  # a turn about z and a shift, no more
    assert into_room.scale == pytest.approx(1)
    assert degrees_between(into_room.rotation[2], np.array([0, 0, 1.0])) < 0.15
    assert abs(into_room.points(np.zeros(3))[2]) < 0.01
    assert world.evidence.up_found
    assert world.evidence.floor_found
    assert world.evidence.axis == "walls"
    assert world.evidence.scale_source == "measured"
    assert world.evidence.metres
    assert_facts(world.sentences[0], 0, "floor", "lies")
    assert_facts(world.sentences[1], A, B)


def test_everything_goes_into_json_and_the_similarity_comes_back():
    room = make_room()
    world = world_of(room, between=ScaleBetween(A, "0,0,0", 2.0))
    value = json.loads(json.dumps(world.summary().to_json(), allow_nan=False))
    back = Similarity.from_json(value["similarity"])
    assert np.array_equal(back.matrix, world.similarity.matrix)
    assert value["evidence"]["floor_share"] == world.evidence.floor_share
    assert value["measurement"]["metres"] == 2.0


def test_points_are_those_of_the_turned_scene_before_it_was_scaled():
    """What a viewer shows without --scale-between is what the user picks in."""
    room = make_room()
    turned = world_of(room).similarity
    corner = turned.points(np.linalg.inv(room.named()[A])[:3, 3])
    text = ",".join(repr(float(value)) for value in corner)
    by_point = world_of(room, between=ScaleBetween(text, B, 1.0)).similarity
    by_name = world_of(room, between=ScaleBetween(A, B, 1.0)).similarity
    assert np.allclose(by_point.matrix, by_name.matrix, atol=1e-9)


def test_without_evidence_the_frame_is_left_to_the_bit_and_the_reason_is_said():
    world = world_of(make_room(roll_deg=60.0))
    assert world.similarity.is_identity
    assert not world.evidence.up_found
    assert world.evidence.axis == "mapper"
    assert world.evidence.up_reason in world.sentences[0]
    assert "arbitrary" in world.sentences[1]


def test_with_gravity_off_only_the_scale_changes():
    room = make_room()
    assert world_of(room, gravity=False).similarity.is_identity
    world = world_of(room, gravity=False, between=ScaleBetween(A, B, distance(room, A, B)))
    assert np.array_equal(world.similarity.rotation, np.eye(3))
    assert not world.similarity.translation.any()
    assert world.similarity.scale == pytest.approx(room.truth.scale)
    assert len(world.sentences) == 1


def test_a_data_set_in_metres_keeps_its_scale_unless_something_was_measured():
    room = make_room()
    world = world_of(room, metric=True)
    assert (world.similarity.scale, world.evidence.scale_source) == (1, "data set")
    assert world.evidence.metres
    world = world_of(room, metric=True, between=ScaleBetween(A, B, distance(room, A, B)))
    assert world.evidence.scale_source == "measured"
    assert_facts(world.sentences[-1], "scale", "data")


def test_sources_of_which_none_can_be_chosen_end_it_unless_that_is_accepted():
    room = make_room()
    sources = [ScaleSource("the tracked poses", 1.0, 0.003), ScaleSource("sensor depth", 10, 0.005)]

    def world(chosen, between=None):
        return world_transform(room.points, room.named(), level_views=room.viewmats,
                               scale_between=between, metric=True, sources=chosen)

    evidence = world(sources).evidence
    assert not evidence.metres
    with raises(SfmError, 1, "tracked") as caught:
        refuse_contradiction(evidence, accepted=False)
    assert caught.value.exit_code == 5
    assert_facts(caught.value.hint, "--scale-between", "METRES")
    refuse_contradiction(evidence, accepted=True)
    for fine in (world(sources[:1]), world([]), world_of(room),
                 world(sources, ScaleBetween(A, B, 2.0))):
        refuse_contradiction(fine.evidence, accepted=False)


def test_a_room_without_a_floor_says_so():
    world = world_of(make_room(floor=False))
    assert world.evidence.up_found
    assert not world.evidence.floor_found
    assert world.evidence.floor_tilt_deg is None
    assert_facts(world.sentences[0], "floor", "seen")


@pytest.mark.parametrize(("lean_deg", "found"), [(0.5, True), (25.0, False)])
def test_level_panoramas_that_face_one_way_show_up_without_a_floor(tmp_path, lean_deg, found):
    rng = np.random.default_rng(0)
    world = Rotation.from_euler("xz", [70, 20], degrees=True)  # the mapper's frame
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(
        camera_id=1, model="EQUIRECTANGULAR", width=512, height=256, params=(512, 256)))
    for number in range(1, 9):
        lean = Rotation.from_rotvec(np.radians(lean_deg) * rng.normal(size=3))
        turn, center = (lean * world).as_matrix(), rng.normal(size=3)
        model.add_image_with_trivial_frame(
            pycolmap.Image(image_id=number, name=f"{number}.png", camera_id=1),
            pycolmap.Rigid3d(np.column_stack([turn, -turn @ center])))
    for place in rng.normal(size=(200, 3)):
        model.add_point3D(place, pycolmap.Track(), np.zeros(3, np.uint8))
    job, _ = make_capture(tmp_path, frames=3)
    placed = undistort.place_model(place_job(job), model, None)
    assert placed.evidence.up_found == found
    up = -Similarity.from_json(placed.similarity).rotation @ world.inv().as_matrix()[:, 1]
    assert (degrees_between(up, np.array([0, 0, 1.0])) < 1) == found


def test_a_frame_that_does_not_exist_stops_it():
    with pytest.raises(ConfigError):
        world_of(make_room(), between=ScaleBetween("x.png", B, 1.0))


# The rooms are rendered, so that their z axis is the truth. Their points come from the depth maps,
# with half a percent of noise, and lie on bare walls too, where structure from motion finds none.
@pytest.mark.parametrize("name", ["office", "living"])
def test_a_rendered_room_comes_out_upright(shared_data: Path, name: str):
    room = _rendered(shared_data / "rooms" / name, Similarity(0.3, _turn(), np.array([1., 2, 3])))
    points, viewmats, truth = room
    world = world_transform(
        points, viewmats, level_views=np.array(list(viewmats.values())), scale_between=None,
        metric=False)
    assert world.evidence.floor_found
    into_room = truth.after(world.similarity.inverse())
    # Measured: 0.016 and 0.011 degrees, 2 and 4 mm.
    assert degrees_between(into_room.rotation[2], np.array([0, 0, 1.0])) < 0.1
    assert abs(into_room.points(np.zeros(3))[2]) < 0.01


def _turn() -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def _rendered(folder: Path, truth: Similarity):
    """Returns points, cameras by name and their frame's truth of a room in the Replica layout."""
    image = pytest.importorskip("PIL.Image")
    rng = np.random.default_rng(0)
    poses = np.loadtxt(folder / "traj.txt").reshape(-1, 4, 4)
    inner = json.loads((folder / "cam_params.json").read_text())["camera"]
    back, points, viewmats = truth.inverse(), [], {}
    for frame in range(0, len(poses), 5):
        path = folder / "results" / f"depth{frame:06d}.png"
        if not path.exists():
            continue
        depth = np.asarray(image.open(path)) / inner["scale"]
        rows, columns = rng.integers(0, depth.shape[0], 300), rng.integers(0, depth.shape[1], 300)
        z = depth[rows, columns] * rng.normal(1, 0.005, 300)
        seen = np.stack([(columns - inner["cx"]) / inner["fx"] * z,
                         (rows - inner["cy"]) / inner["fy"] * z, z], axis=1)[z > 0]
        points.append(seen @ poses[frame, :3, :3].T + poses[frame, :3, 3])
        viewmats[path.name] = back.viewmat(np.linalg.inv(poses[frame]))
    return back.points(np.concatenate(points)), viewmats, truth


def residuals(model: pycolmap.Reconstruction) -> np.ndarray:
    """The offset of each observation from its projected point, in pixels."""
    found = []
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        for seen in image.points2D:
            if seen.has_point3D():
                xyz = model.point3D(seen.point3D_id).xyz
                found.append(image.project_point(xyz) - seen.xy)
    return np.array(found)


def test_every_observation_keeps_its_error_and_the_model_can_be_saved(tmp_path):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 5, 40
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.8
    pycolmap.synthesize_noise(noise, model)
    similarity = random_similarity(1)
    before = residuals(model)
    centers = {i: model.image(i).projection_center() for i in model.reg_image_ids()}
    points = {i: point.xyz.copy() for i, point in model.points3D.items()}
    model.transform(to_sim3d(similarity))
    assert np.abs(before).max() > 0.1
    assert np.allclose(residuals(model), before, rtol=0, atol=1e-8)
    for i, center in centers.items():
        moved = model.image(i).projection_center()
        assert np.allclose(moved, similarity.points(center), atol=1e-9)
    for i, xyz in points.items():
        assert np.allclose(model.point3D(i).xyz, similarity.points(xyz), atol=1e-9)
    model.write(tmp_path)
    assert np.allclose(residuals(pycolmap.Reconstruction(tmp_path)), before, atol=1e-8)
