"""Machine code for which the disk has no room."""

import errno
import os

import pytest

from recon_cli.kernels import kernel


@pytest.fixture
def full(monkeypatch, tmp_path):
    monkeypatch.setattr(kernel, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(kernel, "unsaved", [])

    def fail(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(kernel._CheckedFiles, "save", fail)


@pytest.mark.usefixtures("full")
def test_a_kernel_runs_where_it_cannot_be_kept_and_that_is_said_once(caplog):
    double = kernel.kernel(lambda value: 2 * value)
    assert (double(3), double(2.5)) == (6, 5.0)
    assert len(kernel.unsaved) == 2
    (record,) = caplog.records
    assert "RECON_CACHE_DIR" in record.getMessage()
