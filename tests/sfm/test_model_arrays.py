"""A model as arrays, against what pycolmap says of each image and point."""

import numpy as np
import pytest
from made_model import walk

from recon_cli.sfm.model_arrays import ModelArrays, registered_images


@pytest.fixture(scope="module")
def model():
    found = walk(300).model()
    found.delete_point3D(sorted(found.points3D)[7])  # numbers have a gap
    found.deregister_frame(found.find_image_with_name(walk().names[3]).frame_id)
    return found


@pytest.mark.parametrize("backwards", [False, True])
def test_arrays_say_of_each_image_what_the_model_says(model, backwards):
    names = sorted((image.name for image in registered_images(model)), reverse=backwards)
    arrays = ModelArrays.from_model(model, names if backwards else None)
    assert arrays.names == tuple(names)
    assert walk().names[3] not in names
    numbers = sorted(model.points3D)
    np.testing.assert_array_equal(arrays.points, [model.point3D(i).xyz for i in numbers])
    total = 0
    for row, name in enumerate(names):
        image, own = model.find_image_with_name(name), arrays.observed(row)
        np.testing.assert_array_equal(arrays.centers[row], image.projection_center())
        np.testing.assert_array_equal(arrays.viewmats[row, :3], image.cam_from_world().matrix())
        seen = [(at, numbers.index(spot.point3D_id), *spot.xy)
                for at, spot in enumerate(image.points2D) if spot.has_point3D()]
        np.testing.assert_array_equal(np.column_stack(
            [arrays.keypoint[own], arrays.point[own], arrays.xy[own]]), seen)
        points = [model.point3D(numbers[point]).xyz for _, point, *_ in seen]
        np.testing.assert_allclose(
            arrays.depths(row), [(image.cam_from_world() * xyz)[2] for xyz in points], rtol=1e-12)
        total += len(seen)
    assert total == len(arrays.image) == len(arrays.point) > 1000


def test_a_model_without_points_or_images_has_empty_arrays(model):
    bare = type(model)(model)
    bare.delete_all_points2D_and_points3D()
    arrays = ModelArrays.from_model(bare)
    assert len(arrays.images) > 0
    assert arrays.points.shape == (0, 3)
    assert arrays.xy.shape == (0, 2)
    assert arrays.depths(0).shape == (0,)
    assert arrays.observed(0) == slice(0, 0)
    assert ModelArrays.from_model(type(model)()).viewmats.shape == (0, 4, 4)
