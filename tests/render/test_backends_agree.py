"""The torch backend against the numba backend, on scenes too large for the oracle."""

from __future__ import annotations

import math
from dataclasses import fields

import pytest
import torch
from backends import CASES, GREENISH, Case, at_size
from scenes import camera_at, random_splats, with_harmonics

from recon_cli.render import Statistics
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

EXACT = Case("torch", "cpu", torch.float64)
OTHERS = [case for case in CASES if case.dtype == torch.float32]
# Fragments within rounding of 1/255 are in or out; on 30,000 pixels of some twenty fragments a
# few are. Such a pixel is off by at most one fragment, 1/255 times its colour: measured 7e-5 of
# the pixels, and bounded by 1e-3 of them.
LOTTERY_SHARE = 1e-3
PIXEL_TOLERANCE = 2e-5  # measured 1e-5, relative to the greatest value
ONE_FRAGMENT = 3 / 255
# Norm of the error over the norm. A pixel of the lottery moves its Gaussian's gradient whole:
# measured 2e-4.
SUM_TOLERANCE = 2e-3


def scene(seed: int, count: int) -> Splats:
    """Gaussians of the sizes that a trained room has; a tenth are needles."""
    splats = random_splats(count, seed=seed)
    splats.log_scales[:] -= 1.0
    return splats


def everything(
    case: Case, splats: Splats, camera: Camera, degree: int
) -> dict[str, torch.Tensor]:
    """Images, gradients and statistics by name, in float64 on the CPU."""
    tracked = case.leaves(splats)
    out = case.render(tracked, camera, GREENISH, degree, scores=True)
    ramp = torch.linspace(0, 1, camera.width, dtype=case.dtype, device=case.device)
    loss = (out.rgb - ramp[None, :, None]).square().mean()
    (loss + 0.1 * (out.depth * ramp).mean() + 0.1 * out.alpha.mean()).backward()
    found = {"rgb": out.rgb, "alpha": out.alpha, "depth": out.depth}
    found |= {f"gradient of {name}": p.grad for name, p in tracked.parameters().items()
              if p.grad is not None}
    found |= {field.name: getattr(out.statistics, field.name) for field in fields(Statistics)
              if isinstance(getattr(out.statistics, field.name), torch.Tensor)}
    assert out.statistics.broken == 0
    return {name: value.detach().double().cpu() for name, value in found.items()}


exact: dict[tuple[int, int], dict[str, torch.Tensor]] = {}  # of the last scene, for every case


@pytest.mark.parametrize("case", at_size(OTHERS), ids=str)
@pytest.mark.parametrize(("seed", "degree", "stored", "plain"), [
    (0, 0, 3, 0.0), (1, 2, 3, 0.0), (2, 3, 3, 0.0), (3, 3, 3, 0.65), (4, 2, 2, 0.25),
    (5, 3, 1, 0.0005), (6, 3, 0, 1.0)])
def test_all_outputs_and_gradients_agree_on_many_gaussians(case, seed, degree, stored, plain):
    # an interpreter takes minutes at full size: six tiles, one with a list of more than two blocks
    count, scale = (400, 6) if case.interpreted else (2000, 1)
    splats = with_harmonics(scene(seed, count), stored, count - math.ceil(plain * count))
    splats = splats.map(lambda tensor: tensor.float().double())
    camera = camera_at(200 // scale, 150 // scale, focal=160.0 / scale)
    if (seed, scale) not in exact:
        exact.clear()
        exact[seed, scale] = everything(EXACT, splats, camera, degree)
    truth, ours = exact[seed, scale], everything(case, splats, camera, degree)
    assert truth.keys() == ours.keys()
    for name in ("rgb", "alpha", "depth"):
        error = (ours[name] - truth[name]).abs()
        scale = max(1.0, truth[name].abs().max().item())
        share = (error > PIXEL_TOLERANCE * scale).double().mean().item()
        assert share <= LOTTERY_SHARE, name
        assert error.max() <= ONE_FRAGMENT * scale, name
    assert (ours["hits"] - truth["hits"]).abs().sum() <= LOTTERY_SHARE * truth["hits"].sum()
    seen = (truth["radii"] > 0) & (ours["radii"] > 0)
    assert torch.allclose(ours["radii"][seen], truth["radii"][seen], rtol=1e-5)
    # which Gaussians at the rim count as culled is left to the backend; none of them has a hit
    assert (truth["hits"][~seen] == 0).all()
    for name, value in truth.items():
        if name in ("rgb", "alpha", "depth", "hits", "radii"):
            continue
        error = ((ours[name] - value).norm() / value.norm()).item()
        assert error <= SUM_TOLERANCE, f"{name}: {error:.1e}"
