"""A .ply as other programs write it: what is converted, what is dropped, and what is said."""

import logging

import numpy as np
import pytest
import torch
from facts import assert_facts, raises

from recon_cli.errors import FormatError
from recon_cli.scene.splats import SH_C0
from recon_cli.splats.ply import load_ply, read_ply, write_ply
from recon_cli.splats.registry import load_splats, read_splats

N = 300
KINDS = {"float": "<f4", "double": "<f8", "uchar": "u1", "ushort": "<u2"}


@pytest.fixture(autouse=True)
def _every_warning(caplog):
    caplog.set_level(logging.WARNING, "recon")


def columns(terms=15, seed=0):
    """Raw values as a trainer has them, by the names of their properties."""
    rng = np.random.default_rng(seed)
    table = dict(zip("xyz", rng.uniform(-2, 2, (3, N)), strict=True))
    table |= {f"f_dc_{at}": rng.normal(0, 1, N) for at in range(3)}
    table |= {f"f_rest_{at}": rng.normal(0, 0.15, N) for at in range(3 * terms)}
    table |= {"opacity": rng.normal(1, 2, N)}
    table |= {f"scale_{at}": rng.uniform(-4, -2, N) for at in range(3)}
    return table | {f"rot_{at}": rng.normal(size=N) for at in range(4)}


def written(path, table, kinds=None, comments=()):
    kinds = kinds or {}
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments),
            f"element vertex {N}",
            *(f"property {kinds.get(name, 'float')} {name}" for name in table), "end_header", ""]
    rows = np.zeros(N, [(name, KINDS[kinds.get(name, "float")]) for name in table])
    for name, value in table.items():
        rows[name] = value
    path.write_bytes("\n".join(head).encode() + rows.tobytes())
    return path


def means(table):
    return np.stack([table[name] for name in "xyz"], axis=1)


def test_values_of_a_trainer_are_taken_as_they_are_without_a_word(tmp_path, caplog):
    path = written(tmp_path / "a.ply", columns())
    scene = load_ply(path)
    for name, value in read_ply(path).parameters().items():
        assert torch.equal(getattr(scene.splats, name), value), name
    assert (scene.up, scene.antialiased, scene.origin, caplog.text) == (None, False, None, "")


@pytest.mark.parametrize(("terms", "degree"), [(24, 4), (35, 5)])
def test_coefficients_above_degree_3_are_cut_off_each_channel(tmp_path, caplog, terms, degree):
    table = columns(terms)
    splats = load_ply(written(tmp_path / "a.ply", table)).splats
    for channel in range(3):
        wanted = np.stack([table[f"f_rest_{channel * terms + at}"] for at in range(15)], axis=1)
        assert np.allclose(splats.sh_rest[:, :, channel], wanted, atol=1e-6)
    assert_facts(caplog.text, degree, 3, "degree")


@pytest.mark.parametrize("count", [1, 15, 30, 44, 46, 71])
def test_a_number_of_coefficients_that_makes_no_degree_is_refused(tmp_path, count):
    table = columns(0) | {f"f_rest_{at}": np.zeros(N) for at in range(count)}
    with raises(FormatError, count, "coefficients") as caught:
        load_ply(written(tmp_path / "a.ply", table))
    assert caught.value.hint


@pytest.mark.parametrize("size", [0.0, 1e-3, 0.2, 50.0])
def test_the_filter_of_mip_splatting_widens_and_thins_gaussians(tmp_path, size, caplog):
    """Yu et al. 2024, equation 9: covariance plus f^2, and the same mass in the larger volume."""
    table = columns()
    wanted = load_ply(written(tmp_path / "a.ply", table)).splats
    table["filter_3D"] = np.full(N, size)
    table["filter_3D"][1] = 0
    back = load_ply(written(tmp_path / "b.ply", table)).splats
    f = table["filter_3D"][:, None].astype(np.float32).astype(np.float64)
    before, after = wanted.scales.double().numpy(), back.scales.double().numpy()
    assert np.allclose(after, np.sqrt(before**2 + f**2), rtol=2e-6)
    ratio = before.prod(axis=1) / np.sqrt(before**2 + f**2).prod(axis=1)
    opacities = wanted.opacities.double().numpy() * ratio
    assert np.allclose(back.opacities.double().numpy(), opacities, rtol=2e-5)
    assert torch.allclose(back.logit_opacities[1], wanted.logit_opacities[1], atol=1e-4)
    assert torch.equal(back.means, wanted.means)
    assert "filter_3D" in caplog.text


def test_doubles_far_away_are_moved_to_the_origin_before_they_are_rounded(tmp_path):
    table = columns()
    place = np.array([448262.31, 5411932.67, 301.5])
    table |= {name: table[name] + place[at] for at, name in enumerate("xyz")}
    path = written(tmp_path / "a.ply", table, dict.fromkeys("xyz", "double"))
    scene = load_ply(path)
    assert np.abs(scene.splats.means.numpy() + scene.origin.point - means(table)).max() < 1e-6
    assert scene.origin.rounding == 0.25
    assert not scene.origin.rounded
    turned = load_splats(path, axes="rub")
    assert np.allclose(turned.origin.point, scene.origin.point * np.array([1, -1, -1]))


def test_where_nothing_is_moved_a_warning_says_that_positions_are_rounded(tmp_path, caplog):
    table = columns()
    table["x"] = table["x"] + 5e6
    splats = read_splats(written(tmp_path / "a.ply", table, dict.fromkeys("xyz", "double")))
    assert np.abs(splats.means.numpy() - means(table)).max() <= 0.5
    assert_facts(caplog.text, "0.25")


