"""Names of a list are found by suffix, case and folder; test_transforms.py has more of it."""

import posed_sets
import pytest
from facts import raises

from recon_cli.datasets.file_finder import FileFinder
from recon_cli.errors import FormatError


def put(folder, *names):
    for name in names:
        posed_sets.write_image(folder / name)


def found(folder, *names):
    return {name: path.relative_to(folder).as_posix()
            for name, path in FileFinder(folder, names).find_all("list").items()}


@pytest.mark.parametrize(("name", "there"), [
    ("a.png", "a.jpg"), ("a.png", "A.PNG"), ("IMG_1.JPG", "img_1.jpeg"), ("x/a.png", "y/a.png"),
    ("/home/other/x/a.png", "x/a.jpg"), ("C:\\other\\x\\a.png", "a.png"), ("../a.png", "a.png")])
def test_a_picture_that_is_called_otherwise_is_found(tmp_path, name, there):
    put(tmp_path, there)
    finder = FileFinder(tmp_path, [name])
    assert finder.find_all("list") == {name: tmp_path / there}
    (notice,) = finder.notices()
    assert name in notice
    assert there in notice


def test_the_exact_name_goes_first_and_needs_no_notice(tmp_path):
    put(tmp_path, "a.png", "a.jpg")
    finder = FileFinder(tmp_path, ["a.jpg"])
    assert finder.find_all("list") == {"a.jpg": tmp_path / "a.jpg"}
    assert finder.notices() == []


def test_of_several_that_fit_alike_none_is_taken(tmp_path):
    put(tmp_path, "x/a.png", "y/a.png")
    assert found(tmp_path, "z/a.png") == {}
    assert found(tmp_path, "other/y/a.png") == {"other/y/a.png": "y/a.png"}


def test_one_file_stands_for_one_name_only(tmp_path):
    put(tmp_path, "0.jpg")
    assert found(tmp_path, "cam1/0.png", "cam2/0.png") == {}


def test_a_mask_or_a_depth_map_stands_for_no_image(tmp_path):
    put(tmp_path, "masks/a.png", "depth/a.png")
    assert found(tmp_path, "images/a.png", "a.jpg") == {}


def test_a_name_that_leads_out_is_refused_where_nothing_is_called_so(tmp_path):
    with raises(FormatError, "lies", "outside"):
        FileFinder(tmp_path, ["../a.png"]).find("../a.png", "list")
