"""An export as the readers of other trainers open it; what they do is written here anew.

Facts from gaussian-splatting/scene/dataset_readers.py and colmap_loader.py (INRIA),
gsplat/examples/datasets/colmap.py, and nerfstudio's nerfstudio_dataparser.py.
"""

from __future__ import annotations

import json
import os
import struct

import numpy as np
import pycolmap
import pytest
import trimesh
from PIL import Image
from tiny_stages import CONTEXT, run_export

from recon_cli.config.export import ExportConfig
from recon_cli.io.colmap import read_images, read_points

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def out(tiny_learnt, tmp_path_factory):
    """An export with cameras, turned, so that a frame that is mixed up shows."""
    folder = tmp_path_factory.mktemp("export")
    run_export(ExportConfig(format="colmap,transforms.json", up="y"), tiny_learnt, folder, CONTEXT)
    return folder


def test_the_reader_of_inria_finds_cameras_images_and_points(out):
    cameras = {}
    with (out / "sparse/0/cameras.bin").open("rb") as file:
        for _ in range(struct.unpack("<Q", file.read(8))[0]):
            number, model, width, height = struct.unpack("<iiQQ", file.read(24))
            assert model == 1  # PINHOLE: INRIA's refuses all but it and SIMPLE_PINHOLE
            cameras[number] = width, height, struct.unpack("<4d", file.read(32))
    names = []
    with (out / "sparse/0/images.bin").open("rb") as file:
        for _ in range(struct.unpack("<Q", file.read(8))[0]):
            *_, camera = struct.unpack("<idddddddi", file.read(64))
            name = b"".join(iter(lambda: file.read(1), b"\0")).decode()
            (observations,) = struct.unpack("<Q", file.read(8))
            file.read(24 * observations)
            # by the last part of the name alone
            with Image.open(out / "images" / os.path.basename(name)) as image:
                assert image.size == cameras[camera][:2]
            names.append(name)
    with (out / "sparse/0/points3D.bin").open("rb") as file:
        count = struct.unpack("<Q", file.read(8))[0]
        for _ in range(count):
            struct.unpack("<QdddBBBd", file.read(43))
            file.read(8 * struct.unpack("<Q", file.read(8))[0])
        assert not file.read()
    assert len(set(names)) == len(names) == 12
    assert count > 0


def test_the_reader_of_gsplat_pairs_each_camera_with_its_image(out):
    model = pycolmap.Reconstruction(str(out / "sparse/0/"))
    files = sorted(os.path.relpath(os.path.join(folder, name), out / "images")
                   for folder, _, names in os.walk(out / "images") for name in names)
    assert files == sorted(image.name for image in model.images.values())
    for image in model.images.values():
        assert model.cameras[image.camera_id].model == pycolmap.CameraModelId.PINHOLE
        assert image.cam_from_world().matrix().shape == (3, 4)
    assert all(np.isfinite(point.xyz).all() for point in model.points3D.values())


def test_colmap_reads_places_and_gravity_as_priors(out):
    viewmats = {name: viewmat
                for name, _, viewmat in read_images(out / "sparse" / "0" / "images.bin")}
    with pycolmap.Database.open(str(out / "database.db")) as database:
        images = {image.image_id: image.name for image in database.read_all_images()}
        assert set(images.values()) == viewmats.keys()
        assert database.num_frames() == len(images)
        priors = database.read_all_pose_priors()
    assert {images[prior.corr_data_id.id] for prior in priors} == viewmats.keys()
    for prior in priors:
        viewmat = viewmats[images[prior.corr_data_id.id]]
        np.testing.assert_allclose(
            prior.position, -viewmat[:3, :3].T @ viewmat[:3, 3], atol=1e-9)
        assert prior.coordinate_system == pycolmap.PosePriorCoordinateSystem.CARTESIAN
        if prior.has_gravity():  # down; the export has y up
            np.testing.assert_allclose(
                viewmat[:3, :3].T @ np.ravel(prior.gravity), [0, -1, 0], atol=1e-9)


def test_the_reader_of_nerfstudio_starts_from_the_points_of_the_same_world(out):
    meta = json.loads((out / "transforms.json").read_text())
    cloud = trimesh.load(out / meta["ply_file_path"])
    points, colors = read_points(out / "sparse" / "0" / "points3D.bin")
    assert np.allclose(cloud.vertices, points, atol=1e-5)
    assert np.array_equal(np.asarray(cloud.colors)[:, :3], colors)
    viewmats = {f"images/{name}": viewmat
                for name, _, viewmat in read_images(out / "sparse" / "0" / "images.bin")}
    assert {frame["file_path"] for frame in meta["frames"]} == viewmats.keys()
    for frame in meta["frames"]:
        pose = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])  # from OpenGL's axes
        assert np.allclose(np.linalg.inv(pose), viewmats[frame["file_path"]], atol=1e-9)
        assert (out / frame["file_path"]).is_file()
    assert "applied_transform" not in meta  # it would be undone
