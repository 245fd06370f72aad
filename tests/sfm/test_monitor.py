from contextlib import contextmanager
from types import SimpleNamespace

from recon_cli.sfm.job import Phase
from recon_cli.sfm.process import Monitor


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
