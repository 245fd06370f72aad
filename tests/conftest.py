"""Fixtures that every test may use."""

import os
import signal
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# Compiled kernels are kept from one run of the tests to the next, but not among the user's own.
os.environ.setdefault("RECON_CACHE_DIR", str(ROOT / ".pytest_cache" / "recon"))
# A shell lets what it runs in the background ignore Ctrl-C, and every process below inherits that.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real captures and rendered rooms, which does not travel with the project."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the captures in ../shared/data are not here")
    return folder


@pytest.fixture(scope="session")
def sample_video() -> Path:
    """The room video that comes with the package."""
    return ROOT / "recon_cli" / "samples" / "room.mp4"
