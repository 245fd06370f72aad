"""Damaged files of every layout: refused with the file and the reason, or fewer frames, counted.

SETS writes a small data set of each layout. Any of their files may be cut short; FILES says what
else one file of one layout can have wrong, and the facts of the refusal. Faults of the capture
itself stand in `test_faulty_shots`.
"""

import functools
import json

import numpy as np
import posed_sets
import pytest
from app_sets import APPS
from app_shots import shots
from colmap_sets import rig_model, write
from facts import raises

from recon_cli.datasets.layouts import LAYOUTS, read_posed, recognise
from recon_cli.errors import InputError, ReconError

SETS = {
    "replica": posed_sets.make_replica, "scannet": posed_sets.make_scannet,
    "7scenes": posed_sets.make_seven_scenes, "tum": posed_sets.make_tum,
    "transforms": posed_sets.make_transforms,
    "colmap": lambda folder: write(folder, rig_model(), "txt"),
}
COUNT = 4


@functools.cache
def taken(office, own):
    return shots(office, count=COUNT, moving=own)


@pytest.fixture
def make(tmp_path, shared_data):
    """Returns a function that writes a set of a name below a folder that it returns."""
    def written(name):
        folder = tmp_path / "set"
        folder.mkdir(exist_ok=True)
        if name in SETS:
            SETS[name](folder)
        else:
            APPS[name].write(folder, taken(shared_data / "rooms" / "office", APPS[name].own))
        return folder

    return written


def test_every_layout_is_damaged_here():
    assert {row.name for row in LAYOUTS} == {*SETS, *(app.name for app in APPS.values())}


def text(content):
    return lambda path: path.write_text(content)


def numbers(values):
    return lambda path: np.save(path, values)


def head(count):
    return lambda path: path.write_bytes(path.read_bytes()[:count])


