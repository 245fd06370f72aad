from pathlib import PurePosixPath

import posed_sets
import pytest
from facts import assert_facts

from recon_cli.capture.masks import find_masks, mask_folders, match_masks
from recon_cli.capture.photo_tree import find_photo_files
from recon_cli.capture.photos import list_photos
from recon_cli.datasets.layouts import read_posed


def touch(*paths):
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def matched(folder, *images):
    masks, unused = match_masks(folder, {image: PurePosixPath(image) for image in images})
    return {image: mask.relative_to(folder).as_posix() for image, mask in masks.items()}, unused


def test_masks_have_the_names_of_their_images_with_a_suffix_or_instead_of_it(tmp_path):
    touch(tmp_path / "a.png", tmp_path / "b.jpg.png", tmp_path / "c.jpg", tmp_path / "D.JPG",
          tmp_path / "lost.png", tmp_path / "notes.txt")
    assert matched(tmp_path, "a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg") == (
        {"a.jpg": "a.png", "b.jpg": "b.jpg.png", "c.jpg": "c.jpg", "d.jpg": "D.JPG"},
        ["lost.png"])


def test_masks_of_images_in_folders_lie_in_such_folders(tmp_path):
    touch(tmp_path / "x" / "0.png", tmp_path / "1.png", tmp_path / "2.png")
    found, unused = matched(tmp_path, "x/0.jpg", "y/0.jpg", "y/1.jpg", "x/2.jpg", "y/2.jpg")
    assert found == {"x/0.jpg": "x/0.png", "y/1.jpg": "1.png"}
    assert unused == ["2.png"]  # of which of the two?


def test_a_folder_of_masks_may_be_called_so_in_any_case(tmp_path):
    for name in ("Mask", "depth"):
        (tmp_path / name).mkdir()
    assert mask_folders(tmp_path) == [tmp_path / "Mask"]
    assert mask_folders(tmp_path / "gone") == []


MAKERS = {
    "replica": (posed_sets.make_replica, "results", "frame000001"),
    "scannet": (posed_sets.make_scannet, "color", "2"),
    "7scenes": (posed_sets.make_seven_scenes, ".", "frame-000000.color"),
    "tum": (posed_sets.make_tum, "rgb", "1"),
    "transforms": (posed_sets.make_transforms, "images", "0001"),
}


@pytest.mark.parametrize("layout", MAKERS)
def test_masks_by_stem_are_found_in_data_sets_of_every_layout(tmp_path, layout):
    make, _, stem = MAKERS[layout]
    make(tmp_path)
    touch(tmp_path / "masks" / f"{stem}.png", tmp_path / "masks" / "lost.png")
    posed = read_posed(tmp_path)
    assert [image.path.stem for image in posed.images if image.mask] == [stem]
    assert_facts("\n".join(posed.notices), 1, "images", "masks")
    assert_facts("\n".join(posed.notices), "lost.png")


def test_where_no_mask_fits_the_right_name_is_told(tmp_path):
    posed_sets.make_transforms(tmp_path)
    touch(tmp_path / "masks" / "mask_0.png")
    assert_facts("\n".join(read_posed(tmp_path).notices), "0000.png", "0000.png.png")


@pytest.mark.parametrize("name", [".mask/{}.png", "{}.jpg.mask.png", "{}.MASK.PNG"])
def test_the_mask_layers_of_realityscan_are_masks_and_no_photos(tmp_path, name):
    for number in range(3):
        posed_sets.write_image(tmp_path / f"p{number}.jpg")
    posed_sets.write_image(tmp_path / name.format("p1"))
    tree = find_photo_files(tmp_path)
    assert [path.name for path in tree.files] == ["p0.jpg", "p1.jpg", "p2.jpg"]
    found = find_masks(tmp_path, tree.home, list_photos(tree.files, tree.home).photos)
    assert found.by_photo == {"p1.jpg": tmp_path / name.format("p1")}
    assert not found.unused


def test_masks_beside_the_images_of_a_data_set_are_read(tmp_path):
    posed_sets.make_transforms(tmp_path)
    posed_sets.write_image(tmp_path / "images" / "0001.png.mask.png")
    assert [image.path.stem for image in read_posed(tmp_path).images if image.mask] == ["0001"]
