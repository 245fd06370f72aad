import cv2
import numpy as np
import pytest
from media import texture
from noisy_room import noisy

from recon_cli.capture.near_duplicates import (
    choose_photos,
    describe_dropped,
    find_duplicates,
    measure_photo,
    signature,
)
from recon_cli.capture.selection_record import Reason
from recon_cli.errors import InputError


def photo(seed):
    blocks = texture(120, 200, seed=seed, coarseness=20)
    return cv2.GaussianBlur(blocks, (0, 0), 3)


def jpeg(rgb, quality):
    return cv2.imdecode(cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 1)


def moved(rgb, share):
    shift = np.float32([[1, 0, share * rgb.shape[1]], [0, 1, 0]])
    return cv2.warpAffine(rgb, shift, rgb.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)


def choose(pictures):
    """`pictures` by file name, None for one that cannot be read."""
    looks = [None if one is None else measure_photo(one) for one in pictures.values()]
    return choose_photos("room", list(pictures), [f"{one}.png" for one in pictures], looks)


def reasons(candidates):
    return {one.source: one.reason for one in candidates}


@pytest.mark.parametrize("again", [
    lambda rgb: rgb, lambda rgb: jpeg(rgb, 60), lambda rgb: noisy(rgb, 5),
    lambda rgb: cv2.resize(rgb, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA),
    lambda rgb: rgb // 2 + 20,
], ids=["copy", "resaved", "noisy", "smaller", "darker"])
def test_the_same_view_is_known_again(again):
    pictures = {"a": photo(1), "b": photo(2), "c": photo(3), "d": again(photo(2))}
    found = choose(pictures)
    dropped = [one for one in found if one.reason is Reason.DUPLICATE]
    assert len(dropped) == 1
    assert {dropped[0].index, dropped[0].like} == {1, 3}


@pytest.mark.parametrize("share", [0.02, 0.06])
def test_a_step_to_the_side_is_another_view(share):
    found = choose({"a": photo(1), "b": moved(photo(1), share), "c": photo(3)})
    assert set(reasons(found).values()) == {Reason.KEPT}


def test_the_sharpest_of_a_group_stays_and_the_first_of_equals():
    soft = cv2.GaussianBlur(photo(1), (0, 0), 1)
    found = choose({"soft": soft, "sharp": photo(1), "again": photo(1), "x": photo(2),
                    "y": photo(3)})
    assert reasons(found) == {
        "soft": Reason.DUPLICATE, "sharp": Reason.KEPT, "again": Reason.DUPLICATE,
        "x": Reason.KEPT, "y": Reason.KEPT}
    assert [one.like for one in found] == [1, None, 1, None, None]
    assert found[1].name == "sharp.png"
    assert found[0].name is None


def test_a_chain_of_small_steps_is_not_one_group():
    chain = np.stack([
        signature(moved(photo(1), 0.001 * step)[:, :, 0]) for step in range(60)])
    goes = find_duplicates(chain, np.zeros(60))
    stays = [index for index in range(60) if index not in goes]
    assert len(stays) > 2
    for index, stands in goes.items():
        assert np.linalg.norm(chain[index] - chain[stands]) < 0.05


def test_flat_pictures_are_like_no_other():
    flat = np.zeros((3, 64 * 64), np.float32)
    assert find_duplicates(flat, np.zeros(3)) == {}


def test_what_is_left_out_is_named():
    pictures = {
        "a": photo(1), "b": photo(2), "c": photo(3), "copy": photo(2), "cap": photo(4) * 0,
        "broken": None}
    found = choose(pictures)
    assert reasons(found)["broken"] is Reason.DAMAGED
    assert reasons(found)["cap"] is Reason.CLIPPED
    assert describe_dropped(found) == [
        "1 photos are left out because others show the same: copy (like b).",
        "1 photos are left out because they are black, blown out or flat: cap."]


def test_many_names_are_cut_short():
    pictures = {"a": photo(1), "b": photo(2), "c": photo(3)} | {
        f"copy{index}": photo(1) for index in range(12)}
    assert describe_dropped(choose(pictures))[0].endswith("and 4 more.")


@pytest.mark.parametrize("count", [3, 12])
def test_copies_of_one_photo_are_refused(count):
    with pytest.raises(InputError, match=f"{count} photos but only 1 different view") as caught:
        choose({str(index): photo(1) for index in range(count)})
    assert "a step apart" in caught.value.hint


def test_photos_that_are_all_black_are_refused():
    with pytest.raises(InputError, match="too dark: 4 of its 4 photos"):
        choose({str(index): photo(index) // 50 for index in range(4)})


@pytest.mark.parametrize(("pattern", "count"), [
    ("fox/images/*.jpg", 50), ("desk_monitors/images/*", 70),
    ("rooms/office/results/frame*.jpg", 100)])
def test_no_real_capture_loses_a_photo(shared_data, pattern, count):
    paths = sorted(shared_data.glob(pattern))
    pictures = {path.name: cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_2) for path in paths}
    found = choose(pictures)
    assert len(found) == count
    assert set(reasons(found).values()) == {Reason.KEPT}
