"""The compressed .ply: each parameter within its step, chunks compact, bad files refused."""

import re

import numpy as np
import pytest
import torch
from facts import raises
from scenes import random_splats
from splat_cases import N, edge_splats, greatest, rotation_error

from recon_cli.errors import FormatError
from recon_cli.scene.harmonics import basis_rest
from recon_cli.scene.splats import SH_C0, joined, with_rows
from recon_cli.splats.compressed_ply import load_compressed_ply, write_compressed_ply
from recon_cli.splats.values import compact_order, morton_order


def few(count: int = 9, degree: int = 1):
    return edge_splats(degree).select(torch.arange(count))


def order_of(splats):
    """As the file has them: what fills the chunk of those far away is the most transparent."""
    return compact_order(splats.means.numpy(), splats.logit_opacities.numpy(), 256)


def in_order(splats):
    """The Gaussians as the file has them, all with coefficients."""
    rows = torch.from_numpy(order_of(splats))
    full = with_rows(splats.sh_rest, len(splats))
    whole = type(splats)(**(splats.parameters() | {"sh_rest": full}))
    return whole.map(lambda value: value[rows])


def steps(values: torch.Tensor, bits: list[int]) -> torch.Tensor:
    """The step [N, 3] of each value: the range of its chunk over the greatest number of the bits.

    A value computed in float32 may be off by its rounding besides.
    """
    ranges = [(chunk.amax(0) - chunk.amin(0)).double().expand(len(chunk), 3)
              for chunk in values.split(256)]
    return torch.cat(ranges) / (2.0 ** torch.tensor(bits, dtype=torch.float64) - 1)


def test_points_in_morton_order_are_near_their_neighbours():
    axis = np.arange(8)
    grid = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)[
        np.random.default_rng(0).permutation(512)].astype(np.float32)
    ordered = grid[morton_order(grid)]
    for size in (8, 64):  # a run of 8 is a cube of 2, one of 64 a cube of 4
        runs = ordered.reshape(-1, size, 3)
        assert (np.ptp(runs, axis=1) == round(size ** (1 / 3)) - 1).all()
    flat = np.zeros((4, 3), np.float32)
    assert morton_order(flat).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("degree", "colored"), [(0, N), (1, N), (2, 1), (3, N), (3, 300)])
def test_each_parameter_is_within_half_a_step(tmp_path, degree, colored):
    splats = edge_splats(degree, colored)
    write_compressed_ply(tmp_path / "a.compressed.ply", splats)
    back, splats = load_compressed_ply(tmp_path / "a.compressed.ply").splats, in_order(splats)
    assert back.sh_degree == degree
    for name, bits in (("means", [11, 10, 11]), ("log_scales", [11, 10, 11])):
        value = getattr(splats, name)
        error = (getattr(back, name).double() - value.double()).abs()
        assert (error <= 0.5 * steps(value, bits) + 2**-23 * value.abs()).all(), name
    color = SH_C0 * splats.sh_dc + 0.5
    error = SH_C0 * (back.sh_dc.double() - splats.sh_dc.double()).abs()
    assert (error <= 0.5 * steps(color, [8, 8, 8]) + 1e-6).all()
    assert greatest(back.opacities, splats.opacities) <= 0.5 / 255 + 1e-7
    step = np.sqrt(2) / 1023
    assert rotation_error(back, splats) <= 3 * 0.5 * step + 4 * step**2
    if degree:
        assert greatest(with_rows(back.sh_rest, N), splats.sh_rest) <= 0.5 / 32 + 1e-7


def test_coefficients_at_the_ends_are_within_a_step_and_beyond_are_clamped(tmp_path):
    splats = few(5, 1)
    splats.sh_rest[:, 0, 0] = torch.tensor([-4, -3.97, 3.99, -9, 9])
    write_compressed_ply(tmp_path / "a.ply", splats)
    back = load_compressed_ply(tmp_path / "a.ply").splats
    wanted = in_order(splats).sh_rest[:, 0, 0].clamp(-4, 4)
    assert greatest(back.sh_rest[:, 0, 0], wanted) <= 1 / 32


def test_gaussians_without_harmonics_do_not_tint_the_scene(tmp_path):
    """No byte stands for 0; the nearest two, each 1/64 off, take turns."""
    splats = edge_splats(3, 1)
    splats.sh_rest[:] = 0
    write_compressed_ply(tmp_path / "a.ply", splats)
    back = load_compressed_ply(tmp_path / "a.ply").splats
    assert back.sh_rest.abs().unique().tolist() == [1 / 64]
    assert (back.sh_rest.mean(dim=0) == 0).all()


def test_the_layout_is_the_one_of_supersplat(tmp_path):
    path = tmp_path / "a.ply"
    splats = few(3, 2)
    splats.means[:] = torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5]])
    splats.quats[:] = torch.tensor([[0, 0, 1.0, 0], [-1, 0, 0, 0], [1, 1, 1, 1]])
    write_compressed_ply(path, splats)
    head, data = path.read_bytes().split(b"end_header\n", 1)
    assert re.findall(rb"element (\w+ \d+)", head) == [b"chunk 1", b"vertex 3", b"sh 3"]
    assert head.count(b"property float") == 18
    assert head.count(b"property uchar f_rest_") == 24
    assert len(data) == 18 * 4 + 3 * 16 + 3 * 24
    assert np.frombuffer(data, "<f4", 6).tolist() == [0, 0, 0, 1, 1, 1]
    words = np.frombuffer(data, "<u4", 12, 72).reshape(3, 4)
    # Along the curve the first comes first; x has the highest bits of a position.
    order = order_of(splats).tolist()
    places = {row: int(words[i, 0]) for i, row in enumerate(order)}
    assert places == {0: 0, 1: 2**32 - 1, 2: 2047 << 21 | 1024}
    rotations = {row: int(words[i, 1]) for i, row in enumerate(order)}
    assert rotations[0] >> 30 == 2  # y of wxyz
    assert [rotations[0] >> shift & 1023 for shift in (20, 10, 0)] == [512, 512, 512]
    assert rotations[1] >> 30 == 0
    # Half is 0.5 / sqrt(2) + 0.5 of 1023.
    assert [rotations[2] >> shift & 1023 for shift in (20, 10, 0)] == [873, 873, 873]


