import numpy as np
import pytest
from media import texture

from recon_cli.capture.scan import check_exposure, exposure, telling, well_exposed
from recon_cli.errors import InputError


def gray(seed=0):
    return texture(96, 160, seed=seed)[:, :, 0]


def rows(*frames):
    return np.array([exposure(frame) for frame in frames])


def half_dark(share):
    frame = gray()
    frame[:int(share * 96)] = 2
    return frame


def test_the_shares_of_black_and_blown_out_pixels_are_what_they_are():
    frame = np.full((80, 160), 128, np.uint8)
    frame[:, :40], frame[:, 40:60] = 0, 255
    black, blown, spread = exposure(frame)
    assert (black, blown) == (0.25, 0.125)
    assert spread == pytest.approx(frame.std(), rel=0.01)


def test_noise_on_a_flat_wall_is_no_spread():
    noise = np.random.default_rng(0).normal(128, 20, (480, 640)).clip(0, 255).astype(np.uint8)
    assert exposure(noise)[2] < 2


def test_frames_that_are_clipped_for_the_most_part_are_not_well_exposed():
    found = rows(gray(), half_dark(0.4), half_dark(0.6), np.full((96, 160), 255, np.uint8))
    assert well_exposed(found).tolist() == [True, True, False, False]
    assert telling(found).tolist() == [True, True, True, False]


@pytest.mark.parametrize(("value", "words"), [
    (3, "too dark: so are 20 of its 20"), (255, "over-exposed: so are 20 of its 20"),
    (128, "flat: so are 20 of its 20")])
def test_a_capture_that_shows_nothing_is_refused_with_what_is_wrong(value, words):
    frames = rows(*[np.full((96, 160), value, np.uint8)] * 20)
    with pytest.raises(InputError, match=words) as caught:
        check_exposure("room.mp4", frames, least=3)
    assert "at least 3 are needed" in caught.value.message
    assert "ecord again" in caught.value.hint


def test_a_few_frames_that_show_something_are_enough():
    black = np.zeros((96, 160), np.uint8)
    check_exposure("room.mp4", rows(*[black] * 20, gray(1), gray(2), gray(3)), least=3)


def test_a_capture_that_is_dark_here_and_blown_out_there_is_refused_too():
    frames = rows(*[np.full((96, 160), value, np.uint8) for value in (2, 255) * 5])
    with pytest.raises(InputError, match="10 of its 10 frames"):
        check_exposure("room.mp4", frames, least=3)
