"""Lists of test views in the files of a data set: by any spelling of names, and never silently."""

import json

import posed_sets
import pytest
from colmap_sets import rig_model, write
from facts import raises

from recon_cli.datasets.layouts import read_posed
from recon_cli.errors import FormatError

NAMES = [f"{number:04d}.png" for number in range(6)]


@pytest.fixture
def folder(tmp_path):
    return posed_sets.make_transforms(tmp_path, posed_sets.transforms(frames=6))


def held_out(posed):
    return [image.name for image in posed.images if image.held_out]


def said(posed, *words):
    return any(all(word in notice for word in words) for notice in posed.notices)


@pytest.mark.parametrize("place", ["sparse/0/test.txt", "test_list.txt", "test.txt"])
@pytest.mark.parametrize("spelled", ["{}.png", "{}", "images/{}.png", r".\images\{}.png", "{}.PNG"])
def test_test_views_are_held_out_by_any_spelling_of_their_names(folder, place, spelled):
    if spelled == "{}.PNG":
        spelled = "# a comment\n\n{}.png  "
    path = folder / place
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\ufeff" + "".join(spelled.format(stem) + "\n" for stem in ("0001", "0004")))
    posed = read_posed(folder)
    assert [image.name for image in posed.images] == NAMES
    assert held_out(posed) == ["0001.png", "0004.png"]
    assert posed.splits
    assert said(posed, place, "2 of 6")


def test_a_list_beside_a_model_in_folders_tells_equal_names_apart(tmp_path):
    write(tmp_path, rig_model(), "bin")
    names = [image.name for image in read_posed(tmp_path).images]
    (tmp_path / "sparse" / "0" / "test.txt").write_text(f"{names[0]}\n{names[4]}\n")
    assert held_out(read_posed(tmp_path)) == [names[0], names[4]]


def test_a_list_of_training_views_alone_holds_out_the_others(folder):
    (folder / "train_list.txt").write_text("\n".join(NAMES[:4]))
    assert held_out(read_posed(folder)) == NAMES[4:]


def test_images_in_none_of_several_lists_are_left_out(folder):
    (folder / "train_list.txt").write_text("\n".join(NAMES[:3]))
    (folder / "test_list.txt").write_text(NAMES[4])
    (folder / "validation_list.txt").write_text(NAMES[5])
    posed = read_posed(folder)
    assert [image.name for image in posed.images] == [*NAMES[:3], NAMES[4]]
    assert held_out(posed) == NAMES[4:5]
    assert said(posed, "2 frames")


def test_names_that_the_set_lacks_are_named(folder):
    (folder / "test.txt").write_text("0001\ngone.png\nlost\n")
    posed = read_posed(folder)
    assert held_out(posed) == ["0001.png"]
    assert said(posed, "gone.png", "lost", "2 images")


@pytest.mark.parametrize("text", ["", "\n# nothing\n", "gone.png\n", "\n".join(NAMES)])
def test_a_list_that_holds_out_nothing_or_all_is_said_and_not_used(folder, text):
    (folder / "test.txt").write_text(text)
    posed = read_posed(folder)
    assert len(posed.images) == 6
    assert not held_out(posed)
    assert not posed.splits
    assert said(posed, "test.txt")


def test_a_list_that_is_no_text_is_refused(folder):
    (folder / "test.txt").write_bytes(b"\xff\xfe\x00\x01")
    with raises(FormatError, "test.txt"):
        read_posed(folder)


def test_the_split_of_a_transforms_file_goes_before_lists(folder):
    value = json.loads((folder / "transforms.json").read_text())
    value |= {"train_filenames": [f"images/{name}" for name in NAMES[:5]],
              "test_filenames": ["images/0005", "images/gone.png"]}
    (folder / "transforms.json").write_text(json.dumps(value))
    (folder / "test.txt").write_text("0001")
    posed = read_posed(folder)
    assert held_out(posed) == ["0005.png"]
    assert said(posed, "images/gone.png")


@pytest.mark.parametrize("lists", [
    {"test_filenames": ["images/0002.png"]}, {"val_filenames": ["images/0002.png"]}])
def test_a_transforms_file_may_list_its_held_out_views_alone(tmp_path, lists):
    posed_sets.make_transforms(tmp_path, posed_sets.transforms(frames=4, **lists))
    posed = read_posed(tmp_path)
    assert len(posed.images) == 4
    assert held_out(posed) == ["0002.png"]


def test_all_views_for_the_test_leave_a_transforms_file_whole(tmp_path):
    names = [f"images/{name}" for name in NAMES[:4]]
    posed_sets.make_transforms(tmp_path, posed_sets.transforms(
        frames=4, train_filenames=names, test_filenames=names))
    posed = read_posed(tmp_path)
    assert (len(posed.images), held_out(posed), posed.splits) == (4, [], False)
    assert said(posed, "train")


def test_the_test_frames_of_scannetpp_are_held_out(tmp_path):
    value = posed_sets.transforms(frames=5)
    value["test_frames"] = value["frames"][3:]
    value["frames"] = value["frames"][:3]
    posed_sets.make_transforms(tmp_path, posed_sets.transforms(frames=5))
    (tmp_path / "transforms.json").write_text(json.dumps(value))
    assert held_out(read_posed(tmp_path)) == ["0003.png", "0004.png"]


def test_the_lists_of_scannetpp_are_used(folder):
    (folder / "train_test_lists.json").write_text(json.dumps(
        {"train": NAMES[:4], "test": NAMES[4:], "has_masks": False}))
    assert held_out(read_posed(folder)) == NAMES[4:]
