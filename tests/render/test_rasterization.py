"""`rasterization` against a brute force in float64: every mode, every gradient, every backend."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import math

import numpy as np
import pytest
import torch
from activated_oracle import Truth, brute_force
from backends import (
    CASES,
    GRADIENT_TOLERANCE,
    IMAGE_TOLERANCE,
    MARGIN,
    ORACLE_SH_TOLERANCE,
    SUMMED,
    Case,
)
from interpreter import DEVICE

from recon_cli import rasterization
from recon_cli.errors import BackendError, ConfigError, InputError
from recon_cli.kernels.thread_pool import pool
from recon_cli.render.camera_batch import radii

# the interpreter of triton takes its tensors for those of a CPU, which `rasterization` refuses
every_case = pytest.mark.parametrize(
    "case", [case for case in CASES if not case.interpreted], ids=str)
SIZE = 40, 30
NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")


def turned(angle: float, x: float, z: float = 0.2) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0, s, x], [0, 1, 0, -0.05], [-s, 0, c, z], [0, 0, 0, 1]],
                        dtype=torch.float64)


def scene(
    n: int = 40, *, channels: int = 3, degree: int | None = None, seed: int = 0, near: bool = False,
):
    """N Gaussians in two cameras: needles, opaque and transparent ones; `near`: two before 0.05."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = uniform(n, 3) * torch.tensor([3.0, 2.4, 5]) - torch.tensor([1.5, 1.2, 0.5])
    scales = 0.02 + 0.2 * uniform(n, 3) ** 2
    scales[::7, 0] *= 6
    if near:  # z = .05 and .03
        means[:2] = torch.tensor([[-0.113, 0.052, -0.15], [-0.09, 0.045, -0.165]])
        scales[:2] *= 0.03
    opacities = uniform(n)
    opacities[3], opacities[4] = 0.0, 1.0
    shape = (n, channels) if degree is None else (n, (degree + 1) ** 2 + 1, 3)
    colors = torch.randn(*shape, generator=g, dtype=torch.float64)
    colors = colors if degree is None else 0.4 * colors
    K = torch.tensor([[40.0, 0, 21.3], [0, 44, 14.3], [0, 0, 1]], dtype=torch.float64)
    values = (means, torch.randn(n, 4, generator=g, dtype=torch.float64), scales, opacities,
              colors, torch.stack([turned(0.1, 0.1), turned(-0.2, -0.3)]),
              torch.stack([K, K * torch.tensor([[1.2], [0.9], [1]])]), uniform(2, channels))
    return dict(zip(NAMES, values, strict=True))


def narrow(values: torch.Tensor) -> torch.Tensor:
    """Rounds values of float64 to float32, and their gradients on the way back."""
    return values.float().double()


def oracle_run(
    inputs: dict[str, torch.Tensor], dtype: torch.dtype, **options
) -> tuple[Truth, dict[str, torch.Tensor]]:
    """Returns the brute force of inputs that `dtype` holds, and those inputs as leaves."""
    exact = {k: v.to(dtype).to(torch.float64, copy=True).requires_grad_()
             for k, v in inputs.items()}
    return brute_force(**exact, width=SIZE[0], height=SIZE[1], **options), exact


def weighted_loss(images, alphas, truth: Truth, sure: torch.Tensor, mode: str) -> torch.Tensor:
    """Returns a random combination of images and coverages, zero where a pixel is a lottery."""
    g = torch.Generator().manual_seed(1)
    loss = torch.zeros((), device=images.device)
    for reference, found in ((truth.images, images), (truth.alphas, alphas)):
        weights = torch.randn(reference.shape, generator=g, dtype=torch.float64) * sure
        if found is images and mode.endswith("ED"):
            # 1 - T holds a coverage of 1/255 to 1.5e-5, and an expected depth is divided by it
            weights[..., -1:] *= truth.alphas.detach()
        loss = loss + (weights.to(found) * found).sum()
    return loss


def errors_of(found: dict[str, torch.Tensor], truth: dict[str, torch.Tensor]) -> dict[str, float]:
    """Returns the relative error of each gradient; one that the truth lacks must be zero."""
    errors = {}
    for name, reference in truth.items():
        if reference is None or not reference.any():
            assert found[name] is None or not found[name].any()
        else:
            errors[name] = float(
                (found[name].cpu().double() - reference).norm() / reference.norm())
    return errors


def gradients_of(leaves: dict[str, torch.Tensor], means2d: torch.Tensor) -> dict:
    return {name: leaves[name].grad for name in NAMES} | {"means2d": means2d}


