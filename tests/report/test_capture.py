"""The plan: where a camera lies and looks in closed form, the scale bar, and which way is up."""

import re
from pathlib import Path

import numpy as np
import pytest

from recon_cli.report.capture import draw_plan, find_axes
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View


def view(name, center, ahead, up=(0, 0, 1)):
    """A view at a place that looks ahead, its image upright."""
    z, up = np.asarray(ahead, float), np.asarray(up, float)
    right = np.cross(z, up)
    viewmat = np.eye(4)
    viewmat[:3, :3] = [right, np.cross(z, right), z]
    viewmat[:3, 3] = -viewmat[:3, :3] @ np.asarray(center, float)
    return View(name, Camera(64, 48, 50.0, 50.0, 32.0, 24.0, viewmat), Path(name), Path(name))


def scene(train, *, test=(), validation=(), points=None):
    if points is None:
        side = np.linspace(-5, 5, 21)
        points = np.stack(np.meshgrid(side, side, [0.0]), axis=-1).reshape(-1, 3)
    return Scene(tuple(train), tuple(validation), tuple(test), (), points,
                 np.zeros((len(points), 3), np.uint8))


def drawn(svg, name):
    """(x, y) of a camera's mark and (dx, dy) of its line, in pixels right and down."""
    match = re.search(
        r'<path class="line c\d" d="M([-\d.]+),([-\d.]+)l([-\d.]+),([-\d.]+)"/>'
        rf'<path class="mark[^>]*><title>{re.escape(name)}', svg)
    assert match, name
    x, y, dx, dy = map(float, match.groups())
    return (x, y), (dx, dy)


ROUND = [view("e.png", (2, 0, 1), (1, 0, 0)), view("n.png", (0, 2, 1), (0, 1, 0)),
         view("w.png", (-2, 0, 1), (-1, 0, 0)), view("s.png", (0, -2, 1), (0, -1, 0))]


def test_east_is_right_and_north_is_up_and_so_are_the_lines_of_sight():
    room = scene(ROUND)
    svg = draw_plan(room, find_axes(room, z_up=True), metres=False)
    (ex, ey), (edx, edy) = drawn(svg, "e.png")
    (wx, _), (wdx, _) = drawn(svg, "w.png")
    (nx, ny), (ndx, ndy) = drawn(svg, "n.png")
    (_, sy), (_, sdy) = drawn(svg, "s.png")
    assert (ex + wx) / 2 == pytest.approx(nx, abs=0.2)
    assert ex - wx == pytest.approx(sy - ny, abs=0.3)  # one scale for both
    assert ex > nx > wx
    assert sy > ey > ny
    assert edx > 10
    assert wdx < -10
    assert ndy < -10
    assert sdy > 10
    assert edy == ndx == 0


def test_a_camera_that_looks_down_has_no_line():
    room = scene([*ROUND, view("down.png", (0, 0, 2), (0, 0, -1), up=(0, 1, 0))])
    _, (dx, dy) = drawn(draw_plan(room, find_axes(room, z_up=True), metres=False), "down.png")
    assert (dx, dy) == (0, 0)


def test_the_scale_bar_is_as_long_as_it_says():
    room = scene(ROUND)
    axes = find_axes(room, z_up=True)
    svg = draw_plan(room, axes, metres=True)
    length, text = re.search(
        r'd="M[\d.]+,[\d.]+v6h([\d.]+)v-6" class="axis scale"/>.*?>([\d.]+) m<', svg,
        re.DOTALL).groups()
    (ex, _), _ = drawn(svg, "e.png")
    (wx, _), _ = drawn(svg, "w.png")
    assert float(length) / float(text) == pytest.approx((ex - wx) / 4, abs=0.1)
    assert "axis scale" not in draw_plan(room, axes, metres=False)


def test_the_parts_have_marks_and_colours_of_their_own():
    room = scene(ROUND[:2], validation=ROUND[2:3], test=ROUND[3:])
    svg = draw_plan(room, find_axes(room, z_up=True), metres=False)
    shapes = {name: re.search(rf'class="mark (c\d)" d="M[-\d.]+,[-\d.]+(\w)[^>]*><title>{name}',
                              svg).groups() for name in ("e.png", "w.png", "s.png")}
    assert len(set(shapes.values())) == 3


def test_without_a_known_up_the_cameras_say_where_it_is():
    # the same room with y down, as a mapper may leave it
    turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z up becomes -y up

    def turned(view):
        viewmat = view.camera.viewmat.copy()
        viewmat[:3, :3] = viewmat[:3, :3] @ turn.T
        return View(view.name, Camera(64, 48, 50.0, 50.0, 32.0, 24.0, viewmat), view.original,
                    view.denoised)

    level = scene(ROUND)
    room = scene([turned(view) for view in ROUND], points=level.points @ turn.T)
    axes = find_axes(room, z_up=False)
    up = np.cross(*axes.axes)
    assert up == pytest.approx([0, -1, 0], abs=0.05)
    svg = draw_plan(room, axes, metres=False)
    (ex, ey), (nx, ny), (sx, sy) = (drawn(svg, f"{name}.png")[1] for name in "ens")
    assert (sx, sy) == pytest.approx((-nx, -ny), abs=0.2)
    assert ex * ny - ey * nx < -100  # north lies to the left of east: from above, not mirrored


def test_one_camera_and_no_spread_still_make_a_plan():
    room = scene([view("a.png", (0, 0, 0), (1, 0, 0))], points=np.zeros((3, 3)))
    for z_up in (True, False):
        svg = draw_plan(room, find_axes(room, z_up=z_up), metres=True)
        assert "nan" not in svg
        assert "inf" not in svg


def test_a_name_is_escaped():
    room = scene([*ROUND, view("<script>.png", (1, 1, 1), (1, 0, 0))])
    svg = draw_plan(room, find_axes(room, z_up=True), metres=False)
    assert "<script>" not in svg
    assert "&lt;script&gt;.png" in svg
