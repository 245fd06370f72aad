import numpy as np
import pytest
from facts import raises
from PIL import Image

from recon_cli.capture.images import Photo, inspect_photo
from recon_cli.capture.masks import find_masks, photo_mask, read_mask, write_mask
from recon_cli.errors import InputError

ORIENTATION = 0x0112


def own_mask(photo):
    return photo_mask(photo, None, photo.width, photo.height)


def photos(folder, *names):
    return [Photo(folder / name, 8, 6, None) for name in names]


def touch(*paths):
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def half(width=8, height=6):
    """Counts on the right half."""
    mask = np.zeros((height, width), np.uint8)
    mask[:, width // 2:] = 255
    return mask


def saved(path, pixels, **options):
    Image.fromarray(pixels).save(path, **options)
    return path


def test_masks_inside_the_folder_are_found_by_stem_and_by_whole_name(tmp_path):
    masks = tmp_path / "masks"
    touch(masks / "a.png", masks / "b.JPG", masks / "c.jpg.png", masks / "lost.png")
    touch(masks / "notes.txt", masks / ".hidden.png")
    found = find_masks(tmp_path, tmp_path, photos(tmp_path, "a.jpg", "b.jpg", "c.jpg", "d.jpg"))
    assert found.by_photo == {
        "a.jpg": masks / "a.png", "b.jpg": masks / "b.JPG", "c.jpg": masks / "c.jpg.png"}
    assert found.unused == ("lost.png",)


def test_masks_of_any_format_of_pictures_are_found(tmp_path):
    masks = tmp_path / "masks"
    touch(masks / "a.tif", masks / "b.webp", masks / "c.bmp", masks / "d.dng")
    found = find_masks(tmp_path, tmp_path, photos(tmp_path, "a.jpg", "b.jpg", "c.jpg", "d.jpg"))
    assert sorted(found.by_photo) == ["a.jpg", "b.jpg", "c.jpg"]


def test_masks_beside_the_photos_count_where_the_folder_of_both_was_given(tmp_path):
    touch(tmp_path / "masks" / "a.png")
    images = tmp_path / "images"
    images.mkdir()
    assert len(find_masks(tmp_path, images, photos(images, "a.jpg")).by_photo) == 1
    alone = find_masks(images, images, photos(images, "a.jpg"))
    assert (alone.by_photo, alone.outside) == ({}, tmp_path / "masks")


def test_without_masks_there_are_none(tmp_path):
    assert find_masks(tmp_path, tmp_path, photos(tmp_path, "a.jpg")).by_photo == {}


@pytest.mark.parametrize("mode", ["1", "L", "P", "RGB", "LA", "I;16"])
def test_white_counts_in_any_mode(tmp_path, mode):
    image = Image.fromarray(half())
    if mode == "I;16":
        image = Image.fromarray(half().astype(np.uint16) * 257)
    else:
        image = image.convert(mode)
    image.save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "a.png", 8, 6), half())


def test_gray_is_decided_at_half(tmp_path):
    gray = np.tile(np.array([0, 127, 128, 255], np.uint8), (6, 2))
    found = read_mask(saved(tmp_path / "a.png", gray), 8, 6)
    assert found[0, :4].tolist() == [0, 0, 255, 255]


@pytest.mark.parametrize(("width", "height"), [(16, 12), (4, 3), (800, 600), (801, 600)])
def test_a_mask_of_another_size_is_resampled_to_the_nearest_pixel(tmp_path, width, height):
    found = read_mask(saved(tmp_path / "a.png", half(width, height)), 8, 6)
    np.testing.assert_array_equal(found, half())


@pytest.mark.parametrize(("width", "height"), [(6, 8), (8, 8), (16, 9)])
def test_a_mask_of_another_shape_is_refused_with_both_sizes(tmp_path, width, height):
    path = saved(tmp_path / "a.png", half(width, height))
    with raises(InputError, "a.png", f"{width}x{height}", "80x60"):
        read_mask(path, 80, 60)


def test_the_orientation_of_a_mask_is_applied(tmp_path):
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    path = saved(tmp_path / "a.png", half(), exif=exif)
    np.testing.assert_array_equal(read_mask(path, 6, 8), np.rot90(half(), -1))


@pytest.mark.parametrize("brightest", [0, 1, 127])
def test_a_mask_that_ignores_everything_is_refused_with_its_brightest_value(tmp_path, brightest):
    path = saved(tmp_path / "a.png", np.full((6, 8), brightest, np.uint8))
    with raises(InputError, brightest, "brightest"):
        read_mask(path, 8, 6)


def test_a_mask_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "a.png").write_bytes(b"no picture")
    with raises(InputError, "mask", "a.png"):
        read_mask(tmp_path / "a.png", 8, 6)


def see_through(path, alpha, **options):
    rgba = np.dstack([np.full((*alpha.shape, 3), 200, np.uint8), alpha])
    return inspect_photo(saved(path, rgba, **options))


def test_transparency_below_half_is_ignored_and_turned_with_the_photo(tmp_path):
    alpha = np.where(half() > 0, 128, 127).astype(np.uint8)
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    np.testing.assert_array_equal(own_mask(see_through(tmp_path / "a.png", alpha)), half())
    turned = own_mask(see_through(tmp_path / "b.png", alpha, exif=exif))
    np.testing.assert_array_equal(turned, np.rot90(half(), -1))


def test_an_opaque_photo_has_no_mask(tmp_path):
    assert own_mask(see_through(tmp_path / "a.png", np.full((6, 8), 255, np.uint8))) is None
    assert own_mask(inspect_photo(saved(tmp_path / "b.png", half()))) is None


def test_a_photo_that_is_transparent_everywhere_is_refused(tmp_path):
    with raises(InputError, "a.png"):
        own_mask(see_through(tmp_path / "a.png", np.zeros((6, 8), np.uint8)))


def test_mask_and_transparency_both_take_away(tmp_path):
    top = np.zeros((6, 8), np.uint8)
    top[:3] = 255
    photo = see_through(tmp_path / "a.png", top)
    path = saved(tmp_path / "mask.png", half())
    np.testing.assert_array_equal(photo_mask(photo, path, 8, 6), np.minimum(top, half()))
    np.testing.assert_array_equal(photo_mask(photo, None, 4, 4)[:, 0], [255, 255, 0, 0])
    with raises(InputError, "leave", "pixel"):
        photo_mask(see_through(tmp_path / "b.png", 255 - half()), path, 8, 6)


def test_a_mask_that_ignores_nothing_is_none(tmp_path):
    photo = inspect_photo(saved(tmp_path / "a.png", half()))
    path = saved(tmp_path / "mask.png", np.full((6, 8), 255, np.uint8))
    assert photo_mask(photo, path, 8, 6) is None
    assert photo_mask(photo, None, 8, 6) is None


def test_a_written_mask_is_read_as_it_was(tmp_path):
    write_mask(tmp_path / "masks" / "a.png", half())
    np.testing.assert_array_equal(read_mask(tmp_path / "masks" / "a.png", 8, 6), half())