def test_a_file_without_bounds_of_colours_is_read(tmp_path):
    path = tmp_path / "a.ply"
    splats = few(9, 0)
    write_compressed_ply(path, splats)
    back = load_compressed_ply(path).splats
    head, data = path.read_bytes().split(b"end_header\n", 1)
    head = re.sub(rb"property float (min|max)_[rgb]\n", b"", head)
    words = np.frombuffer(data, "<u4", 36, 72).reshape(9, 4).copy()
    words[:, 3] = 255 << 24 | 51 << 8 | 128
    path.write_bytes(head + b"end_header\n" + data[:48] + words.tobytes())
    plain = load_compressed_ply(path).splats
    assert torch.equal(plain.means, back.means)
    assert np.allclose(SH_C0 * plain.sh_dc + 0.5, [1, 0, 0.2], atol=1e-6)
    assert np.allclose(plain.opacities, 128 / 255)


def test_what_does_not_fit_is_refused_and_tiny_scales_are_clamped(tmp_path):
    path = tmp_path / "a.ply"
    splats = few()
    splats.log_scales[4] = -1000
    write_compressed_ply(path, splats)
    assert load_compressed_ply(path).splats.log_scales.min() == -20
    splats.log_scales[4] = 21
    for bad, *facts in [
            (splats, 1, "large"), (splats.select(torch.arange(0)), "Gaussians"),
            (few().map(lambda value: value * np.nan), "finite", "means")]:
        with raises(FormatError, *facts):
            write_compressed_ply(tmp_path / "b.ply", bad)
    assert not (tmp_path / "b.ply").exists()


def test_what_lies_far_outside_takes_no_bits_from_the_rest(tmp_path):
    near = random_splats(1000, dtype=torch.float32)
    far = random_splats(300, seed=1, dtype=torch.float32)
    far.means *= 1000 / far.means.norm(dim=1, keepdim=True)
    write_compressed_ply(tmp_path / "a.compressed.ply", joined([far, near])[0])
    back = load_compressed_ply(tmp_path / "a.compressed.ply").splats.means
    rooms = back[back.norm(dim=1) < 100]
    assert len(rooms) == 1000
    apart = torch.cdist(near.means, rooms).amin(1)
    assert (apart < 0.01).sum() >= 1000 - 256  # all but those of one chunk


def test_shells_far_away_share_no_chunk_and_the_last_is_filled_with_the_lightest():
    near = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)
    shells = [radius * point / np.linalg.norm(point, axis=1, keepdims=True)
              for radius, point in ((1e3, near[:256]), (1e4, near[256:768]))]
    points = np.concatenate([near, shells[0][:200], shells[1]]).astype(np.float32)
    weights = np.random.default_rng(1).permutation(len(points)).astype(float)
    order = compact_order(points, weights, 256)
    away = np.linalg.norm(points, axis=1)[order]
    assert (away[:512] > 9000).all()
    assert (away[512:712] > 900).all()
    lightest = np.argsort(weights[:1000])[:56]
    assert set(order[712:768]) == set(lightest)
    assert (np.sort(order) == np.arange(len(points))).all()


def test_a_small_opaque_gaussian_keeps_its_place_when_a_chunk_far_away_is_filled(tmp_path):
    near = random_splats(1000, dtype=torch.float32)
    near.logit_opacities[:] = -3.0
    near.logit_opacities[:300], near.log_scales[:300] = 3.0, -12.0
    far = random_splats(300, seed=1, dtype=torch.float32)
    far.means *= 1000 / far.means.norm(dim=1, keepdim=True)
    write_compressed_ply(tmp_path / "a.compressed.ply", joined([far, near])[0])
    back = load_compressed_ply(tmp_path / "a.compressed.ply").splats.means
    assert (torch.cdist(near.means[:300], back).amin(1) < 0.01).all()


def test_rounded_harmonics_leave_the_mean_colour_over_the_cameras_as_it_was(tmp_path):
    splats = random_splats(500, dtype=torch.float32)
    centers = np.random.default_rng(0).normal(size=(20, 3)) + np.array([6.0, 0, 0])

    def mean_colors(of):
        toward = [torch.nn.functional.normalize(of.means - torch.tensor(center).float(), dim=1)
                  for center in centers]
        return SH_C0 * of.sh_dc + torch.stack([
            (basis_rest(one, 3)[..., None] * of.sh_rest).sum(1) for one in toward]).mean(0)

    rms = []
    for name, places in (("known", centers), ("unknown", None)):
        path = tmp_path / f"{name}.compressed.ply"
        write_compressed_ply(path, splats, centers=places)
        off = mean_colors(load_compressed_ply(path).splats) - mean_colors(in_order(splats))
        rms.append(float(off.square().mean().sqrt()))
    assert rms[0] < 0.5 * rms[1]
