"""Small scenes of extreme parameters that no one thought of: finite, bounded, and agreeing.

What failed once is a fixed case in the files of hard cases.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from backends import CASES, GREENISH, Case
from examples import examples
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from oracle import composited
from scenes import leaves

from recon_cli.render.contract import DILATION, NEAR, TRANSMITTANCE_MIN
from recon_cli.render.torch.projection import project
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats

EXACT = Case("torch", "cpu", torch.float64)
# An error of the mean, of the offset to a pixel or of an axis is relative: `reach` pixels times
# the machine's epsilon. Divided by the smallest width sqrt(0.3) it is an error of the whitened
# offset, |u| <= sqrt(2 ln 255) < 3.4, and that times |u| is a relative error of alpha. The
# operations of the projection, at most some 40 roundings deep, multiply it.
ROUNDINGS = 40.0
EPSILON = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}
FLOOR = {torch.float32: 1e-5, torch.float64: 1e-11}  # IMAGE_TOLERANCE, and the oracle's own error


def number(low: float, high: float):
    return st.floats(low, high, width=32)


@st.composite
def quaternions(draw):
    length = draw(st.sampled_from([1.0, 1.0, 1.0, 1e-10, 1e-20, 1e-38, 1e15, 0.0]))
    return [length * draw(number(-1, 1)) for _ in range(4)]


@st.composite
def scenes(draw):
    """A scene and a camera whose axes are those of the world."""
    count = draw(st.integers(1, 8))

    def rows(*entries):
        return torch.tensor([[draw(e) for e in entries] for _ in range(count)]).double()

    spread = draw(st.sampled_from([0.0, 0.1, 1.0, 10.0]))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 1000)))
    splats = Splats(
        means=rows(number(-3, 3), number(-3, 3), number(-0.5, 8)),
        quats=torch.tensor([draw(quaternions()) for _ in range(count)]).double(),
        log_scales=rows(*[st.one_of(number(-4, 1), number(-18, 7))] * 3),
        logit_opacities=rows(
            st.one_of(number(-6, 6), st.sampled_from([-40.0, 12.0, 40.0])))[:, 0],
        sh_dc=rows(*[number(-5, 5)] * 3),
        sh_rest=spread * torch.randn(count, 15, 3, generator=generator).double(),
    )
    width, height = draw(st.integers(1, 40)), draw(st.integers(1, 40))
    focal = draw(st.sampled_from([3.0, 20.0, 60.0, 300.0]))
    cx = draw(st.one_of(st.just(width / 2), number(-30, 70)))
    camera = Camera(width, height, focal, 1.2 * focal, cx, height / 2, np.eye(4))
    return splats.map(lambda tensor: tensor.float().double()), camera, draw(st.integers(0, 3))


def relative_error(case, splats, camera):
    """The bound of the relative error of an alpha; see ROUNDINGS."""
    projection = project(splats, camera, 0)
    if not len(projection.ids):
        return FLOOR[case.dtype]
    far = torch.tensor([camera.width, camera.height])
    reach = torch.maximum(projection.means2d.abs(), (projection.means2d - far).abs()).amax()
    reach = reach + (projection.cov2d[:, 0] + projection.cov2d[:, 2]).sqrt().amax()
    unit = ROUNDINGS * EPSILON[case.dtype] * math.sqrt(2 * math.log(255)) / math.sqrt(DILATION)
    return FLOOR[case.dtype] + unit * float(reach)


def run(case, splats, camera, degree):
    """The picture and the gradients of a random combination of its images."""
    tracked = case.leaves(splats)
    out = case.render(tracked, camera, GREENISH, degree, scores=True)
    generator = torch.Generator().manual_seed(0)
    weights = torch.randn(out.rgb.shape, generator=generator, dtype=torch.float64).to(out.rgb)
    ((out.rgb * weights).sum() + out.alpha.sum() + out.depth.mean()).backward()
    return out, tracked


def check(case, splats, camera, degree):
    """Asserts what holds of any scene of finite parameters."""
    out, tracked = run(case, splats, camera, degree)
    for image in (out.rgb, out.alpha, out.depth):
        assert torch.isfinite(image).all()
    assert (out.alpha >= 0).all()
    assert (out.alpha <= 1 - TRANSMITTANCE_MIN * (1 - 1e-3)).all()
    for name, parameter in tracked.parameters().items():
        assert parameter.grad is None or torch.isfinite(parameter.grad).all(), name
    for name in ("radii", "blend_sum", "blend_max", "means2d_grad", "variance", "loo"):
        assert torch.isfinite(getattr(out.statistics, name)).all(), name
    assert (out.statistics.variance >= 0).all()
    assert (out.statistics.hits <= camera.width * camera.height).all()

    bound = relative_error(case, splats, camera)
    if bound > 0.01:  # Gaussians so large or so far beside the image that float32 promises nothing
        return
    if ((splats.means[:, 2] / NEAR - 1).abs() < 1e-6).any():  # on the near plane: drawn or culled
        return
    truth, exact = run(EXACT, splats, camera, degree)
    sure = composited(splats, camera, GREENISH, 0).margin > 10 * bound
    weights = 1 + len(splats)  # each Gaussian's alpha may be off, and the colours stand before it
    brightest = max(1.0, truth.rgb.max().item(), _brightest(splats))
    error = (out.rgb.detach().cpu() - truth.rgb.detach()).abs().amax(-1)[sure]
    assert (error <= weights * bound * brightest).all(), error.max() / bound
    error = (out.alpha.detach().cpu() - truth.alpha.detach()).abs()[sure]
    assert (error <= weights * bound).all(), error.max() / bound
    if bool(sure.all()):
        ours, theirs = tracked.sh_dc.grad.cpu(), exact.sh_dc.grad
        assert (ours - theirs).abs().max() <= weights * bound * camera.width * camera.height


def _brightest(splats: Splats) -> float:
    """A bound of every colour: |basis| over all degrees is 4 / sqrt(4 pi) = 1.13."""
    norm = (splats.sh_dc.square() + splats.sh_rest.square().sum(1)).sqrt()
    return 1.13 * norm.max().item() + 0.5


def in_any_order(case, scene, seed):
    """Asserts that a scene is the same picture in another order of its Gaussians."""
    splats, camera, degree = scene
    depths = splats.means[:, 2].sort().values
    assume(bool((depths.diff() > 1e-5).all()))  # ties go by index
    order = torch.randperm(len(splats), generator=torch.Generator().manual_seed(seed))
    first = case.render(leaves(splats), camera, GREENISH, degree)
    second = case.render(leaves(splats.select(order)), camera, GREENISH, degree)
    # the same fragments in the same order; sums of matrix products may be rounded in another way
    limit = {torch.float32: 1e-6, torch.float64: 1e-14}[case.dtype] * _brightest(splats) * 8
    sure = composited(splats, camera, GREENISH, 0).margin > 1e-4
    error = (first.rgb - second.rgb).abs().amax(-1).detach().cpu()[sure]
    assert (error <= limit).all()


COMPILED, INTERPRETED = ([case for case in CASES if case.interpreted is interpreted]
                         for interpreted in (False, True))
every_compiled_backend = pytest.mark.parametrize("case", COMPILED, ids=str)
every_interpreted_backend = pytest.mark.parametrize("case", INTERPRETED, ids=str)


def tries(count):
    """Settings that try so many scenes in the full profile, the same ones in every run."""
    return settings(max_examples=examples(count), derandomize=True, database=None,
                    suppress_health_check=list(HealthCheck))


@pytest.mark.integration
@every_compiled_backend
@tries(120)
@given(scene=scenes())
def test_any_small_scene_is_finite_and_agrees_with_float64(case, scene):
    check(case, *scene)


@pytest.mark.slow
@every_interpreted_backend
@tries(30)
@given(scene=scenes())
def test_any_small_scene_is_finite_and_agrees_with_float64_in_an_interpreter(case, scene):
    check(case, *scene)


@pytest.mark.integration
@every_compiled_backend
@tries(120)
@given(scene=scenes(), seed=st.integers(0, 100))
def test_the_order_of_any_small_scene_does_not_matter(case, scene, seed):
    in_any_order(case, scene, seed)


@pytest.mark.slow
@every_interpreted_backend
@tries(30)
@given(scene=scenes(), seed=st.integers(0, 100))
def test_the_order_of_any_small_scene_does_not_matter_in_an_interpreter(case, scene, seed):
    in_any_order(case, scene, seed)
