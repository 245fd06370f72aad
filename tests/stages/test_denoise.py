import errno
import json
import os

import numpy as np
import pytest
from facts import raises

from recon_cli.config.stages import DenoiseConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.errors import FormatError
from recon_cli.io.images import read_png, write_png
from recon_cli.stages import denoise
from recon_cli.workspace.records import Frame, FrameList, Group

SIGMAS = {"000000.png": 0, "000004.png": 15, "000008.png": 0, "000012.png": 8}


def room():
    """Plain walls with an edge and a textured corner, [120, 160, 3]."""
    y, x = np.mgrid[:120, :160]
    picture = np.stack([90 + 0.4 * x, 110 + 0.3 * y, 150 - 0.2 * x], axis=-1)
    picture[70:, 40:90] = (60, 90, 160)
    picture[:30, :40] = np.kron(
        np.random.default_rng(1).integers(40, 200, (10, 10, 3)), np.ones((3, 4, 1)))
    return np.round(picture).astype(np.uint8)


def psnr(rgb, truth):
    return 10 * np.log10(255**2 / np.mean((rgb.astype(float) - truth) ** 2))


@pytest.fixture
def ingest(tmp_path):
    """A finished ingest folder with two clean and two noisy frames."""
    folder = tmp_path / "ingest"
    (folder / "frames").mkdir(parents=True)
    noise = np.random.default_rng(0)
    for name, sigma in SIGMAS.items():
        spoiled = room() + noise.normal(0, sigma, room().shape) if sigma else room()
        write_png(
            folder / "frames" / name, np.clip(np.round(spoiled), 0, 255).astype(np.uint8))
    frames = tuple(Frame(name, None, "room.mp4", None, False) for name in SIGMAS)
    FrameList("video", (Group("room.mp4", 160, 120),), frames).write(folder)
    return folder


def run(ingest, out, *, threads=2, record=None, **options):
    out.mkdir(exist_ok=True)
    ctx = StageContext(threads=threads, **({"record": record} if record else {}))
    return denoise.run(
        DenoiseConfig(**options), StageInputs(folders={"ingest": ingest}), out, ctx)


def files(out):
    """Every file of a folder with its bytes."""
    return {
        str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*") if path.is_file()}


def same(ingest, out, name):
    return (ingest / "frames" / name).read_bytes() == (out / "frames" / name).read_bytes()


def test_clean_frames_stay_byte_identical_and_noisy_ones_come_closer_to_the_truth(
        ingest, tmp_path):
    out = tmp_path / "out"
    summary = run(ingest, out)
    for name, sigma in SIGMAS.items():
        assert same(ingest, out, name) == (sigma == 0)
        if sigma:
            before = psnr(read_png(ingest / "frames" / name), room())
            assert psnr(read_png(out / "frames" / name), room()) > before + 4
    assert (summary.mode, summary.frames, summary.denoised) == ("auto", 4, 2)


def test_the_noise_of_each_frame_is_written_down(ingest, tmp_path):
    summary = run(ingest, tmp_path / "out")
    noise = json.loads((tmp_path / "out" / "noise.json").read_text())
    assert list(noise) == list(SIGMAS)
    for name, sigma in SIGMAS.items():
        assert noise[name]["denoised"] == (sigma > 0)
        assert noise[name]["sigma_255"] == pytest.approx(sigma, rel=0.2, abs=1)
    assert summary.median_sigma_255 == pytest.approx(
        np.median([entry["sigma_255"] for entry in noise.values()]), abs=1e-4)


def test_a_copy_is_no_link(ingest, tmp_path):
    run(ingest, tmp_path / "out", mode="off")
    original = (ingest / "frames" / "000000.png").read_bytes()
    (tmp_path / "out" / "frames" / "000000.png").write_bytes(b"edited")
    assert (ingest / "frames" / "000000.png").read_bytes() == original


def test_off_passes_everything_through(ingest, tmp_path):
    summary = run(ingest, tmp_path / "out", mode="off")
    assert all(same(ingest, tmp_path / "out", name) for name in SIGMAS)
    assert summary.denoised == 0
    assert summary.median_sigma_255 > 0


def test_force_filters_everything(ingest, tmp_path):
    summary = run(ingest, tmp_path / "out", mode="force")
    assert not any(same(ingest, tmp_path / "out", name) for name in SIGMAS)
    assert summary.denoised == 4


def test_the_threshold_decides(ingest, tmp_path):
    summary = run(ingest, tmp_path / "out", threshold=11.0)
    assert summary.denoised == 1
    assert same(ingest, tmp_path / "out", "000012.png")


def test_strength_sets_how_much_is_smoothed(ingest, tmp_path):
    change = []
    for strength in (1.0, 4.0):
        run(ingest, tmp_path / str(strength), strength=strength)
        filtered = read_png(tmp_path / str(strength) / "frames" / "000004.png").astype(float)
        change.append(np.abs(filtered - read_png(ingest / "frames" / "000004.png")).mean())
    assert change[0] < change[1]


def test_the_number_of_threads_changes_nothing(ingest, tmp_path):
    run(ingest, tmp_path / "one", threads=1)
    run(ingest, tmp_path / "four", threads=4)
    assert files(tmp_path / "one") == files(tmp_path / "four")


@pytest.mark.parametrize("kind", ["interrupt", "full disk"])
def test_a_run_that_broke_off_goes_on_where_it_was_and_ends_the_same(
        ingest, tmp_path, monkeypatch, kind):
    run(ingest, tmp_path / "whole")
    flush, calls = os.fsync, []

    def failing(descriptor):
        calls.append(descriptor)
        if len(calls) > 2:
            raise KeyboardInterrupt if kind == "interrupt" else OSError(errno.ENOSPC, "full")
        flush(descriptor)

    monkeypatch.setattr(os, "fsync", failing)
    with pytest.raises(KeyboardInterrupt if kind == "interrupt" else OSError):
        run(ingest, tmp_path / "again", threads=1)
    monkeypatch.setattr(os, "fsync", flush)
    frames = tmp_path / "again" / "frames"
    before = {path.name: path.stat().st_mtime_ns for path in frames.iterdir()}
    assert len(before) == 2
    run(ingest, tmp_path / "again")
    assert files(tmp_path / "again") == files(tmp_path / "whole")
    assert {name: (frames / name).stat().st_mtime_ns for name in before} == before


def test_progress_is_recorded(ingest, tmp_path):
    seen = []
    run(ingest, tmp_path / "out", record=lambda done, total: seen.append((done, total)))
    assert seen[-1] == (4, 4)


def test_an_ingest_folder_that_misses_a_frame_is_an_error(ingest, tmp_path):
    (ingest / "frames" / "000004.png").write_bytes(b"")
    with raises(FormatError, "000004.png"):
        run(ingest, tmp_path / "out")
