"""Images and their masks as training and scores read them."""

import os

import cv2
import numpy as np
import pytest
from facts import raises

from recon_cli.errors import FormatError
from recon_cli.io.images import (
    decode_file,
    fill_masked,
    read_image,
    read_mask,
    read_masked_image,
    read_png,
    to_uint8,
    write_png,
)


def written(path, mask):
    """Writes a mask [H, W], True where a pixel counts, as sfm does."""
    cv2.imwrite(str(path), mask.astype(np.uint8) * 255)
    return path


def test_a_mask_of_the_right_size_is_read_as_it_is(tmp_path):
    mask = np.random.default_rng(0).random((6, 9)) < 0.5
    assert np.array_equal(read_mask(written(tmp_path / "m.png", mask), 9, 6), mask)


def test_a_pixel_of_a_reduced_mask_counts_only_if_all_that_it_covers_does(tmp_path):
    mask = np.ones((60, 90), bool)
    mask[10, 31] = False
    reduced = read_mask(written(tmp_path / "m.png", mask), 9, 6)
    assert np.argwhere(~reduced).tolist() == [[1, 3]]


@pytest.mark.parametrize("width", [45, 47, 61, 89])
def test_no_ignored_pixel_leaks_into_a_reduced_image(tmp_path, width):
    mask = np.random.default_rng(width).random((60, 90)) < 0.97
    images = []
    for shade in (0, 255):
        image = np.full((60, 90, 3), 128, np.uint8)
        image[~mask] = shade
        write_png(tmp_path / f"{shade}.png", image)
        images.append(read_masked_image(
            tmp_path / f"{shade}.png", written(tmp_path / "m.png", mask), width, 40))
    assert not images[0][1].all()
    assert (images[0][0] == 128).all()
    assert np.array_equal(images[0][0], images[1][0])


def test_half_covered_edges_of_a_mask_are_ignored(tmp_path):
    cv2.imwrite(str(tmp_path / "m.png"), np.array([[0, 128, 254, 255]], np.uint8))
    assert read_mask(tmp_path / "m.png", 4, 1).tolist() == [[False, False, False, True]]


def test_ignored_pixels_are_painted_in_the_mean_of_the_others():
    image = np.array([[[10, 20, 30], [30, 40, 51], [255, 0, 255]]], np.uint8)
    result = fill_masked(image, np.array([[True, True, False]]))
    assert result.tolist() == [[[10, 20, 30], [30, 40, 51], [20, 30, 40]]]
    assert image[0, 2].tolist() == [255, 0, 255]


@pytest.mark.parametrize("kept", [True, False])
def test_a_mask_that_ignores_nothing_is_none_and_one_of_everything_leaves_nothing(tmp_path, kept):
    image = np.random.default_rng(1).integers(1, 256, (6, 9, 3), np.uint8)
    write_png(tmp_path / "i.png", image)
    read, mask = read_masked_image(
        tmp_path / "i.png", written(tmp_path / "m.png", np.full((6, 9), kept)), 9, 6)
    assert mask is None if kept else not mask.any()
    assert np.array_equal(read, image * kept)


def test_a_file_that_is_no_mask_is_named(tmp_path):
    (tmp_path / "m.png").write_text("no picture")
    with raises(FormatError, "m.png"):
        read_mask(tmp_path / "m.png", 4, 1)


def test_gray_and_sixteen_bits_survive_a_png(tmp_path):
    for image in (np.array([[0, 1, 256, 65_535]], np.uint16), np.array([[0, 7, 255]], np.uint8)):
        write_png(tmp_path / "gray.png", image)
        back = cv2.imread(str(tmp_path / "gray.png"), cv2.IMREAD_UNCHANGED)
        assert back.dtype == image.dtype
        np.testing.assert_array_equal(back, image)


def test_eight_bits_round_to_the_nearest_step_and_clip():
    values = np.array([-1, 0, 0.49 / 255, 0.51 / 255, 1, 7], np.float32)
    np.testing.assert_array_equal(to_uint8(values), [0, 0, 0, 1, 255, 255])


def test_a_pipe_is_no_image_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    assert decode_file(tmp_path / "pipe.png", cv2.IMREAD_COLOR) is None


def test_a_path_that_is_not_utf8_is_read(tmp_path):
    path = tmp_path / os.fsdecode(b"x\xff\xfe") / "m.png"
    path.parent.mkdir()
    write_png(path, np.full((4, 6, 3), 200, np.uint8))
    assert read_png(path).shape == (4, 6, 3)
    assert read_image(path, 6, 4).mean() == 200
    assert read_mask(path, 6, 4).sum() == 0


@pytest.mark.parametrize("data", [None, b"", b"no image"])
def test_what_is_missing_empty_or_no_image_is_a_typed_error(tmp_path, data):
    path = tmp_path / "m.png"
    if data is not None:
        path.write_bytes(data)
    for read in (read_png, lambda path: read_image(path, 6, 4)):
        with raises(FormatError) as raised:
            read(path)
        assert raised.value.hint
