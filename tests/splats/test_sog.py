"""A .sog comes back within the steps of its own quantisation, and small."""

import io
import json
import zipfile

import archive_splats
import numpy as np
import pytest
import torch
from facts import raises
from PIL import Image
from scenes import camera_at, with_harmonics

from recon_cli.errors import InputError
from recon_cli.render.registry import render
from recon_cli.splats.ply import write_ply
from recon_cli.splats.sog import encode_webp, load_sog, write_sog

ROUNDING = 1e-6  # of float32, of values about 1
LONG = np.sqrt(2) / 255 / 2  # half a step of a component of a quaternion


def there_and_back(tmp_path, splats):
    write_sog(tmp_path / "a.sog", splats)
    return load_sog(tmp_path / "a.sog").splats


def meta_of(path):
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("meta.json"))


def psnr(splats, other):
    images = [render(one, camera_at(100, 74, focal=80), torch.zeros(3), one.sh_degree).rgb
              for one in (splats, other)]
    return -10 * torch.log10((images[0] - images[1]).square().mean()).item()


@pytest.mark.parametrize("make", [
    lambda: archive_splats.extremes(), lambda: archive_splats.room(500)])
def test_every_value_comes_back_within_its_step(tmp_path, make):
    splats = make()
    back = there_and_back(tmp_path, splats)
    rows = archive_splats.matched(splats, back)
    meta = meta_of(tmp_path / "a.sog")
    logs = [torch.sign(means.double()) * torch.log1p(means.double().abs())
            for means in (splats.means[rows], back.means)]
    step = torch.tensor(meta["means"]["maxs"]) - torch.tensor(meta["means"]["mins"])
    assert ((logs[0] - logs[1]).abs() <= step / 65535 / 2 + ROUNDING).all()
    quats = archive_splats.unit(splats.quats[rows])
    greatest = quats.abs().argmax(1, keepdim=True)
    quats = quats * quats.gather(1, greatest).sign()
    error = (quats - back.quats).abs()
    assert error.scatter(1, greatest, 0).max() <= LONG + ROUNDING
    # d = sqrt(1 - sum v^2) with d >= 1/2: what three components err, times v / d
    assert error.gather(1, greatest).max() <= 3 * LONG * (np.sqrt(0.5) / 0.5) + ROUNDING
    assert (splats.opacities[rows] - back.opacities).abs().max() <= 1 / 510 + 2e-6
    for name, group in (("log_scales", "scales"), ("sh_dc", "sh0")):
        value, book = getattr(splats, name)[rows], torch.tensor(meta[group]["codebook"])
        least = (value[:, :, None] - book).abs().amin(2)
        torch.testing.assert_close(
            (value - getattr(back, name)).abs(), least, rtol=1e-6, atol=ROUNDING)


@pytest.mark.parametrize("colored", [1, 40, 160])
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_coefficients_of_few_kinds_come_back_within_the_codebooks_steps(tmp_path, degree, colored):
    splats = archive_splats.room(160)
    kinds = torch.randn(2, 15, 3, generator=torch.Generator().manual_seed(0)) / 10
    splats.sh_rest[:] = kinds[(splats.means[:, 0] > 0).long()]
    splats = with_harmonics(splats, degree, colored)
    if colored == 1:
        assert (splats.sh_rest != 0).all()
    back = there_and_back(tmp_path, splats)
    rows = archive_splats.matched(splats, back)
    assert back.sh_degree == degree
    assert len(back.sh_rest) == colored  # the others are of degree 0 as before
    book = torch.tensor(meta_of(tmp_path / "a.sog")["shN"]["codebook"])
    error = (archive_splats.all_rows(splats)[rows] - archive_splats.all_rows(back)).abs()
    assert error.max() <= book.diff().max() / 2 + ROUNDING
    assert error.max() < 0.002


