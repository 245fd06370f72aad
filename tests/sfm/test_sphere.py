"""Matches in panoramas: closed forms, and cameras whose truth is known."""

import numpy as np
import pycolmap
import pytest
from facts import assert_facts
from panoramas import HEIGHT, WIDTH, make_panoramas
from scipy.spatial.transform import Rotation

from recon_cli.sfm.features.sphere import epipolar_errors, radian_px, ray_frames, unit_rays
from recon_cli.sfm.verdict import floor_heights
from recon_cli.sfm.verdict.evidence import explained_matches, gather_evidence
from recon_cli.sfm.verdict.scale_drift import find_weakest_scale
from recon_cli.sfm.verdict.verdict import examine


def random_rays(count, seed=0):
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def test_a_frame_turns_its_ray_onto_z():
    rays = random_rays(40)
    frames = ray_frames(rays)
    np.testing.assert_allclose(np.einsum("mij,mj->mi", frames, rays), [[0, 0, 1]] * 40, atol=1e-12)
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), [np.eye(3)] * 40, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1)


def test_rays_of_one_point_lie_in_a_plane_with_both_cameras_and_others_beside_it():
    points = 5 * random_rays(30)
    motion = pycolmap.Rigid3d(
        pycolmap.Rotation3d(Rotation.from_rotvec([0.3, -2.0, 0.5]).as_quat()), [0.4, 0.1, -0.7])
    ours, theirs = (rays / np.linalg.norm(rays, axis=1, keepdims=True)
                    for rays in (points, np.asarray(motion * points)))
    assert epipolar_errors(ours, theirs, motion).max() < 1e-12
    # turned away from the plane by a small angle: half of it on either side
    normal = np.cross(theirs, motion.translation)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    off = theirs + 0.002 * normal
    off /= np.linalg.norm(off, axis=1, keepdims=True)
    errors = epipolar_errors(ours, off, motion)
    assert errors.max() <= 0.002 + 1e-6
    assert np.median(errors) == pytest.approx(0.0014, rel=0.1)


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    return make_panoramas(tmp_path_factory.mktemp("panoramas"))


def test_true_cameras_explain_their_matches_all_around(captured):
    job, model = captured
    evidence = gather_evidence(model, job.database, job.names)
    assert evidence.agreeing.sum() == evidence.explained.sum() == evidence.matches.sum()
    assert (evidence.depths > 0).all()


def test_a_match_is_explained_by_a_point_in_any_direction_but_not_behind(captured):
    _, model = captured
    first, second = (model.image(i) for i in sorted(model.reg_image_ids())[:2])
    shown = [(a.xy, b.xy) for a in first.points2D for b in second.points2D
             if a.has_point3D() and a.point3D_id == b.point3D_id]
    ours, theirs = np.array(shown).transpose(1, 0, 2)
    rays = unit_rays(first.camera, ours)
    assert (rays[:, 2] < 0).any()  # behind a pinhole camera
    assert explained_matches(first, ours, second, theirs, 0.0, 3.0).all()
    opposite = np.column_stack([(theirs[:, 0] + WIDTH / 2) % WIDTH, HEIGHT - theirs[:, 1]])
    assert not explained_matches(first, ours, second, opposite, 0.0, 3.0).any()
    aside = theirs + np.array([0.0, 20.0])
    assert explained_matches(first, ours, second, aside, 0.0, 3.0).mean() < 0.5


def test_a_radian_of_a_panorama_has_its_share_of_the_width(captured):
    _, model = captured
    assert radian_px(next(iter(model.cameras.values()))) == WIDTH / (2 * np.pi)


def test_true_panoramas_are_trusted(captured):
    job, model = captured
    verdict = examine(model, job.database, job.names)
    assert verdict.trusted, verdict.problems


@pytest.mark.integration
def test_panoramas_in_wrong_places_are_not(captured):
    job, model = captured
    broken = pycolmap.Reconstruction(model)
    numbers = sorted(broken.reg_image_ids())
    for number in numbers[:5]:  # a part that is turned and shifted against the rest
        image = broken.image(number)
        pose = image.cam_from_world() * pycolmap.Rigid3d(
            pycolmap.Rotation3d(Rotation.from_rotvec([0, 0.6, 0]).as_quat()), [2.0, 0, 1.0])
        broken.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
    verdict = examine(broken, job.database, job.names)
    assert not verdict.trusted


@pytest.mark.integration
def test_the_scale_of_a_walk_is_known_the_worse_the_less_exact_its_places_are(tmp_path):
    errors = []
    for noise_px in (0.3, 0.6):
        folder = tmp_path / str(noise_px)
        folder.mkdir()
        job, model = make_panoramas(folder, frames=40, noise_px=noise_px)
        evidence = gather_evidence(model, job.database, job.names)
        cut = find_weakest_scale(model, evidence, np.arange(len(job.names)))
        assert cut is not None
        errors.append(cut.error)
    assert 0 < errors[0] < 0.02
    assert errors[1] == pytest.approx(2 * errors[0], rel=0.2)


def joined_by_a_hinge(model, common):
    """The model with points that the panoramas on one side of the sixth see alone, but for some."""
    joined = pycolmap.Reconstruction(model)
    for place, number in enumerate(sorted(joined.points3D)):
        if place < common:
            continue
        hidden = range(7, 13) if place % 2 else range(1, 6)
        seen = [(element.image_id, element.point2D_idx)
                for element in joined.point3D(number).track.elements]
        for image, spot in seen:
            if image in hidden:
                joined.delete_observation(image, spot)
    return joined


def test_two_groups_that_meet_in_one_panorama_have_scales_of_their_own(captured, monkeypatch):
    job, model = captured
    monkeypatch.setattr(floor_heights, "LEVEL_DEG", -1.0)  # as if the camera leant
    monkeypatch.setattr(floor_heights, "find_floor", lambda *_, **__: None)
    verdict = examine(joined_by_a_hinge(model, 0), job.database, job.names)
    assert verdict.scale is not None
    assert verdict.scale.error > 1
    smaller, larger = verdict.scale.sides
    assert smaller in (job.names[:5], job.names[6:]), "the sixth joins them"
    assert sorted(smaller + larger) == list(job.names)
    assert_facts("\n".join(verdict.problems), "side", "cut")


@pytest.mark.integration
def test_floor_and_ceiling_give_both_groups_one_scale(captured):
    job, model = captured
    joined = joined_by_a_hinge(model, 0)
    scale = find_weakest_scale(joined, gather_evidence(joined, job.database, job.names))
    assert scale.error < 0.05
    assert scale.off < 0.05


@pytest.mark.integration
def test_points_that_both_groups_see_give_them_one_scale(captured):
    job, model = captured
    verdict = examine(joined_by_a_hinge(model, 12), job.database, job.names)
    assert verdict.scale is not None
    assert verdict.scale.error < 0.05
    more = examine(joined_by_a_hinge(model, 100), job.database, job.names)
    assert more.scale.error < verdict.scale.error
