"""Splat files are converted, merged and reduced, or refused with nothing left behind."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from archive_splats import room
from facts import assert_facts, raises

from recon_cli.context import StageContext
from recon_cli.errors import ConfigError, FormatError, InputError, ReconError, ReconstructionError
from recon_cli.export.cleanup import drop_floaters_without_views
from recon_cli.export.convert import Converted, ConvertRequest, convert
from recon_cli.export.describe_file import describe_file
from recon_cli.scene.backdrop import Backdrop
from recon_cli.scene.similarity import Similarity
from recon_cli.scene.splats import Splats, transformed
from recon_cli.splats.format import WriteSettings
from recon_cli.splats.ply import read_ply, write_ply
from recon_cli.splats.registry import FORMATS, load_splats, read_splats

CONTEXT = StageContext(backend="numba")
BACKDROP = Backdrop(0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 3.0)
FILES = {name: "lod-meta.json" if name == "lod" else f"room.{name}" for name in FORMATS}
TURN = Similarity(
    2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([10.0, 20, 30]))


def run(*paths: Path, **changes: object) -> Converted:
    return convert(ConvertRequest(tuple(paths[:-1]), paths[-1], **changes), CONTEXT)


def ply(path: Path, splats: Splats, **settings: object) -> Path:
    FORMATS["ply"].write(path, splats, WriteSettings(**settings))
    return path


def same(one: Splats, other: Splats) -> bool:
    return all(torch.equal(value, getattr(other, name)) for name, value in one.parameters().items())


# Each from and to a PLY, itself and a neighbour: between reading and writing all are the same.
@pytest.mark.parametrize(("first", "second"), [
    (first, second)
    for (first, after), second in itertools.product(
        itertools.pairwise([*FORMATS, next(iter(FORMATS))]), FORMATS)
    if second in (first, after, "ply") or first == "ply"])
def test_each_format_becomes_each_other(first: str, second: str, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    splats = room(60, degree=1)
    source, out = tmp_path / "a" / FILES[first], tmp_path / "b" / FILES[second]
    FORMATS[first].write(source, splats)
    done = run(source, out, max_loss=9.0)
    back = read_splats(out)
    assert len(back) == done.gaussians == 60
    assert torch.allclose(back.means.mean(0), splats.means.mean(0), atol=1e-2)
    assert done.bytes > 0
    if second == "ply":
        assert same(back.with_degree(done.sh_degree), read_splats(source))
        assert done.psnr_change_db == 0
    assert not list(tmp_path.rglob(".*"))  # no scratch folder


def test_a_ply_stays_bit_for_bit_with_its_backdrop(tmp_path: Path) -> None:
    splats = replace(room(50), backdrop=BACKDROP)
    run(ply(tmp_path / "a.ply", splats), tmp_path / "b.ply")
    assert same(read_ply(tmp_path / "b.ply"), splats)
    assert read_ply(tmp_path / "b.ply").backdrop == BACKDROP


def test_each_input_is_placed_by_its_own_transform(tmp_path: Path) -> None:
    first, second = room(30, degree=0), room(20, degree=2, seed=1)
    run(ply(tmp_path / "a.ply", first), ply(tmp_path / "b.ply", second), tmp_path / "c.ply",
        transforms=(Similarity(), TURN))
    back = read_ply(tmp_path / "c.ply")
    x, y, z = second.means.unbind(1)  # a quarter turn about z, twice as large, moved
    placed = torch.stack([10 - 2 * y, 20 + 2 * x, 30 + 2 * z], dim=1)
    expected = torch.cat([placed, first.means])  # those with coefficients first
    assert torch.allclose(back.means, expected, atol=1e-5)
    assert torch.allclose(back.scales[:20], 2 * second.scales, rtol=1e-5)
    assert back.sh_degree == 2
    assert same(back.select(torch.arange(20)), transformed(second, TURN))


def test_scale_and_up_turn_the_whole_scene(tmp_path: Path) -> None:
    splats = room(30)
    run(ply(tmp_path / "a.ply", splats, up=np.array([0.0, 0, 1])), tmp_path / "b.ply",
        up="y", scale=3.0)
    x, y, z = splats.means.unbind(1)
    assert torch.allclose(
        read_ply(tmp_path / "b.ply").means, 3 * torch.stack([x, z, -y], dim=1), atol=1e-5)
    run(tmp_path / "a.ply", tmp_path / "c.ply")
    assert load_splats(tmp_path / "c.ply").up == "z"
    assert load_splats(tmp_path / "b.ply").up == "y"
    run(tmp_path / "a.ply", tmp_path / "d.spz", up="-y", max_loss=9.0)
    assert load_splats(tmp_path / "d.spz").up == "-y"


def test_only_scenes_that_are_all_antialiased_say_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one = ply(tmp_path / "a.ply", room(30), antialiased=True)
    other = ply(tmp_path / "b.ply", replace(room(20), backdrop=BACKDROP))
    run(one, one, tmp_path / "c.ply")
    assert load_splats(tmp_path / "c.ply").antialiased
    assert not caplog.messages
    run(one, other, tmp_path / "d.ply")
    assert not load_splats(tmp_path / "d.ply").antialiased
    assert_facts(caplog.text, "a.ply")
    run(other, other, tmp_path / "e.ply")
    assert_facts(caplog.text, 2, "scenes", "backdrop")
    assert read_ply(tmp_path / "e.ply").backdrop == BACKDROP


def test_far_scenes_are_merged_about_the_origin_of_the_first(tmp_path: Path) -> None:
    splats = room(200)
    paths = []
    for number, shift in enumerate((500_000.0, 500_004.0)):
        table = splats.means.double() + torch.tensor([shift, 0, 0])
        paths.append(_write_doubles(tmp_path / f"{number}.ply", splats, table))
    run(*paths, tmp_path / "c.ply")
    means = read_ply(tmp_path / "c.ply").means
    assert means.norm(dim=1).max() < 100
    assert torch.allclose(means[200:] - means[:200], torch.tensor([4.0, 0, 0]), atol=1e-4)


def _write_doubles(path: Path, splats: Splats, means: torch.Tensor) -> Path:
    """Writes a .ply with positions of 64 bits, degree 0."""
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
             *(f"scale_{at}" for at in range(3)), *(f"rot_{at}" for at in range(4))]
    table = torch.cat([
        means, splats.sh_dc, splats.logit_opacities[:, None], splats.log_scales, splats.quats],
        dim=1).double().numpy()
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(means)}",
              *(f"property double {name}" for name in names), "end_header", ""]
    path.write_bytes("\n".join(header).encode() + table.tobytes())
    return path


@pytest.mark.integration
def test_the_scene_is_reduced_as_asked(tmp_path: Path) -> None:
    source = ply(tmp_path / "a.ply", replace(room(400), backdrop=BACKDROP))
    fewer = run(source, tmp_path / "b.ply", max_gaussians=100, sh_degree=1)
    back = read_ply(tmp_path / "b.ply")
    assert (len(back), back.sh_degree, back.backdrop) == (100, 1, BACKDROP)
    assert fewer.gaussians == len(back.with_sphere())  # all that the file holds
    assert describe_file(tmp_path / "b.ply", CONTEXT).gaussians == fewer.gaussians
    small = run(source, tmp_path / "c.spz", max_mb=0.02, max_loss=9.0)
    assert small.bytes == (tmp_path / "c.spz").stat().st_size <= 20_000
    low, high = read_ply(source).means.quantile(0.2, dim=0), read_ply(source).means.amax(dim=0)
    run(source, tmp_path / "d.ply", crop=(*low.tolist(), *high.tolist()))
    cropped = read_ply(tmp_path / "d.ply")
    assert 0 < len(cropped) < 400
    assert (cropped.means >= low).all()
    assert cropped.backdrop is None
    with raises(ConfigError, "Gaussian"):
        run(source, tmp_path / "e.ply", crop=(1e3, 1e3, 1e3, 2e3, 2e3, 2e3))


def made() -> Splats:
    """A wall of 400 touching Gaussians, and four more: unseen, haze, alone, opaque and large."""
    grid = torch.cartesian_prod(torch.arange(20.0), torch.arange(20.0), torch.zeros(1)) / 10
    more = torch.tensor([[1.0, 1, 0], [1, 1, 0.1], [1, 1, 3], [1, 1, 0]])
    means = torch.cat([grid, more])
    sizes, opacities = torch.full((404,), 0.1), torch.full((404,), 0.9)
    sizes[400:] = torch.tensor([0.1, 0.5, 0.01, 0.5])
    opacities[400:] = torch.tensor([0.001, 0.05, 0.9, 0.9])
    return Splats(
        means, torch.tensor([[1.0, 0, 0, 0]]).repeat(404, 1), sizes.log()[:, None].repeat(1, 3),
        torch.logit(opacities), torch.zeros(404, 3), torch.zeros(0, 0, 3))


@pytest.mark.integration
def test_without_views_the_invisible_haze_and_what_is_alone_are_floaters(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    kept = drop_floaters_without_views(made(), ([1.0, 1.0, 0.0], 50.0))
    assert torch.equal(kept.means, made().means[[*range(400), 403]])
    done = run(ply(tmp_path / "a.ply", made()), tmp_path / "b.ply", drop_floaters=True,
               drop_islands=True)
    assert done.gaussians == 401
    assert_facts(caplog.text, "views", "here")


def test_an_existing_file_is_replaced_by_force_alone(tmp_path: Path) -> None:
    source, out = ply(tmp_path / "a.ply", room(30)), tmp_path / "b.ply"
    out.write_text("mine")
    with raises(InputError) as caught:
        run(source, out)
    assert "--force" in caught.value.hint
    assert out.read_text() == "mine"
    run(source, out, force=True)
    assert len(read_ply(out)) == 30
    run(out, out, force=True, scale=2.0)  # onto itself
    assert torch.allclose(read_ply(out).means, 2 * room(30).means)


def test_levels_replace_only_their_own_files(tmp_path: Path) -> None:
    source, out = ply(tmp_path / "a.ply", room(30)), tmp_path / "lod-meta.json"
    run(source, out, max_loss=9.0)
    (tmp_path / "1_0").mkdir()  # of a larger scene
    run(source, out, max_loss=9.0, force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0_0", "a.ply", "lod-meta.json"]
    assert len(read_splats(out)) == 30


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-9])


def _empty(path: Path) -> None:
    write_ply(path, room(30).select(torch.arange(0)))


def _nan(path: Path) -> None:
    splats = room(30)
    splats.means[:] = math.nan
    write_ply(path, splats)


@pytest.mark.parametrize("damage", [_cut, _empty, _nan, Path.unlink])
def test_a_damaged_input_leaves_everything_as_it_was(damage: object, tmp_path: Path) -> None:
    source, out = ply(tmp_path / "a.ply", room(30)), tmp_path / "b.spz"
    out.write_text("mine")
    damage(source)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(FormatError) as caught:
        run(source, out, force=True)
    assert str(source) in caught.value.message
    assert sorted(path.name for path in tmp_path.iterdir()) == before
    assert out.read_text() == "mine"


def test_a_file_that_loses_too_much_is_not_written(tmp_path: Path) -> None:
    source = ply(tmp_path / "a.ply", room(300, degree=3))
    with raises(ReconstructionError, "lose") as caught:
        run(source, tmp_path / "b.splat", max_loss=0.0)
    assert "--max-loss" in caught.value.hint
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize(("name", "changes"), [
    ("b.ksplat", {}), ("b.xyz", {}), ("no/b.ply", {}), ("b.ply", {"transforms": (TURN, TURN)})])
def test_what_cannot_be_made_is_refused_with_a_hint(
    name: str, changes: dict[str, object], tmp_path: Path
) -> None:
    source = ply(tmp_path / "a.ply", room(30))
    with pytest.raises(ReconError) as caught:
        run(source, tmp_path / name, **changes)
    assert caught.value.hint


def test_a_file_is_described_by_what_it_holds(tmp_path: Path) -> None:
    splats = made()
    splats.quats[0] = 0
    splats.quats[1] = torch.tensor([2.0, 0, 0, 0])
    splats.log_scales[2], splats.log_scales[3, 1] = -math.inf, math.log(1e-9)
    path = ply(tmp_path / "a.ply", splats, up=np.array([0.0, 0, 1]), antialiased=True)
    found = describe_file(path, CONTEXT)
    assert (found.format, found.gaussians, found.sh_degree) == ("ply", 404, 0)
    assert (found.up, found.antialiased, found.backdrop) == ("z", True, False)
    assert_facts(found.writer, "Vertical", "Axis")
    assert found.bytes == path.stat().st_size
    assert found.bounds[0] == pytest.approx([0, 0, 0])
    assert found.bounds[1] == pytest.approx([1.9, 1.9, 3])
    assert found.bulk_bounds[1] == pytest.approx([1.8, 1.8, 0])
    assert found.median_size == pytest.approx(0.1, rel=1e-5)
    assert found.nearly_transparent == 1 / 404
    assert found.tiny == 1 / 404
    assert found.huge == 2 / 404
    assert found.overdraw is not None
    assert 1 < found.overdraw < 404
    text = "\n".join(found.problems)
    assert_facts(text, 3, 0, "scales")  # the other one is small
    assert_facts(text, 2, 404, "Gaussians", "flat")
    assert_facts(text, 1, 404, 0, "rotations")
    assert "length" not in text  # of quaternions, which is 1 in few files
    assert_facts(found.describe(), 404, 0, "degree")


def test_one_gaussian_before_every_camera_is_drawn_over_nothing(tmp_path: Path) -> None:
    one = made().select(torch.tensor([0]))
    assert describe_file(ply(tmp_path / "a.ply", one), CONTEXT).overdraw == pytest.approx(
        1, abs=0.05)


@pytest.mark.integration
def test_problems_on_reading_and_far_scenes_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bad = made()
    bad.means[0] = math.nan
    text = describe_file(ply(tmp_path / "a.ply", bad), CONTEXT).problems[0]
    assert_facts(text, 1, 404, "Gaussians", "finite")
    far = made()
    far.means += 1000.0
    assert_facts("\n".join(describe_file(ply(tmp_path / "b.ply", far), CONTEXT).problems), "far")
    far.means += 1e7
    rounded = describe_file(ply(tmp_path / "c.ply", far), CONTEXT)
    assert_facts("\n".join(rounded.problems), "rounded")
    assert rounded.bounds[0][0] == pytest.approx(1e7 + 1000, rel=1e-6)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
