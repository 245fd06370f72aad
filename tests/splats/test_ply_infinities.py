"""Infinities in a .ply: opaque, invisible and flat are read, all others are refused."""

import logging
import math

import numpy as np
import pytest
import torch
from facts import assert_facts, raises
from scenes import random_splats

from recon_cli.errors import FormatError
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.splats.registry import read_splats
from recon_cli.splats.splat import write_splat


def splats():
    return random_splats(6, seed=3, dtype=torch.float32).with_degree(0)


def written(path, changed):
    write_ply(path, changed)
    return path


def test_infinite_logits_are_read_as_the_first_and_last_byte_of_a_splat(tmp_path, caplog):
    changed = splats()
    changed.logit_opacities[:3] = torch.tensor([torch.inf, -torch.inf, torch.inf])
    with caplog.at_level(logging.WARNING, "recon"):
        back = read_ply(written(tmp_path / "a.ply", changed))
    assert_facts(caplog.text, "a.ply", 3, 0, 1, "0.001", "0.999")
    changed.logit_opacities[:3] = torch.tensor([40.0, -40.0, 40.0])
    write_splat(tmp_path / "b.splat", changed)
    there = read_splats(tmp_path / "b.splat").logit_opacities
    assert sorted(back.logit_opacities[:2].tolist()) == pytest.approx(
        [there.min().item(), there.max().item()], abs=1e-5)
    assert torch.equal(back.logit_opacities[3:], splats().logit_opacities[3:])


def test_scales_of_zero_become_a_millionth_and_are_drawn(tmp_path, caplog):
    changed = splats()
    changed.means[:] = torch.tensor([0.0, 0, 3])
    changed.log_scales[:, 2] = -torch.inf
    with caplog.at_level(logging.WARNING, "recon"):
        back = read_ply(written(tmp_path / "a.ply", changed))
    assert_facts(caplog.text, 6, 0, "1e-06")
    assert back.log_scales[:, 2].tolist() == pytest.approx([math.log(1e-6)] * 6)
    image = render(back, Camera(32, 32, 30, 30, 16, 16, np.eye(4)), torch.zeros(3), 0)
    assert image.rgb.isfinite().all()
    assert image.alpha.max() > 0.1


def test_gaussians_of_two_scales_are_flat_along_their_third_axis(tmp_path):
    path = written(tmp_path / "a.ply", splats())
    head, data = path.read_bytes().split(b"end_header\n", 1)
    table = np.frombuffer(data, "<f4").reshape(6, 17)
    path.write_bytes(head.replace(b"property float scale_2\n", b"") + b"end_header\n"
                     + np.delete(table, 12, axis=1).tobytes())
    back = read_ply(path)
    assert torch.equal(back.log_scales[:, :2], splats().log_scales[:, :2])
    assert back.log_scales[:, 2].tolist() == pytest.approx([math.log(1e-6)] * 6)
    assert torch.equal(back.quats, splats().quats)


@pytest.mark.parametrize(("name", "value", "column"), [
    ("logit_opacities", torch.nan, "opacity"), ("log_scales", torch.inf, "scale_0"),
    ("log_scales", torch.nan, "scale_0"), ("means", -torch.inf, "x"), ("quats", torch.inf, "rot_0"),
])
def test_what_is_no_limit_of_anything_is_still_refused(tmp_path, name, value, column):
    changed = splats()
    changed.parameters()[name].view(-1)[0] = value
    with raises(FormatError, column, 1, "finite"):
        read_ply(written(tmp_path / "a.ply", changed))
