"""A capture in two parts: the larger is placed, and the other taken without mapping again."""

import json

import numpy as np
import pytest
from facts import assert_facts, raises
from made_model import MadeModel, along, wall
from sfm_inputs import mapping_here, run_place, write_inputs

from recon_cli.config.stages import SfmConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import ConfigError, SfmError
from recon_cli.io.colmap import read_images
from recon_cli.sfm import database
from recon_cli.sfm.results import FeaturesResult, MatchesResult
from recon_cli.stages import sfm
from recon_cli.workspace.steps import StepFolder
from recon_cli.workspace.summaries import PlaceSummary

# Two walks along two walls that have nothing in common.
LARGE, SMALL = 12, 10
MADE = MadeModel(
    np.concatenate([wall(-4, 10, count=500), wall(96, 110, count=500, seed=1)]),
    along([*np.arange(LARGE) * 0.5, *(np.arange(SMALL) * 0.5 + 100)]))
PARTS = (tuple(MADE.names[:LARGE]), tuple(MADE.names[LARGE:]))
HELD_OUT = ["000000.png", "000015.png", "000020.png"]


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """The folders of ingest and denoise; the pictures show nothing."""
    images = {name: np.full((400, 600, 3), 90, np.uint8) for name in MADE.names}
    return write_inputs(tmp_path_factory.mktemp("base"), images, fps=2, held_out=HELD_OUT)


def matched(out):
    """Leaves what a run leaves that was killed after it had matched the frames."""
    out.mkdir(parents=True)
    database.record_rows(MADE.write_database(out / "database.db"))
    log = StepFolder(out)
    log.finish("features", FeaturesResult(rows=0, keypoints=0, seconds=3.0, cpu_seconds=2.0))
    log.finish("matches", MatchesResult(
        rows=0, verified_pairs=0, matches=0, seconds=3.0, cpu_seconds=2.0))
    return out


def run(base, out, **options):
    """Maps what is there; all pairs are matched."""
    out.mkdir(exist_ok=True)
    with mapping_here():
        return sfm.run(SfmConfig(pairs="exhaustive", **options),
                       StageInputs({"ingest": base / "ingest"}), out, StageContext(threads=1))


@pytest.fixture(scope="module")
def mapped(base, tmp_path_factory):
    """(folder, summary) of a finished result of sfm."""
    out = matched(tmp_path_factory.mktemp("mapped") / "out")
    return out, run(base, out)


def place(base, mapped, out, **options):
    """Places a part of it in this process."""
    with mapping_here():
        return run_place(base, *mapped, out, **options)


@pytest.fixture(scope="module")
def first(base, mapped, tmp_path_factory):
    """(folder, summary) of its first part, placed."""
    out = tmp_path_factory.mktemp("first") / "out"
    return out, place(base, mapped, out)


def placed(out):
    return tuple(name for name, *_ in read_images(out / "sparse" / "images.bin"))


@pytest.mark.integration
def test_the_largest_part_is_placed_and_the_other_one_is_kept(mapped, first):
    found, summary = mapped[1], first[1]
    assert tuple(part.names for part in found.parts) == PARTS
    assert sorted(path.name for path in (mapped[0] / "parts").iterdir()) == ["1", "2"]
    assert {tuple(name for name, *_ in read_images(mapped[0] / "parts" / number / "images.bin"))
            for number in "12"} == set(PARTS)
    assert summary.part == 1
    assert summary.registered == LARGE
    assert placed(first[0]) == PARTS[0]
    assert summary.unregistered == PARTS[1]
    assert summary.unregistered_held_out == ("000015.png", "000020.png")
    assert not summary.apart
    assert not summary.left_out
    assert summary.trusted
    assert PlaceSummary.from_json(json.loads(json.dumps(summary.to_json()))) == summary


@pytest.mark.integration
def test_the_other_part_is_placed_from_the_same_models(mapped, first, base, tmp_path):
    before = {path: path.read_bytes() for path in mapped[0].rglob("*") if path.is_file()}
    taken = place(base, mapped, tmp_path / "out", part=2)
    assert placed(tmp_path / "out") == PARTS[1]
    assert taken.part == 2
    assert taken.parts == first[1].parts
    assert taken.registered == SMALL
    assert taken.unregistered == PARTS[0]
    assert taken.unregistered_held_out == ("000000.png",)
    assert taken.seconds == mapped[1].seconds
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    assert verdict["registered"] == SMALL
    assert before == {path: path.read_bytes() for path in mapped[0].rglob("*") if path.is_file()}
    assert not place(base, mapped, tmp_path / "out", gravity="off").world.evidence.up_found


@pytest.mark.integration
def test_a_part_that_there_is_not_is_refused_with_those_that_there_are(mapped, base, tmp_path):
    with pytest.raises(ConfigError) as refused:
        place(base, mapped, tmp_path / "out", part=3)
    assert_facts(refused.value.message, "part", 3, LARGE, SMALL)
    assert "recon sfm --part 2" in refused.value.hint


@pytest.mark.integration
def test_a_run_that_was_killed_ends_with_the_bytes_of_one_that_was_not(
    first, mapped, base, tmp_path
):
    out = tmp_path / "out"
    (out / "sparse").mkdir(parents=True)
    (out / "sparse" / "images.bin").write_bytes(b"begun")
    (out / "undistorted" / "images").mkdir(parents=True)
    (out / "undistorted" / "images" / "000020.png").write_bytes(b"of another part")
    place(base, mapped, out)
    names = [path.relative_to(out) for path in sorted(out.rglob("*")) if path.is_file()]
    assert names == [path.relative_to(first[0]) for path in sorted(first[0].rglob("*"))
                     if path.is_file()]
    assert not [name for name in names if (out / name).read_bytes() != (
        first[0] / name).read_bytes()]


@pytest.mark.integration
def test_parts_that_hold_too_few_frames_together_are_refused(base, tmp_path):
    assert len(run(base, matched(tmp_path / "few"), min_registered=1.0).parts) == 2
    with raises(SfmError, LARGE, LARGE + SMALL, "frames"):
        run(base, matched(tmp_path / "whole"), min_registered=0.6, partial=False)


@pytest.mark.integration
def test_the_notices_name_each_part_and_how_to_take_another_one(mapped, base, tmp_path, caplog):
    place(base, mapped, tmp_path / "out", part=2)
    for facts in (("2 parts", "part 2 is used"), ("recon sfm --part 1", "recon report"),
                  ("Part 1", f"{LARGE} of 22 frames", "000000.png to 000011.png (0.0 to 5.5 s)"),
                  ("Part 2", f"{SMALL} of 22 frames", "000012.png to 000021.png")):
        assert_facts(caplog.text, *facts)
    assert "000001.png has no camera" not in caplog.text  # it has one in the other part
