import numpy as np
import pytest

from recon_cli.errors import FormatError
from recon_cli.splats.ply import read_ply_points

POINTS = np.array([[1.5, -2, 3], [4, 5, 6]])
COLORS = np.array([[255, 0, 7], [1, 2, 3]])
HEAD = """ply
format {} 1.0
comment made by hand
element vertex 2
property {} x
property {} y
property {} z
property uchar red
property uchar green
property uchar blue
element face 1
property list uchar int vertex_indices
end_header
"""


def write(path, kind, place="float", tail=b"\x03\0\0\0\0"):
    order = {"binary_big_endian": ">"}.get(kind, "<")
    head = HEAD.format(kind, place, place, place).encode()
    if kind == "ascii":
        rows = "".join(f"{x} {y} {z} {r} {g} {b}\n" for (x, y, z), (r, g, b) in zip(
            POINTS, COLORS, strict=True))
        path.write_bytes(head + rows.encode() + b"3 0 1 0\n")
        return path
    row = np.dtype([("p", order + {"float": "f4", "double": "f8"}[place], 3), ("c", "u1", 3)])
    table = np.zeros(2, row)
    table["p"], table["c"] = POINTS, COLORS
    path.write_bytes(head + table.tobytes() + tail)
    return path


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("place", ["float", "double"])
def test_points_and_colours_are_read_in_every_form_and_faces_passed_over(tmp_path, kind, place):
    points, colors = read_ply_points(write(tmp_path / "p.ply", kind, place))
    np.testing.assert_array_equal(points, POINTS)
    np.testing.assert_array_equal(colors, COLORS)


def test_points_may_lack_colours(tmp_path):
    text = write(tmp_path / "p.ply", "ascii").read_text()
    (tmp_path / "p.ply").write_text(text.replace("red", "a").replace("green", "b"))
    assert read_ply_points(tmp_path / "p.ply")[1] is None


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.6, 0.85])
def test_a_file_cut_short_anywhere_is_refused(tmp_path, kind, share):
    path = write(tmp_path / "p.ply", kind, tail=b"")
    data = path.read_bytes()[:-10]
    path.write_bytes(data[:int(share * len(data))])
    with pytest.raises(FormatError):
        read_ply_points(path)


@pytest.mark.parametrize(("old", "new"), [
    ("property float x", "property list uchar int x"), ("float y", "float x"), ("1.5", "nan"),
    ("1.5", "word"), ("255", "256"), ("255", "nan"),
    ("1.5 ", ""), ("element vertex", "element face"), ("vertex 2", "vertex -2"),
    ("ascii", "binary")])
def test_a_file_that_holds_something_else_is_refused(tmp_path, old, new):
    path = write(tmp_path / "p.ply", "ascii")
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(FormatError):
        read_ply_points(path)


def test_a_fused_cloud_of_a_room_is_read(shared_data):
    points, colors = read_ply_points(shared_data / "rooms" / "office" / "cloud_3cm.ply")
    assert points.shape == colors.shape == (93635, 3)
