"""Features of panoramas do not depend on where the seam lies."""

import cv2
import numpy as np
import pytest
from panoramas import make_panoramas
from sfm_inputs import texture

from recon_cli.io.images import write_png
from recon_cli.scene.faces import panorama_pixels, panorama_rays
from recon_cli.sfm.features.features import find_on_faces

WIDTH, HEIGHT = 512, 256


@pytest.fixture(scope="module")
def job(tmp_path_factory):
    """A panorama of a box with textured walls, and the same turned by a quarter."""
    job, _ = make_panoramas(tmp_path_factory.mktemp("features"), frames=3)
    walls = [np.asarray(texture(200, 200, seed)) for seed in range(6)]
    rays = panorama_rays(WIDTH, HEIGHT)
    axis = np.abs(rays).argmax(axis=2)
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for wall, image in enumerate(walls):
        own = (axis == wall % 3) & ((np.take_along_axis(
            rays, axis[..., None], 2)[..., 0] > 0) == (wall < 3))
        others = [k for k in range(3) if k != wall % 3]
        places = 100 + 99 * rays[..., others] / np.abs(rays[..., [wall % 3]])
        drawn = cv2.remap(image, places.astype(np.float32), None, cv2.INTER_LINEAR)
        picture[own] = drawn[own]
    write_png(job.frames / "a.png", picture)
    write_png(job.frames / "b.png", np.roll(picture, WIDTH // 4, axis=1))
    return job


@pytest.mark.integration
def test_a_turned_panorama_has_the_same_features_in_turned_places(job):
    (ours, descriptors), (theirs, others) = (find_on_faces(job, name) for name in (
        "a.png", "b.png"))
    assert len(ours) > 300
    turned = np.column_stack([(ours[:, 0] + WIDTH / 4) % WIDTH, ours[:, 1]])
    distances = np.linalg.norm(turned[:, None] - theirs[None, :, :2], axis=2)
    nearest = distances.argmin(axis=1)
    level = np.abs(ours[:, 1] - HEIGHT / 2) < HEIGHT / 8
    found = distances.min(axis=1) < 0.1
    assert found[level].mean() > 0.98  # each face is now another one
    same = (descriptors[level & found].astype(int) - others[nearest[level & found]]).astype(int)
    assert np.median(np.abs(same).max(axis=1)) <= 2


@pytest.mark.integration
def test_features_lie_on_the_panorama_and_the_coarsest_are_kept(job):
    keypoints, _ = find_on_faces(job, "a.png")
    assert (keypoints[:, 0] >= 0).all()
    assert (keypoints[:, 0] <= WIDTH).all()
    assert (keypoints[:, 1] >= 0).all()
    assert (keypoints[:, 1] <= HEIGHT).all()
    sizes = np.hypot(keypoints[:, 2], keypoints[:, 4])
    assert (np.diff(sizes) <= 1e-4).all()
    up = panorama_pixels(np.array([[0, -1.0, 0.2]]), WIDTH, HEIGHT)[0, 1]
    assert (keypoints[:, 1] < up).any()  # near the pole, too
