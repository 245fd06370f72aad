"""Fixtures, markers and Hypothesis profiles that every test may use.

torch and playwright are imported by the tests that need them, not here: a run of a few light tests
starts at once.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from examples import load_profile
from filelock import FileLock

if TYPE_CHECKING:
    from browser import WatchedPage
    from playwright.sync_api import Browser

    from recon_cli.sfm.features.xfeat import Network

ROOT = Path(__file__).resolve().parents[1]
# Compiled kernels are kept from one run of the tests to the next, but not among the user's own.
os.environ.setdefault("RECON_CACHE_DIR", str(ROOT / ".pytest_cache" / "recon"))
if "PYTEST_XDIST_WORKER" in os.environ:  # as many workers as cores: one thread each
    os.environ.setdefault("OMP_NUM_THREADS", "1")
# A shell lets what it runs in the background ignore Ctrl-C, and every process below inherits that.
signal.signal(signal.SIGINT, signal.default_int_handler)
load_profile()
HEAVY = ("integration", "browser", "compile", "slow")  # markers that `make test` leaves out
_running: list[pytest.Item] = []  # the test that runs


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks every test that opens a page or looks at a process that compiled kernels."""
    for item in items:
        fixtures = set(getattr(item, "fixturenames", ()))
        if "chromium" in fixtures:
            item.add_marker(pytest.mark.browser)
        if fixtures & {"damaged_run", "repaired_run", "avx2_run"}:
            item.add_marker(pytest.mark.compile)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Lets only tests with a marker start programs: the others are for every change of a line."""
    _running.append(item)
    try:
        return (yield)
    finally:
        _running.clear()


@sys.addaudithook
def _refuse_programs(event: str, arguments: tuple[object, ...]) -> None:
    # Python alone: `platform` asks `uname` once in each process, whichever test is the first
    if event == "subprocess.Popen" and arguments[0] == sys.executable and _running and not any(
            map(_running[0].get_closest_marker, HEAVY)):
        pytest.fail("This test starts a program: mark it `integration`.")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport() -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Escapes names that are no UTF-8 in what a test logged: workers send reports as UTF-8."""
    report = yield
    report.sections = [
        (title, text.encode("utf-8", "backslashreplace").decode())
        for title, text in report.sections]
    return report


@pytest.fixture(scope="session")
def _initial_threads() -> int | None:
    """Torch's number of threads before any test; None where no module of tests imports it."""
    torch = sys.modules.get("torch")
    return None if torch is None else int(torch.get_num_threads())


@pytest.fixture(autouse=True)
def _own_threads(_initial_threads: int | None) -> Iterator[None]:
    """Gives every test torch's initial number of threads: sums of torch depend on it.

    A number that was set in another thread, such as a viewer's, does not show in this one, but new
    threads get it.
    """
    yield
    if _initial_threads is not None:
        sys.modules["torch"].set_num_threads(_initial_threads)


@pytest.fixture(scope="session", autouse=True)
def _unflushed() -> Iterator[None]:
    """Lets no test wait for the disk: none cuts the power. What is closed is still refused."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: os.fstat(file) and None)
        yield


@pytest.fixture(scope="session")
def build_once(
    tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str, Callable[[Path], object]], Path]:
    """Returns a folder by name, which one function fills once for all workers; copy, never write.

    The function gets the empty folder. A failure is the failure of every test that asks.
    """
    base = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        base = base.parent  # of all workers

    def build(name: str, fill: Callable[[Path], object]) -> Path:
        folder, filled = base / f"shared-{name}", base / f"shared-{name}.filled"
        with FileLock(f"{folder}.lock"):
            if not filled.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                filled.touch()
        return folder

    return build


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real captures and rendered rooms, which does not travel with the project."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the captures in ../shared/data are not here")
    return folder


@pytest.fixture(scope="session")
def learned_weights(build_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """A folder for RECON_CACHE_DIR with the weights that `recon setup bridge` downloads."""
    from recon_cli import cli

    def fill(folder: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("RECON_CACHE_DIR", str(folder))
            assert cli.main(["setup", "bridge"]) == 0

    return build_once("weights", fill)


@pytest.fixture
def learned_network(learned_weights: Path, monkeypatch: pytest.MonkeyPatch) -> Network:
    """XFeat with these weights."""
    from recon_cli.sfm.features import xfeat, xfeat_weights

    monkeypatch.setenv("RECON_CACHE_DIR", str(learned_weights))
    weights = xfeat_weights.load_weights()
    assert weights is not None
    return xfeat.Network(weights)


@pytest.fixture(scope="session")
def sample_video() -> Path:
    """The room video that comes with the package."""
    return ROOT / "recon_cli" / "samples" / "room.mp4"


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """Headless Chromium, started once for all tests of a worker."""
    from browser import launch_browser

    with launch_browser() as browser:
        yield browser


@pytest.fixture
def page(chromium: Browser) -> Iterator[WatchedPage]:
    """A fresh page that records what its console said."""
    from browser import watch_page

    with watch_page(chromium) as watched_page:
        yield watched_page
