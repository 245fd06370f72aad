"""The parts of a capture on the page: which moments join them, and when each was seen."""

import re
import shutil
from dataclasses import replace

import pytest
from facts import assert_facts
from report_workspace import PLACE, bring, page_of, prepared, section, summaries

from recon_cli.report.parts import advise, describe_time, find_moments
from recon_cli.workspace.records import Frame
from recon_cli.workspace.summaries import PartSummary

FILM = "a.mp4"


def film(count, *, source=FILM, start=0, seconds=2.0):
    """Frames of a film, so many seconds apart; without seconds they are photos."""
    return [Frame(f"{start + index:06d}.png", None if seconds is None else index * seconds,
                  source, None, held_out=False) for index in range(count)]


def parts(*rows):
    """Parts of the frames in these rows, which need not be in a row."""
    return [PartSummary(names=tuple(f"{row:06d}.png" for row in each), points=9) for each in rows]


def ends(gaps):
    return [(gap.before.name[4:6], gap.after.name[4:6], gap.numbers, gap.lost) for gap in gaps]


def test_the_moment_between_two_parts_is_the_end_of_one_and_the_start_of_the_other():
    gaps = find_moments(film(20), parts(range(12, 20), range(9)))
    assert ends(gaps) == [("08", "12", (2, 1), 3)]


def test_the_shortest_moment_that_joins_two_parts_is_shown():
    gaps = find_moments(film(20), parts([*range(5), *range(15, 20)], range(8, 14)))
    assert ends(gaps) == [("13", "15", (2, 1), 1)]


def test_as_many_moments_are_shown_as_join_all_parts():
    three = parts(range(4), range(6, 9), range(10, 13))
    assert ends(find_moments(film(13), three)) == [
        ("03", "06", (1, 2), 2), ("08", "10", (2, 3), 1)]
    # back where it began: the way back joins no more
    again = parts([*range(4), 14, 15], range(6, 9), range(10, 13))
    assert ends(find_moments(film(16), again)) == [
        ("08", "10", (2, 3), 1), ("12", "14", (3, 1), 1)]


def test_between_two_films_is_the_last_choice():
    frames = [*film(6), *film(6, source="b.mp4", start=6)]
    assert ends(find_moments(frames, parts([0, 1, 6, 7, 8], [4, 5, 9, 10, 11]))) == [
        ("08", "09", (1, 2), 0)]


def test_what_to_film_is_said_with_its_time():
    gap, = find_moments(film(60), parts(range(36), range(38, 60)))
    assert_facts(advise(gap), "1:08", "1:18", "slowly", "half")
    gap, = find_moments([*film(3), *film(3, source="b.mp4", start=3)], parts(range(3), range(3, 6)))
    assert_facts(advise(gap), "a.mp4 at 0:04", "b.mp4 at 0:00")
    gap, = find_moments(film(9, seconds=None), parts(range(4), range(6, 9)))
    assert_facts(advise(gap), "photos", "000003.png", "000006.png")
    assert_facts(advise(gap, panoramas=True), "panoramas", "000003.png", "000006.png", "doorway")


def test_a_part_tells_when_it_was_seen():
    two = parts([*range(3), *range(6, 9)], range(3, 6))
    assert_facts(describe_time(film(9), two, 1), "0:00 to 0:04", "0:12 to 0:16", "8 s")
    assert_facts(describe_time(film(9), two, 2), "0:06 to 0:10", "4 s")
    assert describe_time(film(9, seconds=None), two, 1) == ""


@pytest.fixture
def in_parts(finished, tmp_path, monkeypatch):
    """A workspace whose capture is in two parts, of which the second is placed."""
    made = tmp_path / "made"
    shutil.copytree(finished.parent / "made", made)
    names = sorted(path.name for path in (made / "ingest" / "frames").iterdir())
    sparse = made / "place" / "undistorted" / "sparse"
    for copy in ("sparse", "parts/1", "parts/2"):
        shutil.copytree(sparse, made / "sfm" / copy, dirs_exist_ok=True)
    monkeypatch.setitem(prepared, "folder", made)
    monkeypatch.setitem(summaries, "place", replace(
        PLACE, part=2, broken=("The model is broken.",), parts=(
            PartSummary(names=tuple(names[:7]), points=70),
            PartSummary(names=tuple(names[8:]), points=40))))
    video = tmp_path / "room.mp4"
    video.write_text("a video")
    bring(tmp_path / "ws", "ingest", "denoise", "sfm", "place", video=video)
    return tmp_path / "ws"


@pytest.mark.integration
def test_the_page_shows_each_part_and_the_moment_between_them(in_parts):
    page = page_of(in_parts)
    capture = section(page, "capture")
    assert len(re.findall(r'<figure class="map[^"]*"><figcaption>Part \d', capture)) == 2
    assert re.search(r"Part 2 <span[^>]*>in use", capture)
    assert_facts(capture, "7 of 12", 70)
    assert f"recon sfm -w {in_parts} --part</code>" not in capture
    assert f"recon sfm -w {in_parts} --part 1</code>" in capture
    moment = re.search(r'<div class="moment">.*?</div>', capture, re.DOTALL).group()
    assert moment.count("data:image/webp") == 2
    assert_facts(moment, 1, "part")
    assert_facts(page, 2, "parts", "part 2", "trusted")


@pytest.mark.integration
def test_a_part_that_cannot_be_read_is_told_and_the_rest_shown(in_parts):
    (in_parts / "sfm" / "parts" / "1" / "images.bin").write_bytes(b"damaged")
    capture = section(page_of(in_parts), "capture")
    assert_facts(capture, "Part 1", "not drawn")
    assert '<div class="moment">' in capture


@pytest.mark.integration
def test_a_capture_in_one_part_has_no_such_section(workspace):
    assert '<div class="moment">' not in page_of(workspace)
