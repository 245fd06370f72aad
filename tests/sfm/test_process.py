"""The mapping process: its progress, its failures and its log."""

from contextlib import contextmanager
from types import SimpleNamespace

from recon_cli.sfm.job import Phase
from recon_cli.sfm.process import Monitor, last_error

GLOG = "I20260101 10:00:00.000001 139 timer.cc:90] Elapsed time: 0.1 [minutes]\n"


def written(tmp_path, text):
    path = tmp_path / "log.txt"
    path.write_text(text)
    return path


def test_the_last_error_of_a_log_is_its_gist(tmp_path):
    log = written(tmp_path, GLOG + (
        "E20260101 10:00:00.000002 139 images.cc:55] b.png BITMAP_ERROR: Failed to read.\n"
        "F20260101 10:00:00.000003 139 pose.cc:12] Check failed: x > 0\n") + GLOG)
    assert last_error(log) == "Check failed: x > 0"


def test_the_error_of_python_is_found(tmp_path):
    log = written(tmp_path, GLOG + (
        "Traceback (most recent call last):\n  File x, line 1\nMemoryError: no room\n"))
    assert last_error(log) == "MemoryError: no room"


def test_native_stack_frames_are_passed_over(tmp_path):
    log = written(tmp_path, GLOG + "free(): invalid pointer\n    @ 0x7f _Py_FatalErrorFormat\n")
    assert last_error(log) == "free(): invalid pointer"


def test_without_an_error_the_last_line_is_taken(tmp_path):
    assert last_error(written(tmp_path, GLOG)) == "Elapsed time: 0.1 [minutes]"


def test_an_empty_log_says_nothing(tmp_path):
    assert last_error(written(tmp_path, "")) == "nothing."


def test_only_the_end_of_a_long_log_is_read(tmp_path):
    assert last_error(written(tmp_path, "Error: long ago\n" + GLOG * 2000)) == (
        "Elapsed time: 0.1 [minutes]")


class Counted:
    """A progress whose bars add up what they are advanced by."""

    def __init__(self):
        self.total = self.done = 0

    @contextmanager
    def bar(self, label, total, *, unit="it", done=0):  # noqa: ARG002
        self.total, self.done = total, done
        yield self

    def advance(self, steps=1):
        self.done += steps


def test_masks_that_lie_on_the_disk_twice_do_not_take_the_bar_past_its_end(tmp_path):
    for folder in ("images", "denoised", "masks", "between/images"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "a.png").touch()
    shown = Counted()
    job = SimpleNamespace(names=("a.png",), steps=("undistorted",), undistorting=tmp_path)
    with Monitor(job, shown, lambda *_: None) as monitor:
        monitor.show(Phase("undistorted", 3, 0))
        monitor.show(None)
        assert (shown.done, shown.total) == (3, 3)