def compare(
    case: Case, inputs: dict[str, torch.Tensor], *, fault: str | None = None, **options
) -> dict[str, float]:
    """Returns each error over its bound: those of the images, and of each gradient.

    `fault` names a gradient of the backend that is made 1% too long.
    """
    truth, exact = oracle_run(inputs, case.dtype, **options)
    ours = {k: v.detach().to(device=case.device, dtype=case.dtype).requires_grad_()
            for k, v in exact.items()}
    images, alphas, meta = rasterization(
        **ours, width=SIZE[0], height=SIZE[1], packed=False, backend=case.backend, **options)
    meta["means2d"].retain_grad()
    sure = (truth.margin > MARGIN[case.dtype])[..., None]
    assert sure.double().mean() > 0.9
    mode, ratios = options.get("render_mode", ""), {}
    for name, reference, found in (("images", truth.images, images),
                                   ("alphas", truth.alphas, alphas)):
        assert found.shape == reference.shape
        off = (found.detach().cpu().double() - reference.detach()).abs() * sure
        ratios[name] = float(off.max() / reference.detach().abs().max().clamp_min(1)
                             ) / IMAGE_TOLERANCE[case.dtype]
    weighted_loss(images, alphas, truth, sure, mode).backward()
    weighted_loss(truth.images, truth.alphas, truth, sure, mode).backward()
    right = gradients_of(exact, torch.stack([x.grad for x in truth.means2d]))
    found = gradients_of(ours, meta["means2d"].grad)
    if fault is not None:
        found[fault] = 1.01 * found[fault]
    errors = errors_of(found, right)
    if case.dtype == torch.float32:
        # what the formulas lose where each is rounded, in this scene, whatever machine adds up
        narrowed, leaves = oracle_run(inputs, case.dtype, rounded=narrow, **options)
        weighted_loss(narrowed.images, narrowed.alphas, truth, sure, mode).backward()
        rounding = errors_of(
            gradients_of(leaves, torch.stack([x.grad for x in narrowed.means2d])), right)
        bounds = {name: SUMMED * error for name, error in rounding.items()}
    else:
        harmonics = options.get("sh_degree") is not None
        bounds = dict.fromkeys(errors, max(
            GRADIENT_TOLERANCE[case.dtype], ORACLE_SH_TOLERANCE if harmonics else 0))
    return ratios | {f"grad {name}": error / bounds[name] for name, error in errors.items()}


def check(ratios: dict[str, float]) -> None:
    assert not {name: ratio for name, ratio in ratios.items() if not ratio < 1}


@pytest.mark.integration
@every_case
@pytest.mark.parametrize("fault", [*NAMES, "means2d"])
def test_a_gradient_that_is_one_percent_too_long_is_noticed(case: Case, fault: str) -> None:
    ratios = compare(case, scene(20, degree=1), sh_degree=1, fault=fault)
    assert {name for name, ratio in ratios.items() if ratio > 1} == {f"grad {fault}"}


@pytest.mark.integration
@every_case
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_every_mode_agrees_with_the_brute_force(
        case: Case, render_mode: str, rasterize_mode: str) -> None:
    check(compare(case, scene(), render_mode=render_mode, rasterize_mode=rasterize_mode))


@every_case
@pytest.mark.parametrize("channels", [1, 7])
def test_features_of_any_width_and_sign(case: Case, channels: int) -> None:
    check(compare(case, scene(channels=channels), render_mode="RGB+D"))


@every_case
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_harmonics(case: Case, degree: int) -> None:
    check(compare(case, scene(20, degree=degree), sh_degree=degree))


@pytest.mark.integration
@every_case
def test_colours_and_harmonics_of_each_camera(case: Case) -> None:
    inputs = scene(20)
    inputs["colors"] = torch.stack([inputs["colors"], inputs["colors"].flip(0)])
    check(compare(case, inputs))
    inputs = scene(20, degree=2)
    inputs["colors"] = torch.stack([inputs["colors"], inputs["colors"].flip(0)])
    check(compare(case, inputs, sh_degree=2))


@every_case
@pytest.mark.parametrize("planes", [(0.01, 1e10), (0.035, 1e10), (1.0, 3.0)])
def test_planes(case: Case, planes: tuple[float, float]) -> None:
    check(compare(case, scene(near=True), near_plane=planes[0], far_plane=planes[1]))


