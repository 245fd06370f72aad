"""Fixtures that every test may use."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from browser import Watched, browser, watched
from playwright.sync_api import Browser

ROOT = Path(__file__).resolve().parents[1]
# Compiled kernels are kept from one run of the tests to the next, but not among the user's own.
os.environ.setdefault("RECON_CACHE_DIR", str(ROOT / ".pytest_cache" / "recon"))
# The triton backend is tested without a GPU too, by its interpreter; kernels ask at their import.
if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")
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


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """Headless Chromium, started once for all tests."""
    with browser() as started:
        yield started


@pytest.fixture
def page(chromium: Browser) -> Iterator[Watched]:
    """A fresh page that remembers what its console said."""
    with watched(chromium) as kept:
        yield kept
