"""Gaussians as arrays and as files."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from facts import raises
from one_gaussian_scene import one_gaussian
from splat_cases import edge_splats, few

from recon_cli.api import FormatError, InputError, Splats
from recon_cli.scene.backdrop import Backdrop
from recon_cli.scene.splats import SH_C0
from recon_cli.splats.format import WriteSettings
from recon_cli.splats.ply import FORMAT
from recon_cli.workspace.export_formats import EXPORT_FORMATS

WRITTEN = [name for name, row in EXPORT_FORMATS.items() if row.module]


def test_activated_values_are_those_of_the_raw_parameters() -> None:
    splats = Splats.from_arrays([[1, 2, 3]], [[0, 2, 0, 0]], [[1, 2, 0.5]], [0.5], [[1, 0.5, 0]])
    assert splats.log_scales.tolist() == [pytest.approx([0, np.log(2), -np.log(2)])]
    assert splats.logit_opacities.tolist() == [pytest.approx(0, abs=1e-6)]
    assert splats.sh_dc.tolist() == [pytest.approx([0.5 / SH_C0, 0, -0.5 / SH_C0])]
    assert splats.sh_degree == 0


def test_arrays_make_the_same_gaussians_again() -> None:
    rng = np.random.default_rng(1)
    given = {
        "means": rng.normal(size=(5, 3)), "quats": rng.normal(size=(5, 4)),
        "scales": rng.uniform(0.1, 2, (5, 3)), "opacities": rng.uniform(0.01, 0.99, 5),
        "sh": rng.normal(size=(5, 9, 3))}
    splats = Splats.from_arrays(**given)
    arrays = splats.arrays()
    for name, value in given.items():
        np.testing.assert_allclose(arrays[name], value, rtol=1e-5)
        assert arrays[name].dtype == np.float32
    arrays["means"][:] = 7  # a copy
    assert not (splats.means == 7).any()


def test_the_backdrop_becomes_gaussians_that_can_be_written(tmp_path) -> None:
    splats = one_gaussian(backdrop=Backdrop(0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 5.0))
    assert len(splats.arrays()["means"]) == 1
    whole = splats.with_sphere()
    assert whole.backdrop is None
    np.testing.assert_allclose(
        (whole.arrays()["sh"][1:, 0] * SH_C0 + 0.5).mean(axis=0), [0.1, 0.2, 0.3], atol=1e-5)
    whole.write(tmp_path / "whole.ply")
    assert len(Splats.read(tmp_path / "whole.ply")) == len(whole) > 1


def test_gaussians_without_coefficients_have_zeros_in_sh() -> None:
    splats = Splats.from_scene(edge_splats(2, colored=100))
    assert splats.sh.shape == (len(splats), 9, 3)
    assert not splats.sh[100:, 1:].any()
    assert torch.equal(splats.sh[:100, 1:], splats.sh_rest)


def test_gradients_pass_through_activated_values() -> None:
    scales = torch.full((1, 3), 2.0, requires_grad=True)
    one_gaussian(scales=scales).log_scales.sum().backward()
    assert scales.grad is not None
    assert scales.grad.tolist() == [[0.5] * 3]


@pytest.mark.parametrize("opacity", [0.0, 1.0])
def test_an_opacity_at_the_border_stays_finite(opacity: float) -> None:
    splats = one_gaussian(opacities=[opacity])
    assert torch.isfinite(splats.logit_opacities).all()
    assert splats.opacities.item() == pytest.approx(opacity, abs=1e-6)


@pytest.mark.parametrize(("changes", "facts"), [
    ({"quats": [[1.0, 0, 0]]}, ["quats", "(1, 3)", "(1, 4)"]),
    ({"means": 5.0}, ["means", "()"]),
    ({"sh": np.zeros((1, 5, 3))}, ["sh", "(1, 5, 3)"]),
    ({"scales": [[0.1, 0.0, 0.1]]}, ["scales", 0]),
    ({"opacities": [-2.0]}, ["opacities", -2]),
    ({"means": [[np.nan, 0, 0]]}, ["means", "finite"]),
    ({"means": torch.zeros(1, 3, dtype=torch.float64)}, ["types"]),
    ({"quats": [["a"]]}, ["quats", "array"]),
])
def test_values_that_cannot_be_used_are_named(changes: dict, facts: list) -> None:
    with raises(InputError, *facts):
        one_gaussian(**changes)


@pytest.mark.parametrize("name", WRITTEN)
def test_every_format_is_written_and_read_by_the_end_of_its_name(name: str, tmp_path) -> None:
    path = tmp_path / EXPORT_FORMATS[name].file
    path.parent.mkdir(exist_ok=True)
    splats = Splats.from_scene(few(300).map(lambda tensor: tensor.clamp(-3, 3)))
    splats.write(str(path))
    if name == "html":
        assert path.stat().st_size > 10_000
        return
    again = Splats.read(str(path))
    assert isinstance(again, Splats)
    assert len(again) >= len(splats)  # levels of detail hold more
    assert again.sh_degree == min(3, EXPORT_FORMATS[name].sh_degree)


def test_a_ply_comes_back_bit_for_bit_with_what_it_says_of_itself(tmp_path) -> None:
    first, second = tmp_path / "a.ply", tmp_path / "b.ply"
    splats = few()
    splats.backdrop = Backdrop(0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 50.0)
    FORMAT.write(first, splats, WriteSettings(up=np.array([0.0, 0, 1]), antialiased=True))
    read = Splats.read(first)
    assert read.antialiased
    assert read.up == "z"
    assert read.select(torch.arange(3)).antialiased  # which a selection keeps
    read.write(second)
    assert second.read_bytes() == first.read_bytes()


def test_a_file_that_cannot_be_written_is_refused_and_what_is_there_stays(tmp_path) -> None:
    old = tmp_path / "old.ksplat"
    old.write_text("old")
    with raises(FormatError):
        one_gaussian().write(old)
    assert old.read_text() == "old"
    with raises(InputError):
        one_gaussian().write(tmp_path / "none" / "a.ply")
    with raises(FormatError, "known", "format"):
        one_gaussian().write(tmp_path / "a.txt")
    with pytest.raises(FormatError):
        Splats.read(tmp_path / "missing.ply")
