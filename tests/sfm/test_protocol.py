import errno
import io

import pytest

from recon_cli.errors import FormatError, SfmError, WorkspaceError
from recon_cli.sfm.job import Done, Failed, Phase, Reporter, parse


def sent(say):
    """What the parent understands of what `say` told a reporter."""
    stream = io.BytesIO()
    say(Reporter(stream))
    line, = stream.getvalue().splitlines()
    return parse(line)


def test_phases_and_counts_arrive():
    assert sent(lambda report: report.phase("matches", 78, done=3)) == Phase("matches", 78, 3)
    assert sent(lambda report: report.done(5)) == Done(5)


@pytest.mark.parametrize("kind", [SfmError, FormatError, WorkspaceError])
def test_an_error_arrives_as_what_it_was(kind):
    event = sent(lambda report: report.failed(kind("No features.\nReally.", hint="Try again.")))
    assert isinstance(event, Failed)
    assert type(event.error) is kind
    assert (event.error.message, event.error.hint) == ("No features.\nReally.", "Try again.")


def test_a_full_disk_arrives_as_a_full_disk():
    full = OSError(errno.ENOSPC, "No space left on device", "/out/sparse")
    event = sent(lambda report: report.failed(full))
    assert isinstance(event.error, OSError)
    assert event.error.errno == errno.ENOSPC
    assert event.error.filename == "/out/sparse"
