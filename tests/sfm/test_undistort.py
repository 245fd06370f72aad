"""Undistortion of frames, their twins and masks."""

import io
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from facts import assert_facts
from sfm_inputs import texture
from synthetic import make_capture, place_job

from recon_cli.io.images import read_png, write_png
from recon_cli.sfm.job import Phase, Reporter, parse
from recon_cli.sfm.views import undistort
from recon_cli.sfm.views.flat_views import covered_share

WIDTH, HEIGHT = 120, 90


@pytest.fixture
def mapped(tmp_path):
    """A job with a model of six images, whose frames lie there; the second is denoised."""
    job, model = make_capture(tmp_path, frames=6)
    for camera in model.cameras.values():
        camera.rescale(WIDTH, HEIGHT)
    (tmp_path / "denoised").mkdir()
    for seed, name in enumerate(job.names):
        for folder in ("frames", "denoised"):
            shown = texture(HEIGHT, WIDTH, seed)
            write_png(tmp_path / folder / name, shown // 2 if (folder, seed) == (
                "denoised", 1) else shown)
    return place_job(job, denoised=tmp_path / "denoised"), model


def run(job, model, params=(), report=None):
    """Undistorts with these distortion parameters; returns the folder."""
    for camera in model.cameras.values():
        camera.params = [*camera.params[:4], *(params or (0, 0, 0, 0))]
    (job.out / "sparse").mkdir()
    model.write(job.out / "sparse")
    undistort.undistort(job, report or Reporter(io.BytesIO()))
    return job.out / "undistorted"


def test_frames_without_distortion_keep_their_pixels(mapped):
    job, model = mapped
    out = run(job, model)
    for name in job.names:
        np.testing.assert_array_equal(read_png(out / "images" / name), read_png(job.frames / name))


def test_distorted_frames_become_what_colmap_makes_of_them(mapped):
    job, model = mapped
    out = run(job, model, (-0.15, 0.03, 0.002, -0.001))
    pycolmap.undistort_images(job.out / "theirs", job.out / "sparse", job.frames)
    for name in job.names:
        ours, theirs = (read_png(path).astype(int) for path in (
            out / "images" / name, job.out / "theirs" / "images" / name))
        assert ours.shape == theirs.shape
        # OpenCV takes places in steps of 1/32 of a pixel.
        assert np.abs(ours - theirs)[1:-1, 1:-1].max() <= 8
        assert np.abs(ours - theirs)[1:-1, 1:-1].mean() < 1
    flat = pycolmap.Reconstruction(out / "sparse")
    assert {camera.model.name for camera in flat.cameras.values()} == {"PINHOLE"}
    assert flat.num_points3D() == model.num_points3D()


def test_twins_are_copies_where_nothing_was_denoised(mapped):
    job, model = mapped
    out = run(job, model, (-0.1, 0, 0, 0))
    for name in job.names:
        image, twin = ((out / folder / name).read_bytes() for folder in ("images", "denoised"))
        assert (image == twin) == (name != job.names[1])
    halved = read_png(out / "denoised" / job.names[1]).astype(int)
    assert np.abs(2 * halved - read_png(out / "images" / job.names[1])).max() <= 2


def test_masks_stay_black_and_white(mapped, tmp_path):
    job, model = mapped
    (tmp_path / "masks").mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :WIDTH // 2] = 0
    write_png(tmp_path / "masks" / job.names[2], mask)
    out = run(replace(job, masks=tmp_path / "masks"), model, (-0.1, 0, 0, 0))
    assert [path.name for path in (out / "masks").iterdir()] == [job.names[2]]
    found = read_png(out / "masks" / job.names[2])[:, :, 0]
    assert set(np.unique(found)) == {0, 255}
    assert np.mean(found == 0) == pytest.approx(0.5, abs=0.02)


def test_progress_ends_with_the_last_frame(mapped):
    job, model = mapped
    stream = io.BytesIO()
    run(job, model, report=Reporter(stream))
    phase, *counts = map(parse, stream.getvalue().splitlines())
    assert phase == Phase("undistorted", 6, 0)
    assert counts == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("params", [(0.0, 0.0, 0.0, 0.0), (-0.05, 0.0, 0.0, 0.0)])
def test_a_picture_that_shows_nearly_all_of_a_frame_is_one(mapped, params):
    job, model = mapped
    stream = io.BytesIO()
    out = run(job, model, params, report=Reporter(stream))
    assert not [text for text in map(parse, stream.getvalue().splitlines())
                if isinstance(text, str)]
    assert sorted(path.name for path in (out / "images").iterdir()) == list(job.names)
    assert not (out / "masks").exists()


def test_a_lens_of_which_a_picture_shows_little_is_seen_whole_behind_a_mask(mapped):
    job, model = mapped
    stream = io.BytesIO()
    out = run(job, model, (3.0, 0.0, 0.0, 0.0), report=Reporter(stream))  # a pincushion
    (text,) = [text for text in map(parse, stream.getvalue().splitlines()) if isinstance(text, str)]
    assert_facts(text, 1, "pinhole", "frame")
    assert len(list((out / "images").iterdir())) == len(job.names)
    for path in (out / "masks").iterdir():
        assert 0.5 < (read_png(path)[..., 0] == 255).mean() < 0.95


def test_the_share_that_a_picture_covers_is_that_of_its_border():
    across, down = np.meshgrid(np.linspace(10, 89, 50), np.linspace(0, 59, 40))
    warp = np.stack([across, down], axis=2).astype(np.float32)
    assert covered_share(warp, 100, 60) == pytest.approx(79 / 99)
