"""A folder of steps says what is finished, for which key, and what was damaged since."""

import json
from dataclasses import dataclass

import pytest
from facts import raises

from recon_cli.workspace.json_record import JsonRecord
from recon_cli.workspace.steps import LOG, StepFolder

STEPS = ("features", "matches", "model", "sparse", "undistorted")


@dataclass(frozen=True)
class Counted(JsonRecord):
    rows: int


@dataclass(frozen=True)
class Named(JsonRecord):
    names: tuple[str, ...]


@pytest.fixture
def finished(tmp_path):
    """A folder in which all steps are finished."""
    work = StepFolder(tmp_path)
    for step in STEPS[:2]:
        work.finish(step, Counted(rows=3))
    for step in STEPS[2:]:
        (tmp_path / step / "images").mkdir(parents=True)
        (tmp_path / step / "images" / "a.bin").write_bytes(b"12345")
        work.finish(step, Named(names=(step,)), [tmp_path / step])
    return tmp_path


def done(folder, **key):
    return [step for step in STEPS if StepFolder(folder, **key).is_finished(step)]


def without(*steps):
    return [step for step in STEPS if step not in steps]


def test_results_are_read_back_by_the_next_process(finished):
    assert StepFolder(finished).find("features", Counted) == Counted(rows=3)
    assert StepFolder(finished).find("undistorted", Named).names == ("undistorted",)
    assert StepFolder(finished).result("matches") == {"rows": 3}


def test_a_result_of_another_version_is_as_good_as_none(finished):
    assert StepFolder(finished).find("features", Named) is None


def test_an_empty_folder_has_nothing_finished(tmp_path):
    assert done(tmp_path) == []
    assert not StepFolder(tmp_path).steps
    assert StepFolder(tmp_path).find_damage() == ""


def test_a_step_counts_for_its_key_alone(tmp_path):
    StepFolder(tmp_path, key="a").finish("features")
    assert StepFolder(tmp_path, key="a").is_finished("features")
    assert not StepFolder(tmp_path, key="b").steps
    StepFolder(tmp_path, key="b").forget("features")
    assert done(tmp_path, key="a") == ["features"]
    StepFolder(tmp_path, key="b").finish("features")
    assert done(tmp_path, key="a") == []


def test_the_digest_of_steps_changes_with_what_they_found_and_left(finished):
    digests = {StepFolder(finished).digest("features", "model")}
    for change in (lambda work: work.finish("features", Counted(rows=4)),
                   lambda work: work.finish("model", Named(names=("model",))),
                   lambda work: work.forget("features")):
        change(StepFolder(finished))
        digests.add(StepFolder(finished).digest("features", "model"))
    assert len(digests) == 4


def test_a_missing_file_takes_its_step_back(finished):
    (finished / "sparse" / "images" / "a.bin").unlink()
    assert done(finished) == without("sparse")
    assert StepFolder(finished).find_damage() == "sparse"


def test_a_file_cut_short_takes_its_step_back(finished):
    (finished / "undistorted" / "images" / "a.bin").write_bytes(b"123")
    assert done(finished) == without("undistorted")


def test_a_file_that_grew_takes_its_step_back(finished):
    (finished / "sparse" / "images" / "a.bin").write_bytes(b"123456")
    assert done(finished) == without("sparse")
    assert StepFolder(finished).find_damage() == "sparse"
    assert not StepFolder(finished).is_intact("sparse")


def test_a_flipped_byte_is_found_before_a_step_is_believed(finished):
    assert StepFolder(finished).find_damage() == ""
    assert StepFolder(finished).is_intact("sparse")
    (finished / "sparse" / "images" / "a.bin").write_bytes(b"12375")
    assert StepFolder(finished).find_damage() == "sparse"
    assert not StepFolder(finished).is_intact("sparse")


def test_a_step_leaves_files_besides_its_folder(tmp_path):
    (tmp_path / "verdict.json").write_text("{}")
    StepFolder(tmp_path).finish("model", Counted(rows=7), [
        tmp_path / "verdict.json", tmp_path / "none.json"])
    assert StepFolder(tmp_path).find_damage() == ""
    (tmp_path / "verdict.json").write_text("[]")
    assert StepFolder(tmp_path).find_damage() == "model"


@pytest.mark.parametrize("damage", [
    lambda log: log.unlink(), lambda log: log.write_text('{"features": \n'),
    lambda log: log.write_text(log.read_text().replace('"rows": 3', '"rows": 4', 1))])
def test_a_log_that_is_missing_or_was_changed_proves_nothing(finished, damage):
    damage(finished / LOG)
    with raises(ValueError, LOG):
        StepFolder(finished).refuse_damaged_log()
    assert "features" not in done(finished)
    StepFolder(finished).finish("features", Counted(rows=5))
    assert StepFolder(finished).find("features", Counted) == Counted(rows=5)


def test_a_damaged_line_voids_all_before_it(finished):
    log = finished / LOG
    log.write_text(log.read_text().replace('"matches"', '"Matches"', 1))
    assert done(finished) == ["model", "sparse", "undistorted"]


def test_half_a_line_counts_for_nothing_and_the_next_one_stands(finished):
    log = finished / LOG
    log.write_bytes(log.read_bytes()[:-9])
    assert done(finished) == without("undistorted")
    assert StepFolder(finished).find_damage() == ""
    StepFolder(finished).finish("undistorted", Named(names=()))
    assert done(finished) == list(STEPS)


def test_a_step_can_be_taken_back_and_finished_again(finished):
    StepFolder(finished).forget("matches", "model", "none")
    assert done(finished) == without("matches", "model")
    StepFolder(finished).finish("matches", Counted(rows=5))
    assert StepFolder(finished).find("matches", Counted) == Counted(rows=5)


def test_each_line_is_json_that_other_programs_read(finished):
    lines = [json.loads(line) for line in (finished / LOG).read_text().splitlines()]
    assert [line["step"] for line in lines] == list(STEPS)
