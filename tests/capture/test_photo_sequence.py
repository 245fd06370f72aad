"""Which photos pass for the frames of a video, and what is measured of them."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from media import texture
from PIL import Image

from recon_cli.capture import photo_sequence
from recon_cli.capture.images import Photo
from recon_cli.capture.photo_sequence import (
    PhotoSequence,
    find_sequence,
    looks_numbered,
    measure_sequence,
)
from recon_cli.capture.photos import list_photos
from recon_cli.config.stages import IngestConfig
from recon_cli.context import StageContext
from recon_cli.errors import InputError

STEP, WIDTH, HEIGHT = 2, 256, 192  # pixels


def walk(count):
    """Gray frames of a camera that moves sideways past a smooth wall."""
    gray = cv2.cvtColor(texture(HEIGHT, WIDTH + STEP * count, coarseness=48), cv2.COLOR_RGB2GRAY)
    wide = cv2.GaussianBlur(gray, None, 2.0)
    return [wide[:, STEP * i:STEP * i + WIDTH] for i in range(count)]


def write_walk(folder, count, *, name="frame_{:04d}.jpg", turned=False):
    """Photos of the walk, if `turned` stored on their side with the EXIF that says so."""
    folder.mkdir()
    exif = Image.Exif()
    for index, gray in enumerate(walk(count)):
        if turned:
            exif[0x0112] = 6
            gray = np.rot90(gray)
        Image.fromarray(gray).convert("RGB").save(
            folder / name.format(index), quality=95, exif=exif)
    return list(list_photos(folder.iterdir()).photos)


def named(*names, **changes):
    return [replace(Photo(Path(name), 64, 48, None), **changes) for name in names]


def test_frames_of_a_walk_are_a_sequence_with_its_steps():
    sequence = measure_sequence(iter(walk(60)), 60)
    assert sequence is not None
    assert sequence.motion[0] == 0
    assert sequence.motion.sum() == pytest.approx(59 * STEP / WIDTH, rel=0.05)
    assert (sequence.sharpness > 0).all()
    assert sequence.whole.all()


@pytest.mark.parametrize("stride", [10, 30])  # steps of .08 and .23 widths
def test_photos_a_step_apart_are_not_and_reading_them_soon_ends(stride):
    taken = []
    frames = (taken.append(0) or gray for gray in walk(60 * stride)[::stride])
    assert measure_sequence(frames, 60) is None
    assert len(taken) < 35


def test_a_broken_photo_is_named_and_many_are_no_sequence():
    def broken(*indices):
        return (InputError("broken") if index in indices else gray
                for index, gray in enumerate(walk(60)))

    sequence = measure_sequence(broken(7), 60)
    assert sequence is not None
    assert sequence.broken == {7: "broken"}
    assert np.flatnonzero(~sequence.whole).tolist() == [7]
    assert measure_sequence(broken(*range(10, 20)), 60) is None


def test_a_sequence_comes_back_from_its_record():
    sequence = PhotoSequence(
        np.array([0.0, np.nan]), np.array([1.0, 2.0]), np.array([[0.0, 0.1, 9.0]] * 2), {1: "why"})
    again = PhotoSequence.from_json(sequence.to_json())
    np.testing.assert_array_equal(again.motion, sequence.motion)
    np.testing.assert_array_equal(again.sharpness, sequence.sharpness)
    np.testing.assert_array_equal(again.exposure, sequence.exposure)
    assert again.broken == sequence.broken


@pytest.mark.parametrize(("photos", "numbered"), [
    (named(*(f"out{i:03d}.jpg" for i in range(30))), True),
    (named(*(f"{10 * i}.jpg" for i in range(30))), True),
    (named(*(f"a{i}.jpg" for i in range(30) if i != 9)), True),
    (named(*(f"a{i * i}.jpg" for i in range(30))), False),
    (named(*(f"{i}_{i}.jpg" for i in range(30))), False),
    (named(*"abcdef"), False),
    (named("1.jpg"), False),
    (named(*(f"{i}.dng" for i in range(30))), False),
    ([*named(*(f"{i}.jpg" for i in range(29))), *named("29.jpg", width=65)], False),
])
def test_frames_have_even_numbers_and_one_size(photos, numbered):
    assert looks_numbered(photos) is numbered


@pytest.mark.parametrize(("seconds", "numbered"), [(0, True), (1, True), (3, False)])
def test_photos_taken_seconds_apart_are_no_frames(tmp_path, seconds, numbered):
    for index in range(6):
        exif = Image.Exif()
        exif.get_ifd(0x8769)[0x9003] = f"2024:02:12 10:00:{seconds * index:02d}"
        Image.new("RGB", (8, 8)).save(tmp_path / f"{index}.jpg", exif=exif)
    assert looks_numbered(list_photos(tmp_path.iterdir()).photos) is numbered


def test_photos_stored_on_their_side_move_as_far(tmp_path):
    config, ctx = IngestConfig(frames=20), StageContext()
    sums = [find_sequence(config, write_walk(tmp_path / name, 30, turned=turned),
                          tmp_path / f"{name}.json", ctx).motion.sum()
            for name, turned in (("upright", False), ("turned", True))]
    assert sums[0] == pytest.approx(29 * STEP / WIDTH, rel=0.05)
    assert sums[1] == pytest.approx(sums[0], rel=0.05)


def test_only_more_photos_than_are_wanted_are_measured_and_only_once(tmp_path, monkeypatch):
    photos, record = write_walk(tmp_path / "walk", 30), tmp_path / "scan.json"
    for config in (IngestConfig(max_frames=10), IngestConfig(frames=30, max_frames=10)):
        assert find_sequence(config, photos, record, StageContext()) is None
    first = find_sequence(IngestConfig(frames=29), photos, record, StageContext())
    monkeypatch.setattr(photo_sequence, "measure_sequence", None)
    again = find_sequence(IngestConfig(frames=29), photos, record, StageContext())
    np.testing.assert_array_equal(first.motion, again.motion)
