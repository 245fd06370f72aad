"""Differences in closed form, and pictures within a budget whatever is in them."""

import base64
import json

import cv2
import numpy as np
import pytest

from recon_cli.evaluation.scores import Metrics, ModelMetrics, ViewScore
from recon_cli.io.images import write_png
from recon_cli.report.gallery import (
    ENCODINGS,
    Gallery,
    apply_colormap,
    build_gallery,
    draw_difference,
)
from recon_cli.report.records import read_metrics


def gray(value, height=6, width=8):
    return np.full((height, width, 3), value, np.uint8)


def level(value):
    return apply_colormap(np.array([[value]], np.uint8))[0, 0]


def test_an_error_of_sixteen_steps_is_a_quarter_of_the_colours():
    assert Gallery.most_error == 64
    colors = draw_difference(gray(10), gray(26), None, 100)
    assert (colors == level(64)).all()
    assert (draw_difference(gray(10), gray(10), None, 100) == level(0)).all()
    assert (draw_difference(gray(0), gray(255), None, 100) == level(255)).all()


def test_an_error_is_taken_before_a_picture_is_reduced():
    truth = gray(100, 8, 8)
    render = truth.copy()
    render[::2], render[1::2] = 90, 110  # whose mean is the truth: reduced first, nothing differs
    colors = draw_difference(truth, render, None, 4)
    assert colors.shape == (4, 4, 3)
    assert (colors == level(40)).all()


def test_what_a_mask_hides_has_no_colour():
    hidden = np.zeros((6, 8), bool)
    hidden[:, :4] = True
    colors = draw_difference(gray(0), gray(255), hidden, 8)
    assert (colors[:, :4] == 96).all()
    assert (colors[:, 4:] == level(255)).all()


def write_metrics(folder, models):
    """Writes metrics.json of views with a name and a PSNR each, by model."""
    (folder / Metrics.FILE).write_text(json.dumps(Metrics(
        models={model: ModelMetrics.from_views(
            tuple(ViewScore(name, psnr_db, psnr_db, 0.9, 0.9) for name, psnr_db in views),
            gaussians=9, bytes=9, render_ms=1.0) for model, views in models.items()},
        psnr_convention="", psnr_8bit_convention="", ssim_convention="", ssim_padded_convention="",
        lpips_convention="", truth_digest="", width=300, height=220, test_views=6,
        unregistered_test=()).to_json()))


@pytest.fixture
def noisy(tmp_path):
    """evaluate's folder with pictures that no codec makes small: 6 views of 300x220 noise."""
    rng = np.random.default_rng(0)
    for folder in ("truth", "renders/base", "renders/pruned"):
        (tmp_path / folder).mkdir(parents=True)
    write_metrics(tmp_path, {
        model: tuple((f"{i:02d}.png", 20.0 + (i - worst) % 6) for i in range(6))
        for model, worst in (("base", 5), ("pruned", 3))})
    for i in range(6):
        for folder in ("truth", "renders/base", "renders/pruned"):
            image = rng.integers(0, 256, (220, 300, 3)).astype(np.uint8)
            write_png(tmp_path / folder / f"{i:02d}.png", image)
    return tmp_path


@pytest.mark.integration
def test_pictures_keep_their_size_where_there_is_room(noisy):
    gallery = build_gallery(noisy, read_metrics(noisy), 50_000_000)
    assert (gallery.encoding, gallery.scaled, gallery.left_out) == (ENCODINGS[0], False, 0)
    assert [view.name for view in gallery.views[:2]] == ["05.png", "00.png"]  # worst of the base
    assert (gallery.views[0].width, gallery.views[0].height) == gallery.full == (300, 220)


@pytest.mark.integration
@pytest.mark.parametrize("share", [0.7, 0.4])
def test_pictures_get_smaller_until_all_fit(noisy, share):
    whole = sum(view.size for view in build_gallery(noisy, read_metrics(noisy), 50_000_000).views)
    gallery = build_gallery(noisy, read_metrics(noisy), int(share * whole))
    assert len(gallery.views) == 6
    assert sum(view.size for view in gallery.views) <= share * whole
    assert gallery.encoding != ENCODINGS[0]


@pytest.mark.integration
def test_at_the_last_resort_the_worst_views_stay_and_the_rest_is_counted(noisy):
    least = build_gallery(noisy, read_metrics(noisy), 1)
    assert (least.views, least.left_out) == ((), 6)
    gallery = build_gallery(noisy, read_metrics(noisy), 250_000)
    assert 0 < len(gallery.views) < 6
    assert gallery.left_out == 6 - len(gallery.views)
    assert gallery.encoding == ENCODINGS[-1]
    assert gallery.views[0].name == "05.png"
    assert sum(view.size for view in gallery.views) <= 250_000


@pytest.mark.integration
def test_a_view_larger_than_a_screen_is_scaled_down(tmp_path):
    for folder in ("truth", "renders/base"):
        (tmp_path / folder).mkdir(parents=True)
        rng = np.random.default_rng(1)
        small = rng.integers(0, 256, (27, 48, 3)).astype(np.uint8)
        write_png(tmp_path / folder / "a.png",
                  cv2.resize(small, (1920, 1080), interpolation=cv2.INTER_LINEAR))
    write_metrics(tmp_path, {"base": (("a.png", 20.0),)})
    gallery = build_gallery(tmp_path, read_metrics(tmp_path), 12_000_000)
    assert (gallery.views[0].width, gallery.views[0].height) == (1600, 900)
    assert gallery.scaled
    assert gallery.full == (1920, 1080)


@pytest.mark.integration
def test_what_evaluate_did_not_score_is_gray_in_the_difference(noisy):
    (noisy / "difference" / "base").mkdir(parents=True)
    difference = np.full((220, 300, 3), 40, np.uint8)
    difference[:, :150] = 0  # masked: the pixels differ, and the difference says nothing
    write_png(noisy / "difference" / "base" / "05.png", difference)
    gallery = build_gallery(noisy, read_metrics(noisy), 50_000_000)
    views = {view.name: view for view in gallery.views}
    assert views["05.png"].masked
    assert not views["04.png"].masked
    data = base64.b64decode(views["05.png"].differences["base"].split(",")[1])
    decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(decoded[:, :140].astype(int) - 96).max() < 12
    assert decoded[:, 160:].astype(int).std() > 20
