"""The table that every reader fills: what pairs, what is left out, and what a set then holds."""

import numpy as np
import posed_sets
import pytest
from facts import assert_facts, raises

from recon_cli.datasets.frame_files import list_numbered, list_timed
from recon_cli.datasets.frame_table import (
    FrameTable,
    LeftOutError,
    MissingPictureError,
    nearest,
    read_object,
    read_size,
)
from recon_cli.datasets.posed import PosedImage
from recon_cli.errors import FormatError, InputError
from recon_cli.scene.camera import make_lens

INNER = (30.0, 30.0, 16.0, 12.0)  # of pictures of 32x24 pixels


def add(table, path, place=0.0, name=None):
    pose = np.eye(4)
    pose[0, 3] = place
    with table.frame(path.name):
        table.add(PosedImage(
            name or path.name, path, table.lens((32, 24), tuple, INNER), table.pose(pose.tolist)))


def test_files_pair_by_number_or_by_the_nearest_time(tmp_path):
    for name in ("0001.jpg", "1.png", "12(3).jpg", "7.JPG", "x7.jpg", "2.txt"):
        (tmp_path / name).touch()
    assert {number: path.name for number, path in list_numbered(tmp_path).items()} == {
        1: "0001.jpg", 7: "7.JPG"}
    for name in ("42_1.5.pincam", "1.6.pincam", "a.pincam"):
        (tmp_path / name).touch()
    times = list_timed(tmp_path, (".pincam",))
    assert list(times) == [1.5, 1.6]
    assert nearest(times, 1.5009, 0.001) == tmp_path / "42_1.5.pincam"
    assert nearest(times, 1.502, 0.001) is None
    assert nearest(dict.fromkeys((2.0, 1.0), "a") | {1.0: "b"}, 1.5, 1.0) == "b"  # the earlier one
    assert nearest({}, 1.0, 1.0) is None
    assert list_numbered(tmp_path / "gone") == {}


def test_frames_are_left_out_by_reason_and_counted(tmp_path):
    table = FrameTable(tmp_path)
    for name in ("a.png", "b.png"):
        posed_sets.write_image(tmp_path / name)
        add(table, tmp_path / name)
    for name in ("c", "d"):
        with table.frame(name):
            raise LeftOutError("that are blurred")
    with table.frame("e.png"):
        raise MissingPictureError
    with table.frame("f"):
        table.pose({}.__getitem__, "gone")
    with table.frame("g"):
        table.lens((32, 24), tuple, (30.0, 30.0, 160.0, 12.0))
    with table.frame("h"):  # intrinsics of pictures twice as large
        assert table.lens((32, 24), tuple, (60.0, 60.0, 32.0, 24.0)).params == INNER
    with table.frame("i"):
        read_object(tmp_path / "a.png", "")
    with table.frame("j"):
        read_object(None, "without a .json")
    with table.frame("k"):
        read_size(tmp_path / "gone.png")
    posed = table.finish()
    assert [image.name for image in posed.images] == ["a.png", "b.png"]
    assert posed.missing == ("e.png",)
    reasons = ("that are blurred, the first is c", "pose is missing", "not those of 32x24",
               "cannot be read as JSON", "without a .json", "that cannot be read", "scaled by 0.5",
               "missing: 1 of the 3 images")
    for text, reason in zip(posed.notices, reasons, strict=True):
        assert reason in text


def test_an_error_that_is_no_reason_to_leave_a_frame_out_is_raised(tmp_path):
    table = FrameTable(tmp_path)
    with pytest.raises(FormatError), table.frame("a"):
        raise FormatError("The whole list is damaged.")


def test_pictures_of_one_name_are_called_by_their_paths(tmp_path):
    table = FrameTable(tmp_path)
    for place in ("x", "y"):
        posed_sets.write_image(tmp_path / place / "a.png")
        add(table, tmp_path / place / "a.png")
    assert [image.name for image in table.finish().images] == ["x/a.png", "y/a.png"]
    add(table, tmp_path / "x" / "a.png")
    with raises(FormatError):
        table.finish()


def test_lenses_and_depth_take_the_size_of_the_files(tmp_path):
    table = FrameTable(tmp_path)
    posed_sets.write_image(tmp_path / "a.png")
    width, height = read_size(tmp_path / "a.png")
    lens = make_lens("PINHOLE", 2 * width, 2 * height, (60, 60, width, height), "")
    table.add(PosedImage("a.png", tmp_path / "a.png", lens, np.eye(4)))
    (image,) = table.finish().images
    assert (image.lens.width, image.lens.params) == (width, (30, 30, width / 2, height / 2))
    table.add(PosedImage("b.png", tmp_path / "a.png", lens.resized(width, height), np.eye(4)))
    with raises(FormatError, "common", "factor"):
        table.finish()


def test_a_table_without_a_frame_is_refused_with_what_to_type(tmp_path):
    table = FrameTable(tmp_path, pictures=tmp_path / "rgb.mp4")
    with raises(InputError, "frame", "pose") as caught:
        table.finish()
    assert f"recon ingest {tmp_path / 'rgb.mp4'}" in caught.value.hint
    with table.frame("a"):
        raise LeftOutError("that are blurred")
    with raises(InputError, 1, "blurred"):
        table.finish()


def test_tracked_frames_that_never_moved_are_refused(tmp_path):
    table = FrameTable(tmp_path, opengl=True)
    for name in ("a.png", "b.png"):
        posed_sets.write_image(tmp_path / name)
        add(table, tmp_path / name, place=1.0)
    with raises(InputError, 2, "poses"):
        table.finish_tracked()
    table.rows.pop()
    add(table, tmp_path / "b.png", place=2.0)
    posed = table.finish_tracked(up=None, without_picture=3)
    assert (posed.metric, posed.sequence, posed.find_up, posed.accuracy) == (
        True, True, True, "tracked")
    (notice,) = posed.notices
    assert_facts(notice, 3, "poses")
    # OpenGL's axes: y up and looking along -z
    np.testing.assert_allclose(np.diag(posed.images[0].viewmat), (1, -1, -1, 1))
    np.testing.assert_allclose(posed.centers, [[1, 0, 0], [2, 0, 0]])
