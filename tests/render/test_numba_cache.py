"""Machine code on disk: found by the next process, for this CPU alone, never trusted blindly."""

import logging
import os
import platform
import threading
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from facts import assert_facts
from numba_process import STATISTICS, picture
from numba_runs import HASWELL

from recon_cli.kernels import kernel, simd
from recon_cli.kernels.thread_pool import pool
from recon_cli.pipeline.execute import Job, stage_context
from recon_cli.render import registry
from recon_cli.render.numba import backend
from recon_cli.stages import STAGES
from recon_cli.workspace.layout import Workspace

# float32 against float32 in another order of operations; the backends' own bounds, see backends.py
IMAGE_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 1e-4
# a fragment at alpha = 1/255 may be in or out by rounding, which is one hit more or less
HITS_APART = 1e-3  # of all hits of the scene


@pytest.fixture
def fresh_folder(monkeypatch):
    """Lets `cache_folder` look again, and forgets afterwards what it found."""
    kernel.cache_folder.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    kernel.cache_folder.cache_clear()


def assert_same_picture(ours, theirs):
    for name in ("rgb", "alpha", "depth"):
        scale = max(1.0, np.abs(theirs[name]).max())
        assert np.abs(ours[name] - theirs[name]).max() < IMAGE_TOLERANCE * scale, name
    hits = ours["stat.hits"] - theirs["stat.hits"]
    assert np.abs(hits).sum() <= HITS_APART * theirs["stat.hits"].sum()
    # one backend may cull, and leave a radius of 0, where the other finds no pixel to draw
    seen = (ours["stat.radii"] > 0) & (theirs["stat.radii"] > 0)
    assert np.allclose(ours["stat.radii"][seen], theirs["stat.radii"][seen], rtol=IMAGE_TOLERANCE)
    for name in theirs.keys() - {"rgb", "alpha", "depth", "stat.hits", "stat.radii"}:
        apart = np.linalg.norm(ours[name] - theirs[name])
        assert apart < GRADIENT_TOLERANCE * np.linalg.norm(theirs[name]), name


# ---- from process to process ----

def test_a_damaged_cache_is_noticed_and_compiled_again(damaged_run):
    assert_facts(damaged_run.stderr, "damaged", "compiling", "again")
    assert damaged_run.report["folder"] in damaged_run.stderr
    assert set(damaged_run.report["misses"].values()) == {1}
    assert damaged_run.report["is_warm"]


def test_the_next_process_finds_every_kernel_and_compiles_nothing(repaired_run):
    assert repaired_run.report["was_warm"]
    assert set(repaired_run.report["hits"].values()) == {1}
    assert set(repaired_run.report["misses"].values()) == {0}
    assert "kernels" not in repaired_run.stderr


def test_machine_code_from_the_cache_computes_the_same_bits(
        damaged_run, repaired_run):
    compiled, loaded = damaged_run.picture, repaired_run.picture
    for name, value in compiled.items():
        assert np.array_equal(value, loaded[name]), name


def test_the_progress_counts_every_kernel_that_threads_share(damaged_run, repaired_run):
    for run in (damaged_run, repaired_run):
        assert run.report["kernels_ready"] == backend.KERNELS


# ---- another CPU ----

def test_code_for_another_cpu_is_kept_apart(avx2_run):
    assert Path(avx2_run.report["folder"]).name != kernel.fingerprint()
    assert not avx2_run.report["was_warm"]
    assert avx2_run.report["is_warm"]


def test_eight_lanes_compute_the_picture_of_sixteen(avx2_run):
    assert (avx2_run.report["lanes"], avx2_run.report["tile"]) == (8, [16, 16])
    assert_same_picture(avx2_run.picture, picture("numba"))


def test_eight_lanes_compute_the_picture_of_the_torch_backend(avx2_run):
    assert {name for name in avx2_run.picture if name.startswith("stat.")} == {
        f"stat.{name}" for name in STATISTICS}
    assert_same_picture(avx2_run.picture, picture("torch"))


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="names of x86 CPUs")
def test_name_and_features_of_the_cpu_change_the_fingerprint(monkeypatch):
    here = kernel.fingerprint()
    monkeypatch.setattr(kernel.config, "CPU_NAME", "nocona")
    named = kernel.fingerprint()
    monkeypatch.setattr(kernel.config, "CPU_FEATURES", HASWELL["NUMBA_CPU_FEATURES"])
    assert len({here, named, kernel.fingerprint()}) == 3