def test_floats_that_were_rounded_before_are_said_to_be(tmp_path):
    table = columns()
    table["x"] = table["x"] + 5e6
    assert load_ply(written(tmp_path / "a.ply", table)).origin.rounded
    table["x"] = table["x"] - 5e6 + 500  # not far for float32
    assert load_ply(written(tmp_path / "b.ply", table)).origin is None


def test_opacities_and_sizes_instead_of_logits_and_logarithms_are_converted(tmp_path, caplog):
    table = columns()
    wanted = load_ply(written(tmp_path / "raw.ply", table)).splats
    assert caplog.text == ""
    active = {"opacity": 1 / (1 + np.exp(-table["opacity"]))} | {
        f"scale_{at}": np.exp(table[f"scale_{at}"]) for at in range(3)}
    both = load_ply(written(tmp_path / "both.ply", table | active)).splats
    assert torch.allclose(both.log_scales, wanted.log_scales, atol=1e-5)
    assert torch.allclose(both.opacities, wanted.opacities, atol=1e-3)
    assert_facts(caplog.text, 300, "logits", "between")
    assert_facts(caplog.text, "logarithms")
    one = load_ply(written(tmp_path / "one.ply", table | {"opacity": active["opacity"]})).splats
    assert torch.allclose(one.log_scales, wanted.log_scales)
    assert torch.allclose(one.opacities, wanted.opacities, atol=1e-3)
    del active["opacity"]
    other = load_ply(written(tmp_path / "other.ply", table | active)).splats
    assert torch.allclose(other.log_scales, wanted.log_scales, atol=1e-5)
    assert torch.equal(other.logit_opacities, wanted.logit_opacities)
    for name, value in read_ply(tmp_path / "both.ply").parameters().items():  # ours are raw
        assert name != "log_scales" or value.min() > 0


def test_a_scene_in_millimetres_keeps_its_logarithms(tmp_path, caplog):
    table = columns()
    table |= {name: 1000 * table[name] for name in "xyz"}
    table |= {f"scale_{at}": table[f"scale_{at}"] + np.log(1000) for at in range(3)}
    splats = load_ply(written(tmp_path / "a.ply", table)).splats
    assert splats.log_scales.min() > 0
    assert np.allclose(splats.log_scales[:, 0], table["scale_0"], atol=1e-5)
    assert caplog.text == ""


@pytest.mark.parametrize("name", ["x", "opacity", "scale_1", "rot_3", "f_dc_0", "f_rest_7"])
def test_one_nan_costs_one_gaussian(tmp_path, caplog, name):
    table = columns()
    table[name][3] = np.nan
    splats = load_ply(written(tmp_path / "a.ply", table)).splats
    assert len(splats) == N - 1
    assert np.allclose(splats.means, np.delete(means(table), 3, axis=0), atol=1e-6)
    assert_facts(caplog.text, 1, 300, "Gaussians", "finite")
    with raises(FormatError, "finite"):  # a file of ours has none
        read_ply(tmp_path / "a.ply")


def test_a_file_that_is_mostly_nan_is_refused(tmp_path):
    table = columns()
    table["x"][: N // 2] = np.nan
    assert len(load_ply(written(tmp_path / "half.ply", table)).splats) == N // 2
    table["y"][N // 2] = np.inf
    with raises(FormatError, 150, 1, 151, 300) as caught:
        load_ply(written(tmp_path / "more.ply", table))
    assert caught.value.hint


@pytest.mark.parametrize(("kind", "most"), [("uchar", 255), ("ushort", 65535), ("float", 1.0),
                                            ("float", 255.0)])
def test_red_green_and_blue_are_read_as_degree_0(tmp_path, caplog, kind, most):
    table = columns(0)
    shown = np.clip(SH_C0 * np.stack([table.pop(f"f_dc_{at}") for at in range(3)]) + 0.5, 0, 1)
    names = ("red", "green", "blue")
    table |= dict(zip(names, most * shown, strict=True))
    splats = load_ply(written(tmp_path / "a.ply", table, dict.fromkeys(names, kind))).splats
    assert splats.sh_degree == 0
    assert np.abs(SH_C0 * splats.sh_dc.numpy() + 0.5 - shown.T).max() <= 1 / 255
    assert "no f_dc" in caplog.text


@pytest.mark.parametrize(("comments", "up", "antialiased"), [
    (["Generated by Nerfstudio 1.1.5", "Vertical Axis: z"], "z", False),
    (["Vertical axis: y"], None, False),  # Brush writes it whatever is up
    (["vertical axis: -Y", "SplatRenderMode: mip"], "-y", True),
    (["SplatRenderMode: default"], None, False), (["antialiased 1"], None, True),
    (["SplatRenderMode: mip", "antialiased 0"], None, False),  # the last one counts
    (["a scene that is not antialiased"], None, False),
])
def test_comments_say_what_is_up_and_how_it_was_trained(tmp_path, comments, up, antialiased):
    scene = load_ply(written(tmp_path / "a.ply", columns(0), comments=comments))
    assert (scene.up, scene.antialiased) == (up, antialiased)


def test_comments_are_written_only_where_they_are_asked_for(tmp_path):
    splats = load_ply(written(tmp_path / "a.ply", columns(0))).splats
    write_ply(tmp_path / "plain.ply", splats)
    write_ply(tmp_path / "b.ply", splats, comments=["Vertical Axis: z"])
    assert b"comment" not in (tmp_path / "plain.ply").read_bytes()
    assert (tmp_path / "b.ply").read_bytes().replace(b"comment Vertical Axis: z\n", b"") == (
        tmp_path / "plain.ply").read_bytes()