def test_the_near_plane_is_nearer_than_that_of_training() -> None:
    inputs = {k: v.float() for k, v in scene(near=True).items()}
    shown = []
    for plane in (0.01, 0.1):
        meta = call(**inputs, near_plane=plane)[2]
        shown.append({0, 1} & set(meta["gaussian_ids"][meta["camera_ids"] == 0].tolist()))
    assert shown == [{0, 1}, set()]


@pytest.mark.integration
@pytest.mark.parametrize("case", [c for c in CASES if c.backend == "torch"], ids=str)
def test_the_torch_backend_takes_any_low_pass_filter(case: Case) -> None:
    for eps2d in (0.05, 1.5):
        check(compare(case, scene(), eps2d=eps2d, rasterize_mode="antialiased"))


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="triton is not installed")
def test_triton_gives_every_gradient(monkeypatch) -> None:
    """Without a GPU in its interpreter, on a CPU, where `rasterization` would refuse it."""
    module = importlib.import_module("recon_cli.render.rasterization")
    monkeypatch.setattr(module, "_resolve", lambda backend, _device: backend)
    case = Case("triton", DEVICE, torch.float32)
    check(compare(case, scene(10, degree=1), sh_degree=1, render_mode="RGB+D"))
    check(compare(case, scene(10), rasterize_mode="antialiased"))


def call(**changes):
    inputs = {k: v.float() for k, v in scene().items()} | {"width": SIZE[0], "height": SIZE[1]}
    return rasterization(**(inputs | changes))


@pytest.mark.integration
def test_tiny_and_negative_scales_keep_their_gradients() -> None:
    inputs = scene()
    inputs["scales"][5:9] = torch.tensor([1e-6, -0.2, 1e-12, 0.1])[:, None]
    check(compare(Case("torch", "cpu", torch.float64), inputs))
    check(compare(Case("numba", "cpu", torch.float32), inputs))
    flat = scene()["scales"].float()
    flat[:, 2] = 0
    flat.requires_grad_()
    call(scales=flat)[0].sum().backward()
    assert torch.isfinite(flat.grad).all()
    assert not flat.grad[:, 2].any()  # a covariance is even in each scale


@pytest.mark.integration
def test_the_gradient_of_an_opacity_of_one_is_that_of_one_just_below() -> None:
    gradients = []
    for value in (1.0, 1 - 1e-6):
        opacities = scene()["opacities"].float()
        opacities[4] = value
        opacities.requires_grad_()
        call(opacities=opacities)[0].square().sum().backward()
        gradients.append(opacities.grad)
    assert gradients[0][4] != 0
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-5)


def test_a_packed_layout_holds_the_same_rows() -> None:
    images, alphas, meta = call(packed=True)
    others, coverages, full = call(packed=False)
    assert torch.equal(images, others)
    assert torch.equal(alphas, coverages)
    where = meta["camera_ids"], meta["gaussian_ids"]
    for name in ("means2d", "depths", "radii", "conics", "opacities"):
        assert torch.equal(full[name][where], meta[name])
    assert full["gaussian_ids"] is None
    hidden = torch.ones_like(full["radii"][..., 0], dtype=torch.bool)
    hidden[where] = False
    assert hidden.any()
    assert not full["radii"][hidden].any()
    assert (meta["radii"] > 0).all()
    assert meta["n_cameras"] == 2
    assert (meta["tile_width"], meta["tile_height"]) == (3, 2)


def test_meta_says_what_gaussians_are_projected_to() -> None:
    _, _, meta = call(packed=False, rasterize_mode="antialiased")
    truth = brute_force(**{k: v.requires_grad_() for k, v in scene().items()}, width=SIZE[0],
                        height=SIZE[1], rasterize_mode="antialiased")
    seen = (meta["radii"] > 0).all(-1)
    for name, reference in (("means2d", torch.stack(truth.means2d)), ("conics", truth.conics),
                            ("opacities", truth.opacities)):
        torch.testing.assert_close(
            meta[name][seen].double(), reference[seen].detach(), rtol=1e-4, atol=1e-4)
    assert dict(meta).keys() == dict(meta.items()).keys()
    assert all(not callable(value) for value in meta.values())


def test_radii_reach_where_alpha_is_one_step() -> None:
    cov2d = torch.tensor([[4.0, 1, 9], [4, 0, 9], [4, 0, 9]])
    found = radii(cov2d, torch.tensor([1.0, 2 / 255, 1 / 255]))
    assert found.tolist() == [[7, 10], [3, 4], [0, 0]]  # 3.329, 1.177 and 0 standard deviations