@pytest.mark.parametrize(("features", "width"), [
    ("+avx2,+fma", 8), ("+avx2,+avx512f", 16), ("-avx512f", 8), ("", 8)])
def test_the_number_of_lanes_follows_the_features_that_numba_compiles_for(
        monkeypatch, features, width):
    monkeypatch.setattr(simd.config, "CPU_FEATURES", features)
    assert simd.vector_width() == width


def test_a_change_of_any_source_changes_the_fingerprint(monkeypatch):
    seen, read = {kernel.fingerprint()}, Path.read_bytes
    package = Path(kernel.__file__).parents[1]
    sources = [*package.glob("kernels/*.py"), *package.glob("render/numba/*.py"),
               package / "render" / "contract.py"]
    for changed in sources:
        monkeypatch.setattr(
            Path, "read_bytes", lambda path, changed=changed: read(path) + b"#" * (path == changed))
        seen.add(kernel.fingerprint())
    assert len(seen) == 1 + len(sources)


def test_another_version_of_numba_changes_the_fingerprint(monkeypatch):
    here = kernel.fingerprint()
    monkeypatch.setattr(kernel.numba, "__version__", "0.0.1")
    assert kernel.fingerprint() != here


# ---- folders that cannot or must not be used ----

def test_without_a_place_for_a_cache_kernels_are_compiled_and_run(fresh_folder, tmp_path, caplog):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    fresh_folder.setenv("RECON_CACHE_DIR", str(blocked / "cache"))

    with caplog.at_level(logging.WARNING, "recon"):
        compiled = kernel.kernel(double)
    assert "RECON_CACHE_DIR" in caplog.text
    assert not backend.is_warm()
    values = np.ones(3, np.float32)
    compiled(values)
    assert values.tolist() == [2, 2, 2]


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() == 0, reason="root may write anywhere")
def test_a_read_only_folder_is_not_used(fresh_folder, tmp_path, caplog):
    tmp_path.chmod(0o555)
    fresh_folder.setenv("RECON_CACHE_DIR", str(tmp_path / "cache"))
    with caplog.at_level(logging.WARNING, "recon"):
        assert kernel.cache_folder() is None
    tmp_path.chmod(0o755)
    assert "RECON_CACHE_DIR" in caplog.text


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners and modes on this system")
@pytest.mark.parametrize("mode", [0o770, 0o702])
def test_a_folder_that_others_can_write_is_refused(fresh_folder, tmp_path, caplog, mode):
    fresh_folder.setenv("RECON_CACHE_DIR", str(tmp_path))
    folder = tmp_path / "kernels" / kernel.fingerprint()
    folder.mkdir(parents=True)
    folder.chmod(mode)
    with caplog.at_level(logging.WARNING, "recon"):
        assert kernel.cache_folder() is None
    assert_facts(caplog.text, folder, "others")
    assert "RECON_CACHE_DIR" in caplog.text


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners and modes on this system")
def test_a_new_folder_is_open_to_its_owner_alone(fresh_folder, tmp_path):
    fresh_folder.setenv("RECON_CACHE_DIR", str(tmp_path))
    folder = kernel.cache_folder()
    assert folder == tmp_path / "kernels" / kernel.fingerprint()
    assert folder.stat().st_mode & 0o077 == 0


# ---- damage, without the time to compile ----

def double(values):
    for i in range(len(values)):
        values[i] *= 2


def negate(values):
    for i in range(len(values)):
        values[i] = -values[i]


def doubled():
    """What the kernel makes of ones, and how often it was compiled for that."""
    compiled, values = kernel.kernel(double), np.ones(3, np.float32)
    compiled(values)
    return values.tolist(), sum(compiled.stats.cache_misses.values())


def flip(at):
    def change(path, _other):
        data = bytearray(path.read_bytes())
        data[at] ^= 1
        path.write_bytes(data)

    return change


@pytest.mark.integration
@pytest.mark.parametrize("damage", [
    flip(0), flip(40), flip(-1), flip(-2000), lambda path, _: path.write_bytes(b""),
    lambda path, _: os.truncate(path, 20), lambda path, _: os.truncate(path, 500),
    lambda path, _: path.write_bytes(path.read_bytes() + b"more"),
    lambda path, other: path.write_bytes(other.read_bytes())],
    ids=["digest", "head", "end", "code", "empty", "no digest", "cut", "longer", "another kernel"])
