import numpy as np
import pycolmap
import pytest

from recon_cli.mapping.mapper import triangulation_angles


def test_the_angle_of_a_point_is_that_of_its_widest_pair_of_rays():
    """Cameras at x = 0, 1 and 2 see a point one unit before the first: 0, 45 and 63.4 degrees."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=8, height=6, params=[5, 5, 4, 3]))
    track = pycolmap.Track()
    for x in range(3):
        model.add_image_with_trivial_frame(
            pycolmap.Image(
                image_id=x + 1, name=f"{x}.png", camera_id=1,
                points2D=[pycolmap.Point2D(np.zeros(2))]),
            pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-float(x), 0, 0])))
        track.add_element(x + 1, 0)
    model.add_point3D(np.array([0.0, 0, 1]), track)
    assert triangulation_angles(model) == pytest.approx([np.degrees(np.arctan(2))])
