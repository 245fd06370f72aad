import pytest

from recon_cli.sfm.step_log import FILE, STEPS, Ledger, fresh_folder, publish


@pytest.fixture
def finished(tmp_path):
    """A folder in which all steps are finished."""
    ledger = Ledger(tmp_path)
    for step in ("features", "matches"):
        ledger.finish(step, {"rows": 3})
    for step in ("model", "sparse", "undistorted"):
        (tmp_path / step / "images").mkdir(parents=True)
        (tmp_path / step / "images" / "a.bin").write_bytes(b"12345")
        ledger.finish(step, {"points": 7}, tmp_path / step)
    return tmp_path


def done(folder):
    ledger = Ledger(folder)
    return [step for step in STEPS if ledger.result(step) is not None]


def test_results_are_read_back_by_the_next_process(finished):
    assert Ledger(finished).result("features") == {"rows": 3}
    assert Ledger(finished).result("undistorted") == {"points": 7}


def test_an_empty_folder_has_nothing_finished(tmp_path):
    assert done(tmp_path) == []


def test_a_missing_file_takes_its_step_back(finished):
    (finished / "sparse" / "images" / "a.bin").unlink()
    assert done(finished) == ["features", "matches", "model", "undistorted"]


def test_a_file_cut_short_takes_its_step_back(finished):
    (finished / "undistorted" / "images" / "a.bin").write_bytes(b"123")
    assert done(finished) == ["features", "matches", "model", "sparse"]


def test_files_without_a_note_prove_nothing(finished):
    (finished / FILE).unlink()
    assert done(finished) == []


def test_a_note_that_cannot_be_read_proves_nothing(finished):
    (finished / FILE).write_text('{"features": ')
    assert done(finished) == []


def test_what_builds_on_a_forgotten_step_is_forgotten_too(finished):
    Ledger(finished).forget_from("matches")
    assert done(finished) == ["features"]


def test_publishing_replaces_what_an_interrupted_run_left(tmp_path):
    target = tmp_path / "sparse"
    (target / "old").mkdir(parents=True)
    work = fresh_folder(tmp_path / "sparse.partial")
    (work / "new.bin").write_bytes(b"1")
    publish(work, target)
    assert [path.name for path in target.iterdir()] == ["new.bin"]
    assert not work.exists()


def test_a_fresh_folder_is_empty(tmp_path):
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "left.png").write_bytes(b"1")
    assert list(fresh_folder(tmp_path / "work").iterdir()) == []