def test_a_damaged_file_is_not_loaded_but_compiled_again_with_a_notice(
        fresh_folder, tmp_path, caplog, damage):
    fresh_folder.setenv("RECON_CACHE_DIR", str(tmp_path))
    kernel.kernel(negate)(np.ones(3, np.float32))
    other, = tmp_path.rglob(f"*{kernel.CODE}")
    with caplog.at_level(logging.WARNING, "recon"):
        assert doubled() == ([2, 2, 2], 1)
        assert doubled() == ([2, 2, 2], 0)
        path, = set(tmp_path.rglob(f"*{kernel.CODE}")) - {other}
        assert not caplog.records
        damage(path, other)
        assert doubled() == ([2, 2, 2], 1)
    assert str(path) in caplog.text
    assert doubled() == ([2, 2, 2], 0)
    assert len(caplog.records) == 1


def test_a_fault_of_the_kernels_themselves_is_no_damage(fresh_folder, tmp_path, monkeypatch):
    fresh_folder.setenv("RECON_CACHE_DIR", str(tmp_path))

    bug = ValueError()

    def run_all():
        raise bug

    monkeypatch.setattr(backend, "_run_all", run_all)
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        backend.warm_up()
    assert caught.value is bug
    assert not backend.is_warm()


# ---- what the user sees ----

class Bars:
    """A progress that remembers its bars."""

    def __init__(self):
        self.opened, self.steps = [], 0

    @contextmanager
    def bar(self, label, total, *, unit="it", done=0):
        assert done == 0
        self.opened.append((label, total, unit))
        yield self

    def advance(self, steps=1):
        self.steps += steps


def prepare_stage(tmp_path, monkeypatch):
    monkeypatch.setattr(pool, "threads", 1)
    bars = Bars()
    row = next(row for row in STAGES if row.name == "train")
    stage_context(Job(Workspace(tmp_path), progress=bars), row, lambda *_: None)
    return bars


def test_a_cold_start_shows_a_bar_and_says_how_long_it_took(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(registry, "kernels_to_compile", lambda _: backend.KERNELS)
    with caplog.at_level(logging.INFO, "recon"):
        bars = prepare_stage(tmp_path, monkeypatch)
    assert bars.opened == [("compile for this CPU, once", backend.KERNELS, "kernel")]
    assert bars.steps == backend.KERNELS
    assert_facts(caplog.text, "kernels", "compiled")


def test_a_warm_start_shows_no_bar(tmp_path, monkeypatch):
    monkeypatch.setattr(backend, "is_warm", lambda: True)
    prepared = []
    monkeypatch.setattr(backend, "warm_up", lambda on_kernel: prepared.append(on_kernel) or 0.0)
    assert prepare_stage(tmp_path, monkeypatch).opened == []
    assert len(prepared) == 1  # what is in the cache may be damaged: it is looked at first
    monkeypatch.setattr(backend, "is_warm", lambda: False)
    assert registry.kernels_to_compile("numba") == backend.KERNELS
    assert registry.kernels_to_compile("torch") == 0


# ---- two processes and one folder ----

def test_while_another_process_compiles_its_progress_is_shown_and_nothing_runs(
        fresh_folder, tmp_path, monkeypatch):
    fresh_folder.setenv("RECON_CACHE_DIR", str(tmp_path))
    folder = kernel.cache_folder()
    monkeypatch.setattr(backend, "POLL_SECONDS", 0.01)
    ran, counted = [], threading.Semaphore(0)
    monkeypatch.setattr(backend, "_run_all", lambda: ran.append(folder))
    with backend._writing(folder):
        waiting = threading.Thread(target=backend.warm_up, args=(counted.release,))
        waiting.start()
        (folder / "composite.nbc").touch()
        assert counted.acquire(timeout=20)
        assert not ran
        assert not counted.acquire(blocking=False)
    waiting.join(20)
    assert ran == [folder]
    assert backend.is_warm()


def test_an_installation_at_another_time_compiles_anew(monkeypatch):
    # numba does so whatever the digest says, and it must not be taken for warm
    here = kernel.fingerprint()
    stat = Path.stat

    def stat_later(path, **options):
        status = stat(path, **options)
        return SimpleNamespace(st_mode=status.st_mode, st_mtime_ns=status.st_mtime_ns + 1)

    monkeypatch.setattr(Path, "stat", stat_later)
    assert kernel.fingerprint() != here