def test_a_scene_of_degree_0_has_no_palette(tmp_path):
    for name, splats in (("a", with_harmonics(archive_splats.room(50), 3, 0)),
                         ("b", archive_splats.room(50, degree=0))):
        write_sog(tmp_path / f"{name}.sog", splats)
        assert "shN" not in meta_of(tmp_path / f"{name}.sog")
        assert load_sog(tmp_path / f"{name}.sog").splats.sh_degree == 0


@pytest.mark.parametrize("n", [1, 2, 3, 63, 64, 65, 257])
def test_any_number_of_gaussians_fits_into_the_images(tmp_path, n):
    splats = archive_splats.room(n)
    back = there_and_back(tmp_path, splats)
    assert len(back) == n
    archive_splats.matched(splats, back)


def test_a_scene_looks_as_before(tmp_path):
    splats = archive_splats.room(3000)
    assert psnr(splats, there_and_back(tmp_path, splats)) > 40


def test_view_dependence_survives(tmp_path):
    splats = archive_splats.room(3000)
    splats.sh_rest *= 3
    back = there_and_back(tmp_path, splats)
    assert psnr(splats, back) > psnr(splats, splats.with_degree(0)) + 10


@pytest.mark.integration
def test_a_sog_is_a_twelfth_of_a_ply(tmp_path):
    splats = archive_splats.room(20_000)
    write_sog(tmp_path / "a.sog", splats)
    write_ply(tmp_path / "a.ply", splats)
    assert 12 * (tmp_path / "a.sog").stat().st_size < (tmp_path / "a.ply").stat().st_size


def test_the_same_seed_gives_the_same_bytes(tmp_path):
    splats = archive_splats.room(300)
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        write_sog(tmp_path / name, splats, seed=seed)
    one, same, other = ((tmp_path / name).read_bytes() for name in "abc")
    assert one == same
    assert one != other


def test_neighbours_in_space_are_neighbours_in_the_file(tmp_path):
    splats = archive_splats.room(2000)
    back = there_and_back(tmp_path, splats)
    steps = [one.means.diff(dim=0).norm(dim=1).mean() for one in (back, splats)]
    assert steps[0] < steps[1] / 5


@pytest.mark.parametrize("channels", [3, 4])
def test_images_are_exact_under_any_alpha(channels):
    pixels = np.random.default_rng(0).integers(0, 256, (37, 53, channels), np.uint8)
    pixels[:20, :, -1] = 0
    with Image.open(io.BytesIO(encode_webp(pixels))) as image:
        np.testing.assert_array_equal(np.asarray(image), pixels)


def test_the_file_is_what_its_format_says(tmp_path):
    write_sog(tmp_path / "a.sog", archive_splats.room(100))
    meta = meta_of(tmp_path / "a.sog")
    assert meta["version"] == 2
    assert meta["count"] == 100
    assert len(meta["scales"]["codebook"]) == len(meta["sh0"]["codebook"]) == 256
    assert meta["shN"]["bands"] == 3
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name for part in meta.values() if isinstance(part, dict)
                 for name in part.get("files", [])}
        assert {"meta.json", *files} == set(archive.namelist())
        for name in files - {"shN_centroids.webp"}:
            with Image.open(io.BytesIO(archive.read(name))) as image:
                assert image.size == (10, 10)
                assert image.format == "WEBP"
        with Image.open(io.BytesIO(archive.read("quats.webp"))) as image:
            assert np.asarray(image.convert("RGBA"))[..., 3].min() >= 252
        with Image.open(io.BytesIO(archive.read("shN_centroids.webp"))) as image:
            assert image.width == 64 * 15


def test_scenes_that_no_file_can_hold_are_refused(tmp_path):
    splats = archive_splats.room(5)
    with raises(InputError, "Gaussians"):
        write_sog(tmp_path / "a.sog", splats.select(torch.arange(0)))
    splats.means[2, 1] = torch.nan
    with raises(InputError, "finite", "means"):
        write_sog(tmp_path / "a.sog", splats)
    assert list(tmp_path.iterdir()) == []
