"""Which photos follow each other, and what is measured of them."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from recon_cli.capture import photo_sequence
from recon_cli.capture.images import Photo
from recon_cli.capture.photo_sequence import find_sequence, list_runs, measure_sequence
from recon_cli.capture.photos import list_photos
from recon_cli.context import StageContext

STEP, WIDTH, HEIGHT = 2, 256, 192  # pixels


def walk(count, seed=0):
    """Gray frames of a camera that moves sideways past a wall with blots."""
    noise = np.random.default_rng(seed).normal(0, 1, (HEIGHT, WIDTH + STEP * count))
    blots = cv2.GaussianBlur(noise, None, 3.0)
    wide = np.clip(128 + 70 * blots / blots.std(), 0, 255).astype(np.uint8)
    return [wide[:, STEP * i:STEP * i + WIDTH] for i in range(count)]


def write_photos(folder, grays, *, name="frame_{:04d}.jpg", turned=False):
    """Photos of a walk, if `turned` stored on their side with the EXIF that says so."""
    folder.mkdir(exist_ok=True)
    exif = Image.Exif()
    for index, gray in enumerate(grays):
        if turned:
            exif[0x0112] = 6
            gray = np.rot90(gray)
        Image.fromarray(gray).convert("RGB").save(
            folder / name.format(index), quality=95, exif=exif)
    return list(list_photos(folder.iterdir()).photos)


def found(photos, tmp_path):
    return find_sequence(photos, tmp_path / "scan.json", StageContext())


def named(*names, **changes):
    return [replace(Photo(Path(name), 64, 48, None), **changes) for name in names]


def cuts(sequence):
    """Places of the photos that share no track with the one before."""
    tracks = sequence.scan.tracks
    return [sequence.places[image] for image in range(1, len(sequence.places))
            if not len(tracks.matches(image - 1, image)[0])]


@pytest.mark.integration
@pytest.mark.parametrize("stride", [1, 5, 10])  # steps of .01, .04 and .08 widths
def test_a_walk_is_a_sequence_whatever_its_steps(stride):
    measured = measure_sequence(enumerate(walk(40 * stride)[::stride]), 40)
    assert measured is not None
    scan = measured.scan(WIDTH, HEIGHT)
    assert scan.motion[0] == 0
    assert np.nansum(scan.motion) == pytest.approx(39 * stride * STEP / WIDTH, rel=0.1)
    assert (scan.sharpness > 0).all()
    assert len(scan.tracks.names) == 40


@pytest.mark.integration
def test_photos_in_no_order_are_none_and_reading_them_soon_ends():
    taken = []
    order = np.random.default_rng(0).permutation(60)
    frames = walk(60 * 60)[::60]
    grays = ((place, taken.append(0) or frames[place]) for place in order.tolist())
    assert measure_sequence(grays, 60) is None
    assert len(taken) < 20


@pytest.mark.integration
def test_frames_that_their_names_put_in_a_wrong_order_are_photos(tmp_path):
    frames = walk(40 * 40)[::40]
    order = np.random.default_rng(1).permutation(40)
    assert found(write_photos(tmp_path / "walk", [frames[i] for i in order]), tmp_path) is None


@pytest.mark.parametrize(("photos", "runs"), [
    (named(*(f"out{i:03d}.jpg" for i in range(30))), [30]),
    (named(*(f"{10 * i}.jpg" for i in range(30))), [30]),
    (named(*(f"a{i * i}.jpg" for i in range(30))), [30]),
    (named(*(f"a{i}.jpg" for i in range(30)), *(f"b{i}.jpg" for i in range(40))), [30, 40]),
    (named(*(f"walk1_{i}.jpg" for i in range(30)), "cover.jpg"), [30]),
    (named(*(f"test_{i:02d}.jpg" for i in range(24))), []),
    (named(*(f"{chr(97 + i)}x.jpg" for i in range(26))), []),
    (named(*(f"{i}.dng" for i in range(30))), []),
    ([*named(*(f"{i}.jpg" for i in range(30))),
      *named(*(f"{i}.jpg" for i in range(30, 60)), width=65)], [30, 30]),
    ([*named(*(f"{i}.jpg" for i in range(30))),
      *named(*(f"{i}.jpg" for i in range(30, 60)), focal_px=50.0)], [30, 30]),
    (named(*(f"img_20260209_1535{i:02d}_052.jpg" for i in range(30))), [30]),
    (named(*(f"20240212_00{i // 2:02d}{30 * (i % 2):02d}.jpg" for i in range(60))), []),
])
def test_runs_are_of_one_camera_and_one_kind_of_name_and_not_seconds_apart(photos, runs):
    assert [len(run) for run in list_runs(photos)] == runs


@pytest.mark.parametrize(("seconds", "runs"), [(0, 1), (1, 1), (3, 0)])
def test_photos_taken_seconds_apart_are_no_frames(tmp_path, seconds, runs):
    for index in range(30):
        exif = Image.Exif()
        minute, second = divmod(seconds * index, 60)
        exif.get_ifd(0x8769)[0x9003] = f"2024:02:12 10:{minute:02d}:{second:02d}"
        Image.new("RGB", (8, 8)).save(tmp_path / f"{index}.jpg", exif=exif)
    assert len(list_runs(list_photos(tmp_path.iterdir()).photos)) == runs


@pytest.mark.integration
def test_photos_stored_on_their_side_give_the_tracks_of_upright_ones(tmp_path):
    tracks = {}
    for name, turned in (("upright", False), ("turned", True)):
        photos = write_photos(tmp_path / name, walk(30), turned=turned)
        tracks[name] = found(photos, tmp_path / name).scan.tracks
    first, last = tracks["turned"].matches(0, 20)
    shift = (tracks["turned"].xy[last] - tracks["turned"].xy[first]) * (WIDTH, HEIGHT)
    assert np.median(shift, axis=0) == pytest.approx([-20 * STEP, 0], abs=0.5)
    assert len(tracks["turned"].image) == pytest.approx(len(tracks["upright"].image), rel=0.05)


@pytest.mark.integration
@pytest.mark.parametrize(("name", "hidden", "follow"), [
    ("DSCF{:04d}.jpg", 0, True), ("DSCF{:04d}.jpg", 0.5, False), ("frame{:04d}.jpg", 0.5, True)])
def test_photos_that_a_camera_named_are_frames_only_where_they_hardly_differ(
        tmp_path, name, hidden, follow):
    frames = [gray.copy() for gray in walk(30)]
    for gray, other in zip(frames, walk(30 * 80, seed=1)[::80], strict=True):
        gray[:int(hidden * HEIGHT)] = other[:int(hidden * HEIGHT)]
    photos = write_photos(tmp_path / "walk", frames, name=name)
    assert (found(photos, tmp_path) is not None) is follow


@pytest.mark.integration
def test_two_walks_are_both_followed_and_nothing_from_one_to_the_other(tmp_path):
    write_photos(tmp_path / "walk", walk(30), name="a{}.jpg")
    photos = write_photos(tmp_path / "walk", walk(40, seed=1), name="b{}.jpg")
    sequence = found(photos, tmp_path)
    assert sequence.places == tuple(range(70))
    assert cuts(sequence) == [30]


@pytest.mark.integration
def test_one_numbering_with_a_cut_in_it_is_both_sides_of_it(tmp_path):
    photos = write_photos(tmp_path / "walk", [*walk(30), *walk(40, seed=1)])
    sequence = found(photos, tmp_path)
    assert sequence.places == tuple(range(70))
    assert sequence.strangers == ()
    tracks = sequence.scan.tracks
    assert len(tracks.matches(29, 30)[0]) < 15 < len(tracks.matches(30, 31)[0])


@pytest.mark.integration
def test_a_camera_that_zooms_half_way_is_one_sequence(tmp_path):
    frames = walk(60)
    frames[30:] = [cv2.resize(gray[48:144, 64:192], (WIDTH, HEIGHT)) for gray in frames[30:]]
    assert found(write_photos(tmp_path / "walk", frames), tmp_path).places == tuple(range(60))


@pytest.mark.integration
def test_what_shows_another_scene_is_told_and_tracks_lead_past_it(tmp_path):
    frames = walk(60)
    frames[20:22] = walk(2, seed=1)
    frames[59] = walk(1, seed=2)[0]
    sequence = found(write_photos(tmp_path / "walk", frames), tmp_path)
    assert sequence.strangers == (20, 21, 59)
    assert sequence.places == (*range(20), *range(22, 59))
    assert cuts(sequence) == []


@pytest.mark.integration
def test_a_photo_that_follows_no_other_but_shows_the_scene_stays(tmp_path):
    frames = walk(120)
    frames[20] = frames[110]
    sequence = found(write_photos(tmp_path / "walk", frames), tmp_path)
    assert (sequence.strangers, sequence.places) == ((), tuple(range(120)))


@pytest.mark.integration
def test_a_photo_that_cannot_be_read_is_passed_over(tmp_path):
    photos = write_photos(tmp_path / "walk", walk(40))
    data = photos[7].path.read_bytes()
    photos[7].path.write_bytes(data[:1000])
    assert found(photos, tmp_path).places == (*range(7), *range(8, 40))


@pytest.mark.integration
def test_a_sequence_comes_back_from_its_record_for_the_same_photos(tmp_path, monkeypatch):
    photos = write_photos(tmp_path / "walk", walk(40))
    first = found(photos, tmp_path)
    scans = []
    monkeypatch.setattr(photo_sequence, "measure_sequence", lambda *_, **__: scans.append(0))
    again = found(photos, tmp_path)
    assert again.places == first.places
    np.testing.assert_array_equal(again.scan.motion, first.scan.motion)
    np.testing.assert_array_equal(again.scan.tracks.xy, first.scan.tracks.xy)
    assert not scans
    assert found(photos[1:], tmp_path) is None
    (tmp_path / "scan.json").write_text("{}")
    assert found(photos, tmp_path) is None
    assert len(scans) == 2
