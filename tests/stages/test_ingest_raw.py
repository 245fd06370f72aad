"""Ingest of camera RAW, and of photos whose colours or lenses are corrected."""

import json
import logging

import numpy as np
import pytest
from dng import BEFORE, Shot, gain_map, linear, opcodes, write_shot
from facts import assert_facts
from ingest_media import blocks, listed, take, write_photos
from PIL import Image


@pytest.fixture
def notices(caplog):
    caplog.set_level(logging.WARNING, logger="recon")
    return lambda: [record.getMessage() for record in caplog.records]


def write_raw(folder, stops):
    folder.mkdir()
    light = linear(blocks(96, 128)) * 0.3
    for index, ev in enumerate(stops):
        view = np.roll(light, 8 * index, axis=1)  # another view, with the same mean
        write_shot(folder / f"IMG_{index:04d}.dng", view * 2.0**ev, Shot(iso=int(100 * 2.0**ev)))
    return folder


def test_raw_photos_are_developed_alike_and_the_gains_are_recorded(tmp_path):
    folder = write_raw(tmp_path / "room", [0, 1, 0, -1])
    take(folder, tmp_path / "out")
    plan = json.loads((tmp_path / "out" / "raw.json").read_text())
    gains = [shot["gain_ev"] for shot in plan["shots"].values()]
    np.testing.assert_allclose(np.array(gains) - gains[0], [0, -1, 0, 1], atol=0.01)
    names = [frame["name"] for frame in listed(tmp_path / "out")["frames"]]
    levels = [
        linear(np.asarray(Image.open(tmp_path / "out" / "frames" / name))).mean()
        for name in names]
    assert np.ptp(levels) / np.median(levels) < 0.02


def test_a_plan_that_is_there_is_kept_and_gives_the_same_frames(tmp_path, monkeypatch):
    folder = write_raw(tmp_path / "room", [0, 1, 0])
    take(folder, tmp_path / "out")
    frame = tmp_path / "out" / "frames" / "IMG_0001.png"
    before = frame.read_bytes()
    frame.unlink()

    def never(*_args, **_options):
        raise AssertionError("planned again")

    monkeypatch.setattr("recon_cli.capture.from_photos.plan_raw", never)
    take(folder, tmp_path / "out")
    assert frame.read_bytes() == before


def test_a_jpeg_beside_its_raw_is_left_out_and_told(tmp_path, notices):
    folder = write_raw(tmp_path / "room", [0, 0, 0])
    write_photos(folder, 2)
    assert take(folder, tmp_path / "out").frames == 3
    assert [frame["source"] for frame in listed(tmp_path / "out")["frames"]] == [
        "IMG_0000.dng", "IMG_0001.dng", "IMG_0002.dng"]
    assert_facts(notices()[0], 2, "photos", "left")


def test_a_jpeg_takes_the_place_of_its_broken_raw(tmp_path):
    folder = write_raw(tmp_path / "room", [0, 0, 0])
    write_photos(folder, 1)
    (folder / "IMG_0000.dng").write_bytes(b"no RAW")
    take(folder, tmp_path / "out")
    assert [frame["source"] for frame in listed(tmp_path / "out")["frames"]] == [
        "IMG_0000.jpg", "IMG_0001.dng", "IMG_0002.dng"]


def test_colours_and_lenses_that_are_corrected_are_told(tmp_path, notices):
    folder = write_raw(tmp_path / "room", [0, 0, 0])
    shaded = opcodes(gain_map(np.full((2, 2, 1), 1.75), size=(96, 128)))
    for seed, path in enumerate(sorted(folder.iterdir())):
        write_shot(path, linear(blocks(96, 128, seed=seed)) * 0.3, Shot(more={BEFORE: shaded}))
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 2
    Image.fromarray(blocks(96, 128, seed=7)).save(folder / "a.jpg", exif=exif)
    take(folder, tmp_path / "out")
    told = "\n".join(notices())
    assert_facts(told, "1 photo", "Adobe RGB")
    assert_facts(told, 3, "RAW", "1.75")


def test_raw_photos_of_one_name_in_two_folders_are_developed_each(tmp_path):
    light = linear(blocks(96, 128).astype(np.float32))
    for place, seed in (("", 0), ("more", 7)):
        (tmp_path / "room" / place).mkdir(parents=True, exist_ok=True)
        for index in range(2):
            light = linear(blocks(96, 128, seed=seed + index).astype(np.float32))
            name = f"IMG_{index + (1 if place else 0)}.dng"
            write_shot(tmp_path / "room" / place / name, light, Shot())
    assert take(tmp_path / "room", tmp_path / "out").frames == 4
    assert "more/IMG_1.dng" in json.loads((tmp_path / "out" / "raw.json").read_text())["shots"]


def test_a_damaged_record_of_an_earlier_run_is_made_again(tmp_path):
    (tmp_path / "room").mkdir()
    for index in range(3):
        light = linear(blocks(96, 128, seed=index).astype(np.float32))
        write_shot(tmp_path / "room" / f"{index}.dng", light, Shot())
    take(tmp_path / "room", tmp_path / "out")
    kept = (tmp_path / "out" / "raw.json").read_bytes()
    for damage in (b"", b"[]", b'{"shots": 5, "broken": {}}'):
        (tmp_path / "out" / "raw.json").write_bytes(damage)
        take(tmp_path / "room", tmp_path / "out")
        assert (tmp_path / "out" / "raw.json").read_bytes() == kept