def test_radius_clip_hides_the_small_ones_alone() -> None:
    _, _, meta = call(packed=False)
    images, _, fewer = call(packed=False, radius_clip=8.0)
    small = (meta["radii"] <= 8).all(-1)
    assert small.any()
    assert torch.equal(fewer["radii"] > 0, (meta["radii"] > 0) & ~small[..., None])
    assert not torch.equal(images, call()[0])


def test_other_uses_of_projected_means_reach_the_gaussians() -> None:
    """The gradient that images give to means2d goes to the means once, that of a loss too."""
    results = []
    for parts in ("image", "pixels", "both"):
        means = scene()["means"].requires_grad_()
        images, _, meta = call(
            **{k: v for k, v in scene().items() if k != "means"}, means=means, packed=True)
        meta["means2d"].retain_grad()
        loss = torch.zeros(())
        if parts != "pixels":
            loss = loss + images.square().sum()
        if parts != "image":
            loss = loss + meta["means2d"].square().sum()
        loss.backward()
        results.append((means.grad, meta["means2d"].grad))
    for image, pixels, both in zip(*results, strict=True):
        assert image.any()
        assert pixels.any()
        torch.testing.assert_close(image + pixels, both, rtol=1e-9, atol=1e-9)


def test_nothing_is_kept_where_no_gradient_is_asked_for() -> None:
    images, _, meta = call()
    assert not images.requires_grad
    assert not meta["means2d"].requires_grad
    with torch.no_grad():
        images, _, _ = call(means=scene()["means"].float().requires_grad_())
    assert not images.requires_grad


def test_gradients_of_means2d_do_not_need_those_of_means() -> None:
    colors = scene()["colors"].float().requires_grad_()
    images, _, meta = call(colors=colors)
    meta["means2d"].retain_grad()  # as densification does
    images.square().sum().backward()
    every = {k: v.float().requires_grad_() for k, v in scene().items()}
    images, _, same = call(**every)
    same["means2d"].retain_grad()
    images.square().sum().backward()
    assert torch.equal(meta["means2d"].grad, same["means2d"].grad)


def test_the_same_call_gives_the_same_bits_and_backward_runs_twice() -> None:
    gradients = []
    for _ in range(2):
        means = scene()["means"].float().requires_grad_()
        images, _, _ = call(means=means)
        images.square().sum().backward(retain_graph=True)
        gradients.append(means.grad.clone())
        images.square().sum().backward()
    assert torch.equal(*gradients)
    assert torch.equal(means.grad, 2 * gradients[0])


def test_a_scene_without_gaussians_shows_the_background() -> None:
    empty = {k: v[:0].float() for k, v in scene().items() if k in NAMES[:5]}
    for backend in ("torch", "numba"):
        images, alphas, meta = call(**empty, backend=backend)
        expected = scene()["backgrounds"].float()[:, None, None].expand_as(images)
        torch.testing.assert_close(images, expected)
        assert not alphas.any()
        assert len(meta["radii"]) == 0


@pytest.mark.parametrize("name", ["means", "scales", "opacities", "colors"])
def test_a_value_that_is_not_finite_hides_its_gaussian_alone(name: str) -> None:
    inputs = {k: v.float() for k, v in scene().items()}
    without = {k: torch.cat([v[:6], v[7:]]) if k in NAMES[:5] else v for k, v in inputs.items()}
    inputs[name][6] = torch.nan
    leaves = {k: v.requires_grad_() for k, v in inputs.items()}
    images, _, meta = call(**leaves)
    torch.testing.assert_close(images.detach(), call(**without)[0])
    assert 6 not in meta["gaussian_ids"]
    images.sum().backward()
    assert all(torch.isfinite(leaf.grad).all() for leaf in leaves.values())


def test_numbers_of_threads_stay_as_they_were() -> None:
    torch.set_num_threads(2)  # the fixture `one_thread` restores it
    before = pool.threads
    call(means=scene()["means"].float().requires_grad_(), backend="numba")[0].sum().backward()
    assert torch.get_num_threads() == 2
    assert pool.threads == before


def test_arguments_that_change_nothing_are_accepted() -> None:
    plain = call()[0]
    assert torch.equal(plain, call(
        packed=False, sparse_grad=True, tile_size=8, channel_chunk=2, segmented=True,
        distributed=False)[0])


