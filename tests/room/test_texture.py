"""The texture of a mesh: painted from photos of a wall whose pattern is known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from recon_cli.io.mesh_data import Mesh, joined
from recon_cli.progress import NullProgress
from recon_cli.room import texture
from recon_cli.room.charts import make_charts
from recon_cli.room.files import write_mesh_file
from recon_cli.room.texture import add_texture, draw_mesh, fill_gaps, halve, shade_mesh, usable
from recon_cli.room.texture_kernels import COLUMNS, WEIGHT
from recon_cli.room.volume import pixel_rays
from recon_cli.scene.camera import Camera, looking_at
from recon_cli.scene.train_view import TrainView
from recon_cli.stereo.depths import camera_row

UP = np.array([0.0, 0.0, 1.0])
SIZE = 512


def camera(y: float, z: float, size: int = 160) -> Camera:
    viewmat = looking_at(np.array([0.0, y, z]), np.array([2.0, y / 2, z / 2]), UP)
    return Camera(size, size, 0.9 * size, 0.9 * size, size / 2, size / 2, viewmat)


CAMERAS = [camera(y, z) for y in (-0.5, 0.0, 0.5) for z in (-0.4, 0.0, 0.4)]


def paint_of(y, z):
    """Colours [..., 3] of the wall x = 2: waves of 25 cm, much finer than its triangles."""
    waves = [np.sin(25 * y), np.sin(25 * z), np.sin(18 * (y + z))]
    return 128 + 60 * np.stack(waves, axis=-1)


def photo(view: Camera, gain: float = 1.0, hidden: float = np.inf) -> np.ndarray:
    """The wall as a camera sees it, white where y > `hidden`."""
    rays = pixel_rays(view) @ view.viewmat[:3, :3]
    place = view.center + rays * ((2 - view.center[0]) / rays[..., 0])[..., None]
    colors = gain * paint_of(place[..., 1], place[..., 2])
    colors[place[..., 1] > hidden] = 255
    return np.rint(colors.clip(0, 255)).astype(np.uint8)


def wall(cells: int = 4, half: float = 0.8) -> Mesh:
    """A square of triangles at x = 2 that faces the cameras, gray by vertex."""
    side = np.linspace(-half, half, cells + 1)
    y, z = (grid.ravel() for grid in np.meshgrid(side, side))
    row, column = (grid.ravel() for grid in np.meshgrid(np.arange(cells), np.arange(cells)))
    a = row * (cells + 1) + column
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    vertices = np.stack([np.full(len(y), 2.0), y, z], axis=1)
    return Mesh(vertices, faces.astype(np.int64), np.full((len(y), 3), 77, np.uint8))


def render(mesh: Mesh, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """A textured mesh in a view that was not painted from, and which pixels show it."""
    drawn = draw_mesh(view, mesh.vertices, mesh.faces)
    row = np.zeros(COLUMNS)
    row[:WEIGHT] = camera_row(view)
    charts = texture.Charts(np.arange(len(mesh.vertices)), mesh.faces,
                            mesh.texture.corners * len(mesh.texture.image), 1)
    image = shade_mesh(row, mesh.vertices, charts, drawn, halve(mesh.texture.image),
                       np.zeros((view.height, view.width, 3), np.float32))
    return image, drawn.owners >= 0


def error(mesh: Mesh, view: Camera) -> float:
    image, shown = render(mesh, view)
    return float(np.abs(image - photo(view))[shown].mean())


@pytest.mark.integration
def test_a_texture_shows_what_lies_between_the_corners_of_triangles():
    views = [TrainView(view, photo(view)) for view in CAMERAS]
    mesh = add_texture(wall(), views, SIZE, "png", NullProgress())
    unseen = camera(0.25, -0.2)
    assert error(mesh, unseen) < 2.5
    flat = np.abs(photo(unseen)[render(mesh, unseen)[1]] - 128.0).mean()
    assert flat > 30  # which colours of so few corners would leave


@pytest.mark.integration
def test_photos_of_other_exposure_leave_no_seam():
    gains = np.where(np.arange(len(CAMERAS)) % 2, 0.8, 1.25)
    views = [TrainView(view, photo(view, gain)) for view, gain in zip(CAMERAS, gains, strict=True)]
    mesh = add_texture(wall(8), views, SIZE, "png", NullProgress())
    image, shown = render(mesh, camera(0.25, -0.2))
    ratio = image[shown] / photo(camera(0.25, -0.2))[shown].clip(1)
    assert np.std(ratio.mean(axis=1)) < 0.03  # the photos differ by half


def test_what_no_view_shows_keeps_the_colours_of_its_corners():
    back = wall()
    behind = Mesh(back.vertices + np.array([1.0, 0, 0]), back.faces, np.full_like(back.colors, 200))
    both = Mesh(np.concatenate([back.vertices, behind.vertices]),
                np.concatenate([back.faces, behind.faces + len(back.vertices)]),
                np.concatenate([back.colors, behind.colors]))
    views = [TrainView(view, photo(view)) for view in CAMERAS[4:5]]
    mesh = add_texture(both, views, SIZE, "png", NullProgress())
    hidden = mesh.vertices[:, 0] > 2.5
    at = np.floor(mesh.texture.corners[hidden] * SIZE).astype(int).clip(0, SIZE - 1)
    off = np.abs(mesh.texture.image[at[:, 1], at[:, 0]].astype(int) - 200)
    assert off.max() <= 4  # at the rim of a chart, rounded twice
    assert mesh.texture.image.max(axis=2).min() > 0  # nowhere black, between charts as well


def test_a_mask_keeps_pixels_out_of_the_texture():
    mask = np.ones((160, 160), bool)
    mask[:, :80] = False
    image = photo(CAMERAS[4])
    image[~mask] = (255, 0, 255)
    views = [TrainView(CAMERAS[4], image, mask),
             *(TrainView(view, photo(view)) for view in CAMERAS[:3])]
    mesh = add_texture(wall(), views, SIZE, "png", NullProgress())
    assert error(mesh, camera(0.25, -0.2)) < 4


def test_pixels_count_less_towards_an_edge_and_not_at_all_under_a_mask():
    nearness = np.full((40, 40), 0.5, np.float32)
    nearness[:, 20:] = 1.0
    mask = np.ones((40, 40), bool)
    mask[:5] = False
    quality = usable(nearness, mask)
    assert (quality[:5] == 0).all()
    assert quality[20, 10] == 255
    assert (quality[20, [0, 19, 20]] == 1).all()
    assert (np.diff(quality[20, 10:20].astype(int)) <= 0).all()
    assert (usable(np.zeros((9, 9), np.float32), None) == 0).all()


def test_gaps_take_the_colour_beside_them_and_nothing_else_changes():
    image = np.zeros((64, 64, 3), np.uint8)
    known = np.zeros((64, 64), bool)
    known[:, :20] = True
    image[known] = (200, 100, 50)
    filled = fill_gaps(image, known)
    assert np.abs(filled.astype(int) - (200, 100, 50)).max() <= 4  # rounded at each size
    assert (filled[known] == (200, 100, 50)).all()
    assert (fill_gaps(image, np.zeros_like(known)) == image).all()


@pytest.mark.parametrize("threads", [1, 3])
def test_threads_do_not_change_a_texture(monkeypatch, threads):
    monkeypatch.setattr(texture.pool, "threads", threads)
    views = [TrainView(view, photo(view)) for view in CAMERAS[:4]]
    image = add_texture(wall(), views, 128, "png", NullProgress()).texture.image
    monkeypatch.setattr(texture.pool, "threads", 2)
    assert np.array_equal(
        image, add_texture(wall(), views, 128, "png", NullProgress()).texture.image)


def test_charts_keep_every_triangle_and_lie_apart():
    sheets = [wall(6).vertices, wall(6).vertices + np.array([0.3, 0, 0])]
    faces = wall(6).faces
    # two sheets over each other that one row of triangles links: one piece must not cover itself
    link = np.array([[0, 49, 1], [1, 49, 50]])
    every = np.concatenate([faces, faces + 49, link])
    vertices = np.concatenate(sheets)
    charts = make_charts(vertices, every, 256)
    assert np.array_equal(charts.rows[charts.faces], every)
    assert (charts.corners > -1).all()
    assert (charts.corners < 257).all()
    corner = charts.corners[charts.faces]
    a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    areas = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    hits = np.zeros((256, 256), int)
    for triangle in corner[areas > 1]:
        y, x = np.mgrid[0:256, 0:256] + 0.5
        sides = [(q[0] - p[0]) * (y - p[1]) - (q[1] - p[1]) * (x - p[0])
                 for p, q in zip(triangle, np.roll(triangle, -1, axis=0), strict=True)]
        hits += (np.min(sides, axis=0) > 0.5) | (np.max(sides, axis=0) < -0.5)
    assert hits.max() == 1
    assert hits.sum() > 0.3 * 256**2


def test_inferred_surface_keeps_its_mark_and_comes_last_as_in_files(tmp_path):
    one, other = wall(), wall()
    moved = Mesh(other.vertices + np.array([0, 1.7, 0]), other.faces, other.colors,
                 np.ones(len(other.vertices), bool))
    both = joined(one, moved)
    views = [TrainView(view, photo(view)) for view in CAMERAS]
    mesh = add_texture(both, views, 128, "png", NullProgress())
    assert np.array_equal(mesh.vertices[mesh.faces], both.vertices[both.faces])
    assert np.array_equal(mesh.inferred, mesh.vertices[:, 1] > 0.85)
    assert (np.diff(mesh.inferred.astype(int)) >= 0).all()
    for suffix in ("glb", "obj"):
        write_mesh_file(tmp_path / f"mesh.{suffix}", mesh, UP)  # reads it back