def half(path):
    path.write_bytes(path.read_bytes()[:path.stat().st_size // 2])


def remove(path):
    path.unlink()


def tree(edit):
    """Edits a JSON file."""
    def change(path):
        value = json.loads(path.read_text())
        edit(value)
        path.write_text(json.dumps(value))

    return change


def update(**entries):
    return tree(lambda value: value.update(entries))


def frame(matrix):
    return tree(lambda value: value["frames"][2].update(transform_matrix=matrix))


def poses(values):
    return tree(lambda value: value.update(poses=values))


def line(number, edit):
    """Edits the words of a line."""
    def change(path):
        lines = path.read_text().splitlines()
        lines[number - 1] = " ".join(edit(lines[number - 1].split()))
        path.write_text("\n".join(lines))

    return change


def length(rows):
    """Leaves out lines at the end, or repeats the first."""
    def change(path):
        lines = path.read_text().splitlines()
        path.write_text("\n".join([*lines, lines[0]][:rows]) + "\n")

    return change


def replace(old, new):
    def change(path):
        found = path.read_text()
        assert old in found
        path.write_text(found.replace(old, new, 1))

    return change


CAMERA = {"w": 32, "h": 24, "fx": 1, "fy": 1, "cx": 1, "cy": 1, "scale": 1}
NAN = np.full((4, 4), np.nan).tolist()
FILES = [
    ("replica", "traj.txt", line(3, lambda words: ["nan", *words[1:]]), ["line 3", "finite"]),
    ("replica", "traj.txt", line(3, lambda words: words[:12]), ["line 3", 12]),
    ("replica", "traj.txt", line(3, lambda words: ["oops", *words[1:]]), ["line 3", "other"]),
    ("replica", "traj.txt", line(3, lambda words: ["2.0", *words[1:]]), ["line 3", "rigid"]),
    *(("replica", "traj.txt", length(rows), [rows, 4, "frames"]) for rows in (0, 3, 5)),
    ("replica", "test/traj.txt", remove, ["test/traj.txt"]),
    *(("replica", "cam_params.json", text(json.dumps(value)), ["cam_params.json"]) for value in (
        [], {}, {"camera": 3}, {"camera": {"w": 32}}, {"camera": CAMERA | {"scale": 0}},
        {"camera": CAMERA | {"fx": "nan"}})),
    ("scannet", "pose/2.txt", text("1 2 3"), ["pose/2.txt", 3]),
    ("scannet", "pose/2.txt", text("a " * 16), ["pose/2.txt", "other"]),
    ("scannet", "pose/2.txt", text("nan " * 16), ["pose/2.txt", "finite"]),
    ("scannet", "pose/2.txt", text("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"), ["pose/2.txt", "scaled"]),
    ("scannet", "intrinsic/intrinsic_color.txt", remove, ["intrinsic_color.txt"]),
    ("tum", "rgb.txt", text("10.0 /etc/passwd\n"), ["rgb.txt", "/etc/passwd"]),
    ("tum", "rgb.txt", text("10.0 ../a.png\n"), ["rgb.txt", "../a.png"]),
    ("tum", "rgb.txt", text(""), ["rgb.txt", "files"]),
    ("tum", "rgb.txt", text("soon rgb/0.png\n"), ["rgb.txt", "line 1"]),
    ("tum", "groundtruth.txt", text(""), ["groundtruth.txt", "path"]),
    ("tum", "groundtruth.txt", text("10 0 0 0 0 0 0\n"), ["groundtruth.txt", "line 1"]),
    ("tum", "groundtruth.txt", text("10 0 0 0 0 0 0 0\n11 0 0 0 0 0 0 1\n"), ["path"]),
    ("tum", "groundtruth.txt", text("10 0 0 nan 0 0 0 1\n11 0 0 0 0 0 0 1\n"), ["finite"]),
    ("tum", "depth.txt", text("10.0\n"), ["depth.txt", "line 1"]),
    ("transforms", "transforms.json", update(fl_x=None, fl_y=None), ["focal"]),
    ("transforms", "transforms.json", update(fl_x="wide"), ["fl_x", "'wide'"]),
    ("transforms", "transforms.json", update(fl_x=float("nan")), ["fl_x", "nan"]),
    ("transforms", "transforms.json", update(fl_x=-3), ["camera"]),
    ("transforms", "transforms.json", update(fl_x=10**400), ["finite"]),
    ("transforms", "transforms.json", update(fl_x=True), ["fl_x", True]),
    ("transforms", "transforms.json", update(camera_model="EQUIRECTANGULAR"), ["EQUIRECTANGULAR"]),
    ("transforms", "transforms.json", update(k1=float("inf")), ["k1", "inf"]),
    ("transforms", "transforms.json", update(k4=0.1), ["k4", 0.1]),
    ("transforms", "transforms.json", update(fl_x=None, fl_y=None, camera_angle_x=4.0),
     ["camera_angle_x", "pi"]),
    ("transforms", "transforms.json", update(camera_model="OPENCV_FISHEYE", p1=0.1),
     ["tangential"]),
    *(("transforms", "transforms.json", frame(matrix), ["images/0002.png", fact])
      for matrix, fact in (
        (NAN, "finite"), ((2 * posed_sets.pose(2) @ posed_sets.OPENGL).tolist(), "rigid"),
        ([[1, 0], [0, 1]], 4), ([], 0), ("x", "matrix"))),
    *(("transforms", "transforms.json", text(content), ["transforms.json"]) for content in (
        "", "{", "[]", "{}", '{"frames": []}', '{"frames": 3}', "null")),
    ("record3d", "*/metadata.json", poses([]), ["poses", "list"]),
    ("record3d", "*/metadata.json", poses([[0, 0, 0, 1, 0, 0, 0]] * 40), ["poses", "same"]),
    ("record3d", "*/metadata.json", poses([[0, 0, 0, 0, 0, 0, 0]] * 40), ["frame", "pose"]),
    ("record3d", "*/metadata.json", tree(lambda value: (
        value.pop("K"), value.update(perFrameIntrinsicCoeffs=[]))), [COUNT, "intrinsics"]),
    ("stray", "rgb.mp4", head(900), ["rgb.mp4"]),
    ("arkitscenes", "*/lowres_wide.traj", lambda path: path.write_text("\n".join(
        f"99{row}" for row in path.read_text().splitlines())), [COUNT, "time"]),  # of another one
    ("arkitscenes", "*/lowres_wide.traj", length(1), ["lowres_wide.traj", 1]),
    ("metashape", "cameras.xml", replace("<document", '<!DOCTYPE a [<!ENTITY b "c">]><document'),
     ["cameras.xml", "entities"]),
    ("metashape", "cameras.xml", half, ["cameras.xml", "XML"]),
    ("llff", "images/l002.jpg", remove, [COUNT, "images/", COUNT - 1]),
    ("llff", "poses_bounds.npy", numbers(np.zeros((4, 12))), ["poses_bounds.npy", 17]),
    ("bundler", "list.txt", lambda path: path.write_text(path.read_text() + "more.jpg\n"),
     ["list.txt", 6]),
    ("bundler", "bundle.out", half, ["bundle.out"]),
]


@pytest.mark.parametrize(("name", "pattern", "change", "facts"), FILES, ids=[
    f"{name} {pattern} {at}" for at, (name, pattern, *_) in enumerate(FILES)])
def test_a_damaged_file_is_refused_with_the_reason(make, name, pattern, change, facts):
    folder = make(name)
    (path,) = folder.glob(pattern)
    change(path)
    with raises(InputError, *facts) as caught:
        read_posed(folder)
    assert caught.value.exit_code == 3


@pytest.mark.integration
@pytest.mark.parametrize("name", [*SETS, *APPS])
def test_any_file_cut_short_gives_a_typed_error_or_fewer_frames(name, make):
    folder = make(name)
    count = len(read_posed(folder).images)
    kinds = {(path.parent.name, path.suffix): path
             for path in folder.rglob("*") if path.is_file()}
    for path in kinds.values():
        data = path.read_bytes()
        for keep in (0.0, 0.5, 0.95):
            path.write_bytes(data[:int(len(data) * keep)])
            assert recognise(folder) is None or count_images(folder) <= count
        path.write_bytes(data)


def count_images(folder):
    """Returns how many images are read: none after an error that says what to type."""
    try:
        return len(read_posed(folder).images)
    except ReconError as error:
        return 0 if error.hint else 1 << 20
