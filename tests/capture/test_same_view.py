"""Which photos show one view: copies, exposures of a bracket, and what only looks like them."""

import cv2
import numpy as np
import pytest
from facts import assert_facts
from media import texture
from noisy_room import noisy

from recon_cli.capture.frame_selection import Reason, choose_photos, describe_dropped
from recon_cli.capture.same_view import SAME_VIEW, find_repeats, is_same_view, measure_photo

STOPS = (-2, 0, 2)


def photo(seed):
    blocks = texture(120, 200, seed=seed, coarseness=20)
    return cv2.GaussianBlur(blocks, (0, 0), 3)


def jpeg(rgb, quality):
    return cv2.imdecode(cv2.imencode(".jpg", rgb, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 1)


def moved(rgb, share):
    shift = np.float32([[1, 0, share * rgb.shape[1]], [0, 1, 0]])
    return cv2.warpAffine(rgb, shift, rgb.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)


def exposed(rgb, stops, *, filmic=False, seed=0):
    """The photo as a camera gives it after an exposure that is longer by so many stops."""
    light = (rgb / 255.0) ** 2.2 * 2.0 ** stops
    if filmic:  # a curve with a shoulder
        light = 1.25 * light * (1 + light / 4) / (1 + light)
    return jpeg(noisy(255 * np.clip(light, 0, 1) ** (1 / 2.2), 1, seed=seed), 90)


def relit(rgb):
    """The room of a photo by another lamp: one side of it gets brighter, the other darker."""
    return (rgb * np.linspace(0.6, 1.0, rgb.shape[1])[None, :, None]).astype(np.uint8)


def choose(pictures):
    """`pictures` by file name, None for one that cannot be read."""
    looks = [None if one is None else measure_photo(one) for one in pictures.values()]
    return choose_photos("room", list(pictures), [f"{one}.png" for one in pictures], looks)


def reasons(candidates):
    return {one.source: one.reason for one in candidates}


@pytest.mark.parametrize("again", [
    lambda rgb: rgb, lambda rgb: jpeg(rgb, 60), lambda rgb: noisy(rgb, 5),
    lambda rgb: cv2.resize(rgb, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA),
], ids=["copy", "resaved", "noisy", "smaller"])
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


@pytest.mark.integration
def test_a_chain_of_small_steps_is_not_one_group():
    chain = [measure_photo(moved(photo(1), 0.0015 * step)) for step in range(30)]
    goes = find_repeats(chain)
    stays = [index for index in range(60) if index not in goes]
    assert len(stays) > 2
    for index, stands in goes.items():
        assert np.linalg.norm(chain[index].signature - chain[stands].signature) < SAME_VIEW


def test_flat_pictures_are_like_no_other():
    assert find_repeats([measure_photo(np.full((60, 80, 3), 90, np.uint8))] * 3) == {}


@pytest.mark.parametrize("filmic", [False, True])
def test_of_a_bracket_the_middle_exposure_is_used(filmic):
    pictures = {f"{place}{stops:+d}": exposed(photo(place), stops, filmic=filmic, seed=stops + 9)
                for place in range(4) for stops in STOPS}
    found = choose(pictures)
    kept = [one.source for one in found if one.reason is Reason.KEPT]
    assert kept == ["0+0", "1+0", "2+0", "3+0"]
    rest = [one for one in found if one.reason is not Reason.KEPT]
    assert {one.reason for one in rest} == {Reason.EXPOSURE}
    assert [one.like // 3 for one in rest] == [one.index // 3 for one in rest]
    text, = describe_dropped(found)
    assert_facts(text, 8, "photos", "left")
    assert_facts(text, "0-2", "0+0")


def test_ends_of_a_wide_bracket_that_share_little_are_one_view():
    pictures = {str(one): exposed(photo(1), one) for one in (-3, -1.5, 0, 1.5, 3)} | {
        "b": photo(2), "c": photo(3)}
    looks = [measure_photo(one) for one in pictures.values()]
    assert not is_same_view(looks[0], looks[4])
    assert [one.source for one in choose(pictures) if one.reason is Reason.KEPT] == ["0", "b", "c"]


def test_of_two_exposures_the_less_clipped_one_is_used():
    found = choose({"a": photo(1), "bright": exposed(photo(1), 2), "b": photo(2), "c": photo(3)})
    assert reasons(found)["bright"] is Reason.EXPOSURE
    assert reasons(found)["a"] is Reason.KEPT


@pytest.mark.parametrize("share", [0.01, 0.02, 0.06])
@pytest.mark.parametrize("stops", [-1, 1])
def test_a_step_to_the_side_in_another_exposure_is_another_view(share, stops):
    assert not is_same_view(
        measure_photo(photo(1)), measure_photo(exposed(moved(photo(1), share), stops)))


def test_another_lamp_makes_another_view():
    assert not is_same_view(measure_photo(photo(1)), measure_photo(relit(photo(1))))


@pytest.mark.integration
def test_steps_of_a_walk_whose_exposure_drifts_are_not_one_view():
    walk = [measure_photo(exposed(moved(photo(1), 0.004 * step), 0.1 * (step % 7)))
            for step in range(40)]
    goes = find_repeats(walk)
    assert len(goes) < 30
    assert all(abs(index - stands) <= 2 for index, stands in goes.items())


@pytest.mark.integration
@pytest.mark.parametrize(("pattern", "count"), [
    ("fox/images/*.jpg", 50), ("desk_monitors/images/*", 70), ("snowmiku_photos/*.jpg", 97),
    ("walks/bonsai/images/*", 292), ("walks/club_room_lockers/images/*", 170),
    ("rooms/office/results/frame*.jpg", 100)])
def test_no_real_capture_loses_a_photo(shared_data, pattern, count):
    paths = sorted(shared_data.glob(pattern))
    pictures = {path.name: cv2.imread(str(path), cv2.IMREAD_REDUCED_COLOR_2) for path in paths}
    found = choose(pictures)
    assert len(found) == count
    assert set(reasons(found).values()) == {Reason.KEPT}
