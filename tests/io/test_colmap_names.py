import numpy as np
import posed_sets
import pytest
from facts import assert_facts, raises
from PIL import Image

from recon_cli.datasets.colmap import read_colmap
from recon_cli.errors import FormatError

COUNT = 6


def texture(points):
    """Returns RGB colours that change over the plane."""
    x, y = points[..., 0], points[..., 1]
    waves = np.stack([np.sin(7 * x + y), np.sin(5 * y - 2 * x), np.cos(4 * x + 3 * y)], axis=-1)
    return np.rint(127.5 + 127.5 * waves).astype(np.uint8)


def render(c2w):
    """Returns the image of the plane in a pinhole camera."""
    depth = posed_sets.plane_depth(c2w)
    x, y = np.meshgrid(np.arange(posed_sets.WIDTH) + 0.5 - posed_sets.CX,
                       np.arange(posed_sets.HEIGHT) + 0.5 - posed_sets.CY)
    rays = np.stack([x / posed_sets.FOCAL, y / posed_sets.FOCAL, np.ones_like(x)], axis=-1)
    return texture((rays * depth[..., None]) @ c2w[:3, :3].T + c2w[:3, 3])


def place(index):
    c2w = np.eye(4)
    c2w[:3, 3] = [0.3 * index, 0.05, -0.2]
    return c2w


@pytest.fixture
def folder(tmp_path):
    """A text model with rigs and frames, but without images.txt."""
    sparse = tmp_path / "sparse"
    sparse.mkdir()
    (tmp_path / "images").mkdir()
    (sparse / "cameras.txt").write_text("1 SIMPLE_PINHOLE 32 24 30 16.5 11\n")
    (sparse / "rigs.txt").write_text("1 1 CAMERA 1\n")
    frames = []
    for index in range(COUNT):
        x, y, z = -place(index)[:3, 3]
        frames.append(f"{index + 1} 1 1 0 0 0 {x} {y} {z} 1 CAMERA 1 {index + 1}\n")
        Image.fromarray(render(place(index))).save(tmp_path / "images" / f"{index}.png")
    (sparse / "frames.txt").write_text("".join(frames))
    grid = np.stack(np.meshgrid(np.linspace(-3, 5, 60), np.linspace(-3, 3, 60)), -1).reshape(-1, 2)
    z = (posed_sets.OFFSET - grid @ posed_sets.NORMAL[:2]) / posed_sets.NORMAL[2]
    points = np.column_stack([grid, z])
    (sparse / "points3D.txt").write_text("".join(
        f"{at} {x} {y} {z} {r} {g} {b} 0.5\n"
        for at, ((x, y, z), (r, g, b)) in enumerate(zip(points, texture(points), strict=True))))
    return tmp_path


def test_images_without_names_are_taken_in_their_order_where_the_colours_agree(folder):
    posed = read_colmap(folder)
    assert [image.name for image in posed.images] == [f"{index}.png" for index in range(COUNT)]
    for index, image in enumerate(posed.images):
        np.testing.assert_allclose(image.viewmat @ place(index), np.eye(4), atol=1e-12)
    assert_facts(posed.notices[0], "colours", "agree")


def test_images_in_another_order_are_refused(folder):
    images = folder / "images"
    for index in range(COUNT):
        (images / f"{index}.png").rename(images / f"b{(index + 2) % COUNT}.png")
    with raises(FormatError, "images.bin", "images.txt"):
        read_colmap(folder)


def test_another_number_of_images_is_refused(folder):
    (folder / "images" / "3.png").unlink()
    with raises(FormatError, 6, "images"):
        read_colmap(folder)


def test_without_points_nothing_proves_the_order(folder):
    (folder / "sparse" / "points3D.txt").unlink()
    with raises(FormatError, 6, "images"):
        read_colmap(folder)


@pytest.mark.integration
def test_a_real_model_without_names_is_read(shared_data):
    posed = read_colmap(shared_data / "desk_monitors")
    assert len(posed.images) == 70
    assert posed.points.shape == (21444, 3)
    assert posed.images[0].name == "frame_0001.jpg"
