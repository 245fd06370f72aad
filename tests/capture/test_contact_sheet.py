import io

import numpy as np
import pytest
from media import texture
from PIL import Image

from recon_cli.capture import contact_sheet
from recon_cli.capture.contact_sheet import BORDER, COLOURS, HELD_OUT, MAX_BYTES, ContactSheet
from recon_cli.capture.frame_selection import FrameCandidate, Reason


def capture(reasons):
    return [
        FrameCandidate("room.mp4", index, reason, 10.0,
                  f"{index:06d}.png" if reason is Reason.KEPT else None)
        for index, reason in enumerate(reasons)]


def drawn(candidates, path, *, held_out=(), width=160, height=96, pixels=None):
    sheet = ContactSheet("room.mp4", candidates, width, height)
    for index in sheet.wanted:
        sheet.add(index, texture(height, width, seed=index) if pixels is None else pixels)
    sheet.write(path, held_out)
    return Image.open(path).convert("RGB")


def borders(picture):
    """Which reasons' colours fill the upper and lower edge of a border, as a palette rounds them.

    Text has no line of as many pixels of one colour.
    """
    pixels = np.asarray(picture).astype(int)
    filled = {
        name: ((np.abs(pixels - colour).max(axis=2) <= 4).sum(axis=1) > 130).sum()
        for name, colour in COLOURS.items()}
    return {name for name, lines in filled.items() if lines >= 2 * BORDER}


def test_each_kind_has_its_border(tmp_path):
    reasons = [Reason.KEPT, Reason.KEPT, Reason.BLURRED, Reason.DUPLICATE]
    picture = drawn(
        capture(reasons), tmp_path / "contact.png", held_out={"000001.png"},
        pixels=np.full((96, 160, 3), 60, np.uint8))
    assert borders(picture) == {Reason.KEPT, HELD_OUT, Reason.BLURRED, Reason.DUPLICATE}


def test_a_photo_of_another_shape_keeps_it(tmp_path):
    sheet = ContactSheet("room", capture([Reason.KEPT] * 2), 160, 96)
    sheet.add(0, np.full((96, 160, 3), (250, 30, 30), np.uint8))
    sheet.add(1, np.full((160, 96, 3), (30, 30, 250), np.uint8))
    sheet.write(tmp_path / "contact.png", ())
    pixels = np.asarray(Image.open(tmp_path / "contact.png").convert("RGB")).astype(int)
    for colour, ratio in (((250, 30, 30), 160 / 96), ((30, 30, 250), 96 / 160)):
        rows, columns = np.nonzero(np.abs(pixels - colour).max(axis=2) < 12)
        assert np.ptp(columns) / np.ptp(rows) == pytest.approx(ratio, rel=0.05)


def test_a_sheet_of_strips_stays_within_its_width(tmp_path):
    pixels = np.full((5, 1920, 3), 60, np.uint8)
    picture = drawn(
        capture([Reason.KEPT] * 4), tmp_path / "contact.png", width=1920, height=5, pixels=pixels)
    assert picture.size[0] <= 4000


def test_the_thumbnails_stand_in_order(tmp_path):
    colours = [(250, 30, 30), (30, 250, 30), (30, 30, 250)]
    sheet = ContactSheet("room.mp4", capture([Reason.KEPT] * 3), 160, 96)
    for index, colour in enumerate(colours):
        sheet.add(index, np.full((96, 160, 3), colour, np.uint8))
    sheet.write(tmp_path / "contact.png", ())
    pixels = np.asarray(Image.open(tmp_path / "contact.png").convert("RGB")).astype(int)
    centres = [
        np.argwhere(np.abs(pixels - colour).max(axis=2) < 12)[:, 1].mean() for colour in colours]
    assert centres == sorted(centres)


@pytest.mark.integration
@pytest.mark.parametrize("size", [(160, 96), (96, 160), (100, 100), (1000, 100)])
def test_the_sheet_stays_small_however_long_the_capture(tmp_path, size):
    reasons = ([Reason.KEPT] + [Reason.CLOSE] * 20 + [Reason.BLURRED]) * 300
    noise = np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3)).astype(np.uint8)
    picture = drawn(
        capture(reasons), tmp_path / "contact.png", width=size[0], height=size[1], pixels=noise)
    assert max(picture.size) <= 4000
    assert (tmp_path / "contact.png").stat().st_size <= MAX_BYTES


def test_a_picture_that_takes_too_much_gets_fewer_colours(monkeypatch):
    noise = np.random.default_rng(0).integers(0, 256, (200, 300, 3)).astype(np.uint8)
    sizes = []
    for most in (3_000_000, 50_000, 31_000):
        monkeypatch.setattr(contact_sheet, "MAX_BYTES", most)
        data = contact_sheet._encode(Image.fromarray(noise))
        assert len(data) <= most
        sizes.append(len(data))
        assert Image.open(io.BytesIO(data)).size == (300, 200)
    assert sizes == sorted(set(sizes), reverse=True)


def test_all_hundred_frames_of_the_default_are_shown_and_every_rare_reason():
    reasons = ([Reason.CLOSE] * 30 + [Reason.KEPT]) * 100
    reasons[77], reasons[1500] = Reason.CLIPPED, Reason.DAMAGED
    candidates = capture(reasons)
    sheet = ContactSheet("room.mp4", candidates, 540, 960)
    shown = [candidates[index].reason for index in sorted(sheet.wanted)]
    assert shown.count(Reason.KEPT) == 100
    assert Reason.CLIPPED in shown
    assert Reason.DAMAGED in shown
    assert shown.count(Reason.CLOSE) >= 40


def test_a_frame_without_pixels_is_an_empty_cell(tmp_path):
    sheet = ContactSheet(
        "photos", capture([Reason.KEPT, Reason.DAMAGED]), 160, 96)
    sheet.add(0, texture(96, 160))
    sheet.add(99, texture(96, 160))
    sheet.write(tmp_path / "contact.png", ())
    assert Image.open(tmp_path / "contact.png").size[0] > 0


def test_the_same_capture_gives_the_same_bytes(tmp_path):
    candidates = capture([Reason.KEPT, Reason.CLOSE] * 10)
    for name in ("a.png", "b.png"):
        drawn(candidates, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
