import numpy as np
import pycolmap
import pytest

from recon_cli.sfm.pairs import exhaustive, similar

GROUPS, EACH = 4, 5


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """Twenty images of four places: each place has its own kinds of descriptors."""
    noise = np.random.default_rng(0)
    path = tmp_path_factory.mktemp("retrieval") / "database.db"
    kinds = noise.integers(0, 256, (GROUPS, 30, 128))
    with pycolmap.Database.open(path) as opened:
        camera = opened.write_camera(pycolmap.Camera(
            model="PINHOLE", width=8, height=6, params=[5, 5, 4, 3]))
        for index in range(GROUPS * EACH):
            image = opened.write_image(pycolmap.Image(name=f"{index:02d}.png", camera_id=camera))
            rows = kinds[index % GROUPS][noise.integers(0, 30, 200)]
            rows = np.clip(rows + noise.normal(scale=10, size=rows.shape), 0, 255)
            opened.write_keypoints(image, noise.random((200, 6)).astype(np.float32))
            opened.write_descriptors(image, pycolmap.FeatureDescriptors(
                type=pycolmap.FeatureExtractorType.SIFT, data=rows.astype(np.uint8)))
        bare = opened.write_image(pycolmap.Image(name="bare.png", camera_id=camera))
        opened.write_keypoints(bare, np.zeros((0, 6), np.float32))
        opened.write_descriptors(bare, pycolmap.FeatureDescriptors(
            type=pycolmap.FeatureExtractorType.SIFT, data=np.zeros((0, 128), np.uint8)))
    return path


NAMES = [f"{index:02d}.png" for index in range(GROUPS * EACH)]


def test_images_of_one_place_are_paired(database):
    found = similar(database, NAMES, seed=0, nearest=EACH - 1)
    assert found == {
        (one, two) for one in NAMES for two in NAMES
        if one < two and int(one[:2]) % GROUPS == int(two[:2]) % GROUPS}


def test_pairs_that_are_known_make_room_for_others(database):
    known = {("00.png", "04.png"), ("00.png", "08.png")}
    found = similar(database, NAMES, seed=0, nearest=2, besides=known)
    assert not found & known
    assert {("00.png", "12.png"), ("00.png", "16.png")} <= found


def test_where_all_pairs_are_known_nothing_is_left(database):
    assert similar(database, NAMES, seed=0, besides=exhaustive(NAMES)) == set()


def test_the_same_pairs_come_out_every_time(database):
    assert similar(database, NAMES, seed=3) == similar(database, NAMES[::-1], seed=3)


def test_an_image_without_features_does_no_harm(database):
    found = similar(database, [*NAMES, "bare.png"], seed=0, nearest=EACH - 1)
    assert found >= similar(database, NAMES, seed=0, nearest=EACH - 1) - {
        pair for pair in found if "bare.png" in pair}
