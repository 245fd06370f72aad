"""The .splat: each parameter within its step, the most important first, bad files refused."""

import numpy as np
import pytest
import torch
from facts import assert_facts, raises
from splat_cases import N, edge_splats, greatest, rotation_error

from recon_cli.errors import FormatError
from recon_cli.scene.splats import SH_C0
from recon_cli.splats.splat import FORMAT, write_splat


def in_order(splats):
    """The Gaussians as the file has them: by falling opacity x volume."""
    importance = splats.opacities.double().log() + splats.log_scales.double().sum(1)
    return splats.select(torch.argsort(importance, descending=True, stable=True))


@pytest.fixture
def written(tmp_path):
    splats = edge_splats(0)
    write_splat(tmp_path / "a.splat", splats)
    return tmp_path / "a.splat", in_order(splats)


def test_each_parameter_is_within_its_step(written):
    path, splats = written
    back = FORMAT.read(path)
    assert torch.equal(back.means, splats.means)
    assert greatest(back.log_scales, splats.log_scales) < 1e-6 * 10  # float32
    assert greatest(back.opacities, splats.opacities) <= 0.5 / 255 + 1e-7
    assert greatest(SH_C0 * back.sh_dc, SH_C0 * splats.sh_dc) <= 0.5 / 255 + 1e-6
    # A component of 1 has no byte and becomes 127/128; otherwise half a step, then unit length.
    assert rotation_error(back, splats) <= 1 / 128
    assert back.sh_degree == 0


def test_a_row_is_what_the_format_says(tmp_path):
    splats = edge_splats(0).select(torch.tensor([4]))
    splats.sh_dc[0] = (torch.tensor([1.0, 0.0, 9.0]) - 0.5) / SH_C0
    splats.logit_opacities[0] = 0
    write_splat(tmp_path / "a.splat", splats)
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 32
    floats = np.frombuffer(data[:24], "<f4")
    assert floats[:3].tolist() == splats.means[0].tolist()
    assert np.allclose(floats[3:], splats.scales[0], rtol=1e-6)
    assert list(data[24:]) == [255, 0, 255, 128, 0, 128, 128, 128]  # half a step goes to even


def test_the_most_important_gaussian_comes_first(written):
    path, _ = written
    rows = np.frombuffer(path.read_bytes(), "<f4").reshape(N, 8)
    alphas = np.frombuffer(path.read_bytes(), np.uint8).reshape(N, 32)[:, 27] / 255
    volumes = rows[:, 3:6].astype(np.float64).prod(axis=1)
    solid = alphas > 0.1  # the byte of a clear one is too coarse to tell
    importance = (alphas * volumes)[solid]
    assert (np.diff(importance) <= 0.03 * importance[:-1]).all()


def test_bytes_stay_when_a_file_is_read_and_written_again(written, tmp_path):
    path, _ = written
    write_splat(tmp_path / "b.splat", FORMAT.read(path))
    rows, again = (np.frombuffer(p.read_bytes(), np.uint8).reshape(N, 32)
                   for p in (path, tmp_path / "b.splat"))
    by_mean, by_mean_again = (np.lexsort(r[:, :12].T) for r in (rows, again))
    assert (rows[by_mean, 24:28] == again[by_mean_again, 24:28]).all()


def test_scales_beyond_float32_are_clamped_below_and_refused_above(tmp_path):
    splats = edge_splats(0)
    splats.log_scales[7] = -300
    write_splat(tmp_path / "a.splat", splats)
    assert FORMAT.read(tmp_path / "a.splat").log_scales.min() == pytest.approx(-87.3365, abs=1e-3)
    splats.log_scales[7] = 90
    with raises(FormatError, 1, "Gaussians"):
        write_splat(tmp_path / "b.splat", splats)
    assert not (tmp_path / "b.splat").exists()


@pytest.mark.parametrize(("at", "number"), [(4, np.nan), (16, np.inf), (16, np.nan)])
def test_a_gaussian_that_is_not_finite_is_left_out_and_counted(written, caplog, at, number):
    path, _ = written
    whole, data = FORMAT.read(path), path.read_bytes()
    path.write_bytes(data[:at] + np.float32(number).tobytes() + data[at + 4:])
    left = FORMAT.read(path)
    assert torch.equal(left.means, whole.means[1:])
    assert torch.equal(left.sh_dc, whole.sh_dc[1:])
    assert_facts(caplog.text, 1, len(whole), "Gaussians", "left")


def test_nothing_and_values_that_are_not_finite_are_not_written(tmp_path):
    splats = edge_splats(0)
    with raises(FormatError, "Gaussians"):
        write_splat(tmp_path / "a.splat", splats.select(torch.arange(0)))
    splats.means[3, 1] = np.nan
    with raises(FormatError, 1, "means"):
        write_splat(tmp_path / "a.splat", splats)
    assert list(tmp_path.iterdir()) == []