@pytest.mark.parametrize(("changes", "error", "hint"), [
    ({"absgrad": True}, ConfigError, "means2d"),
    ({"distributed": True}, ConfigError, "distributed"),
    ({"covars": torch.zeros(40, 3, 3)}, ConfigError, "quats"),
    ({"with_ut": True}, ConfigError, "undistort"),
    ({"camera_model": "fisheye"}, ConfigError, "Undistort"),
    ({"render_mode": "RGBD"}, ConfigError, "RGB"),
    ({"rasterize_mode": "mip"}, ConfigError, "antialiased"),
    ({"sh_degree": 4}, ConfigError, "sh_degree=3"),
    ({"near_plane": 0.0}, ConfigError, "near_plane"),
    ({"eps2d": 0.0}, ConfigError, "0.3"),
    ({"width": 0}, ConfigError, "1x1"),
    ({"sh_degree": 1}, InputError, "sh_degree"),
    ({"means": torch.zeros(2, 40, 3)}, InputError, "batches"),
    ({"quats": torch.zeros(39, 4)}, InputError, "N Gaussians"),
    ({"scales": torch.ones(40, 3).double()}, InputError, "scales.to"),
    ({"opacities": torch.full((40,), 1.5)}, InputError, "sigmoid"),
    ({"backgrounds": torch.zeros(2, 4)}, InputError, "cameras"),
    ({"viewmats": 2 * torch.eye(4).repeat(2, 1, 1)}, InputError, "rotation"),
    ({"Ks": torch.ones(2, 3, 3)}, InputError, "skew"),
    ({"backend": "opengl"}, BackendError, "numba"),
    ({"backend": "numba", "eps2d": 0.1}, BackendError, "torch"),
], ids=str)
def test_what_cannot_be_done_is_said(changes, error, hint) -> None:
    with pytest.raises(error) as caught:
        call(**changes)
    assert hint in caught.value.hint


@pytest.mark.integration
def test_the_test_scene_of_gsplat_agrees_with_float64(shared_data) -> None:
    """Every tenth Gaussian of its garden at a quarter of the size, in its three views."""
    with np.load(shared_data / "gsplat_garden" / "test_garden.npz", allow_pickle=False) as held:
        means, colors = held["means3d"][::10], held["colors"][::10] / np.float32(255)
        viewmats, Ks = held["viewmats"], held["Ks"]
    g = torch.Generator().manual_seed(0)
    n = len(means)
    inputs = [torch.from_numpy(means), torch.randn(n, 4, generator=g),
              0.08 * torch.rand(n, 3, generator=g), torch.rand(n, generator=g),
              torch.from_numpy(colors), torch.from_numpy(viewmats),
              torch.from_numpy(Ks) * torch.tensor([[0.25], [0.25], [1]])]
    results = []
    for dtype, backend in ((torch.float64, "torch"), (torch.float32, "numba")):
        leaves = [x.to(dtype, copy=True).requires_grad_() for x in inputs]
        images, alphas, _ = rasterization(*leaves, 162, 105, render_mode="RGB+D", backend=backend)
        (images.mean() + alphas.mean()).backward()
        results.append((images.detach().double(), [leaf.grad.double() for leaf in leaves]))
    (truth, exact), (found, gradients) = results
    off = ((found - truth).abs() / truth.abs().amax()).amax(-1)
    assert (off > 1e-5).double().mean() < 2e-3  # pixels with a fragment at a threshold
    assert off.max() < 1 / 255
    for ours, theirs in zip(gradients, exact, strict=True):
        assert (ours - theirs).norm() < 2e-3 * theirs.norm()


def test_the_signature_is_that_of_gsplat() -> None:
    found = {name: parameter.default
             for name, parameter in inspect.signature(rasterization).parameters.items()}
    required = {*NAMES[:-1], "width", "height"}
    assert list(found)[:9] == [*NAMES[:-1], "width", "height"]
    assert {name for name, default in found.items() if default is inspect.Parameter.empty} == (
        required)
    assert {name: default for name, default in found.items() if name not in required} == {
        "near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3, "sh_degree": None,
        "packed": True, "tile_size": 16, "backgrounds": None, "render_mode": "RGB",
        "sparse_grad": False, "absgrad": False, "rasterize_mode": "classic", "channel_chunk": 32,
        "distributed": False, "camera_model": "pinhole", "segmented": False, "covars": None,
        "with_ut": False, "with_eval3d": False, "radial_coeffs": None, "tangential_coeffs": None,
        "thin_prism_coeffs": None, "ftheta_coeffs": None, "rolling_shutter": None,
        "viewmats_rs": None, "backend": "auto"}
