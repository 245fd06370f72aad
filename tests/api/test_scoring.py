"""Scores of renders of any origin."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from facts import raises

from recon_cli.api import InputError, evaluate
from recon_cli.evaluation import metrics

RNG = np.random.default_rng(3)
TRUTHS = [RNG.integers(0, 256, (24, 30, 3), dtype=np.uint8) for _ in range(3)]
RENDERS = [np.clip(truth / 255 + RNG.normal(0, 0.1, truth.shape), 0, 1) for truth in TRUTHS]


def save(folder, images, suffix=".png") -> None:
    folder.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"view{number}{suffix}"), image[..., ::-1])


def test_scores_are_the_means_of_those_of_each_view() -> None:
    scores = evaluate(RENDERS, TRUTHS)
    expected = [-10 * np.log10(np.mean((render - truth / 255) ** 2))
                for render, truth in zip(RENDERS, TRUTHS, strict=True)]
    assert [view.psnr_db for view in scores.views] == pytest.approx(expected, abs=1e-4)
    assert scores.psnr_db == pytest.approx(np.mean(expected), abs=1e-4)
    assert scores.ssim == pytest.approx(np.mean([
        metrics.ssim(np.float32(render), truth)
        for render, truth in zip(RENDERS, TRUTHS, strict=True)]))
    assert [view.name for view in scores.views] == ["0", "1", "2"]


def test_tensors_bytes_and_stacks_score_as_arrays_do() -> None:
    eight = [metrics.np.asarray(np.round(255 * render), np.uint8) for render in RENDERS]
    of_bytes = evaluate(eight, TRUTHS)
    assert of_bytes.psnr_db == pytest.approx(of_bytes.psnr_8bit_db, abs=1e-4)
    of_floats = evaluate([image / 255 for image in eight], [image / 255 for image in TRUTHS])
    assert of_floats.psnr_db == pytest.approx(of_bytes.psnr_db, abs=1e-4)
    of_tensors = evaluate(torch.tensor(np.stack(RENDERS), requires_grad=True), np.stack(TRUTHS))
    assert of_tensors.psnr_db == pytest.approx(evaluate(RENDERS, TRUTHS).psnr_db, abs=1e-4)


def test_equal_images_have_the_highest_scores() -> None:
    scores = evaluate(TRUTHS, TRUTHS)
    assert (scores.psnr_db, scores.ssim) == (pytest.approx(100), pytest.approx(1))


def test_folders_are_paired_by_name_whatever_the_suffix(tmp_path) -> None:
    save(tmp_path / "truth", TRUTHS)
    eight = [np.uint8(np.round(255 * render)) for render in RENDERS]
    save(tmp_path / "ours", eight, ".bmp")
    by_folder = evaluate(tmp_path / "ours", str(tmp_path / "truth"))
    assert by_folder.psnr_db == pytest.approx(evaluate(eight, TRUTHS).psnr_db)
    assert [view.name for view in by_folder.views] == ["view0", "view1", "view2"]
    mixed = evaluate(eight, tmp_path / "truth")  # a list is paired in order
    assert mixed.views == by_folder.views
    named = evaluate({f"view{n}": eight[n] for n in (2, 0, 1)}, tmp_path / "truth")
    assert named.psnr_db == pytest.approx(by_folder.psnr_db)


def test_pixels_under_a_mask_do_not_matter(tmp_path) -> None:
    mask = np.ones(TRUTHS[0].shape[:2], bool)
    mask[:, :8] = False
    spoiled = [np.where(mask[..., None], render, 0) for render in RENDERS]
    scores = evaluate(spoiled, TRUTHS, masks=[mask] * 3)
    assert scores.psnr_db == pytest.approx(evaluate(RENDERS, TRUTHS, masks=[mask] * 3).psnr_db)
    assert scores.views[0].pixels_scored == pytest.approx(22 / 30)
    assert scores.lpips is None
    one = evaluate(spoiled, TRUTHS, masks=[mask, None, None])
    assert [view.pixels_scored for view in one.views][1:] == [None, None]
    (tmp_path / "masks").mkdir()
    for name in ("0", "1", "2"):
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), mask.astype(np.uint8) * 255)
    assert evaluate(spoiled, TRUTHS, masks=tmp_path / "masks").views == scores.views


@pytest.mark.parametrize(("renders", "truths", "facts"), [
    (RENDERS[:2], TRUTHS, ["2 renders", "3 truths"]),
    ({"a": RENDERS[0]}, {"b": TRUTHS[0]}, ["a", "b", 1]),
    ([RENDERS[0][:-1]], [TRUTHS[0]], ["30x23", "30x24"]),
    ([255 * RENDERS[0]], [TRUTHS[0]], ["renders", 0, "values"]),
    ([RENDERS[0]], [TRUTHS[0].astype(np.float32)], ["truths", 0, "values"]),
    ([RENDERS[0].transpose(2, 0, 1)], [TRUTHS[0]], ["(3, 24, 30)"]),
    ([np.full((24, 30, 3), np.nan)], [TRUTHS[0]], ["finite"]),
    ([RENDERS[0][:5, :5]], [TRUTHS[0][:5, :5]], ["SSIM", 11]),
    ([np.zeros((24, 30, 3), int)], [TRUTHS[0]], ["int64"]),
    ([], [], ["renders"]),
])
def test_what_cannot_be_compared_is_named(renders, truths, facts: list) -> None:
    with raises(InputError, *facts):
        evaluate(renders, truths)


def test_masks_that_do_not_fit_are_named() -> None:
    with raises(InputError, "2x2"):
        evaluate(RENDERS[:1], TRUTHS[:1], masks=[np.ones((2, 2), bool)])
    with raises(InputError, "leaves", "fewer"):
        evaluate(RENDERS[:1], TRUTHS[:1], masks=[np.zeros((24, 30), bool)])
    with raises(InputError, "Masks", "render"):
        evaluate(RENDERS[:1], TRUTHS[:1], masks={"x": np.ones((24, 30), bool)})


def test_files_that_would_be_misread_are_refused(tmp_path) -> None:
    save(tmp_path / "truth", TRUTHS[:1])
    for name, content, fact in (("clear", np.zeros((24, 30, 4), np.uint8), "transparent"),
                                ("damaged", None, "damaged/view0.png")):
        folder = tmp_path / name
        folder.mkdir()
        if content is None:
            (folder / "view0.png").write_bytes(b"not an image")
        else:
            cv2.imwrite(str(folder / "view0.png"), content)
        with raises(InputError, fact):
            evaluate(folder, tmp_path / "truth")
    with raises(InputError):
        evaluate(tmp_path / "none", tmp_path / "truth")
    (tmp_path / "empty").mkdir()
    with raises(InputError, "images"):
        evaluate(tmp_path / "empty", tmp_path / "truth")


def test_sixteen_bits_are_not_rounded_to_eight(tmp_path) -> None:
    deep = np.full((24, 30, 3), 1000, np.uint16)
    for name in ("one", "other"):
        (tmp_path / name).mkdir()
        cv2.imwrite(str(tmp_path / name / "a.png"), deep + (name == "other") * np.uint16(40))
    assert evaluate(tmp_path / "one", tmp_path / "other").psnr_db == pytest.approx(
        -20 * np.log10(40 / 65535), abs=0.01)
