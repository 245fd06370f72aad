"""Masks of what moves as files: written, found again, edited by a user, joined."""

from dataclasses import replace

import cv2
import numpy as np
from facts import raises

from recon_cli.context import EarlierResult
from recon_cli.errors import FormatError, InputError
from recon_cli.io.images import read_mask, write_png
from recon_cli.scene.camera import Camera
from recon_cli.scene.scene import Scene, View
from recon_cli.train.masks import (
    EditedMasks,
    copy_masks,
    join_masks,
    read_summary,
    with_masks,
    write_masks,
)

W, H = 60, 40


def scene(tmp_path):
    views = []
    for row in range(4):
        path = tmp_path / f"{row}.png"
        views.append(View(f"{row}.png", Camera(W, H, 50, 50, 30, 20, np.eye(4)), path, path))
    return Scene(tuple(views[:3]), tuple(views[3:]), (), (), np.zeros((1, 3)),
                 np.zeros((1, 3), np.uint8))


def regions(*rows):
    """Returns a left half that moves, at half the size, in some of the four views."""
    found = [np.zeros((H // 2, W // 2), bool) for _ in range(4)]
    for row in rows:
        found[row][:, :15] = True
    return found


def finished(out, **changes):
    return EarlierResult(out, **{name: frozenset(f"masks/{file}" for file in files)
                                 for name, files in changes.items()})


def counts(path):
    return read_mask(path, W, H)


def test_masks_have_the_form_of_ingests_and_their_shares_are_recorded(tmp_path):
    out = tmp_path / "train"
    summary = write_masks(out, scene(tmp_path), regions(1, 3), EditedMasks())
    assert sorted(path.name for path in (out / "masks").iterdir()) == ["1.png", "3.png"]
    assert summary.shares == {"1.png": 0.5, "3.png": 0.5}
    assert summary.share == 0.25
    assert read_summary(out) == summary
    assert not counts(out / "masks/1.png")[:, :29].any()
    assert counts(out / "masks/1.png")[:, 31:].all()


def test_nothing_is_written_where_nothing_moves(tmp_path):
    out = tmp_path / "train"
    out.mkdir()
    assert write_masks(out, scene(tmp_path), regions(), EditedMasks()) is None
    assert write_masks(out, scene(tmp_path), None, EditedMasks()) is None
    assert not list(out.iterdir())
    assert read_summary(out) is None


def test_a_mask_of_ingest_still_ignores_its_pixels(tmp_path):
    made, out = scene(tmp_path), tmp_path / "train"
    upper = np.full((H, W), 255, np.uint8)
    upper[:10] = 0
    write_png(tmp_path / "ingest.png", upper)
    made = replace(made, train=(replace(made.train[0], mask=tmp_path / "ingest.png"),
                                *made.train[1:]))
    write_masks(out, made, regions(0), EditedMasks())
    mask = counts(out / "masks/0.png")
    assert not mask[:10].any()
    assert not mask[:, :29].any()
    assert mask[10:, 31:].all()


def test_training_and_validation_views_get_the_masks_and_others_keep_theirs(tmp_path):
    out = tmp_path / "train"
    made = scene(tmp_path)
    write_masks(out, made, regions(1, 3), EditedMasks())
    masked = with_masks(made, out)
    assert [view.mask for view in masked.train] == [None, out / "masks/1.png", None]
    assert masked.validation[0].mask == out / "masks/3.png"
    assert with_masks(made, tmp_path / "nowhere") is made


def test_what_a_user_changed_added_or_removed_is_kept_and_the_rest_found_anew(tmp_path):
    made, first, second = scene(tmp_path), tmp_path / "first", tmp_path / "second"
    write_masks(first, made, regions(0, 1, 3), EditedMasks())
    own = np.full((H, W), 255, np.uint8)
    own[:, 50:] = 0
    write_png(first / "masks/0.png", own)
    write_png(first / "masks/2.png", own)
    (first / "masks/1.png").unlink()
    edited = EditedMasks.find(finished(
        first, changed=["0.png"], missing=["1.png"], foreign=["2.png"]))
    summary = write_masks(second, made, regions(0, 1), edited)
    assert summary.by_hand == ("0.png", "1.png", "2.png")
    assert not counts(second / "masks/0.png")[:, 50:].any()
    assert counts(second / "masks/0.png")[:, :50].all()
    assert counts(second / "masks/1.png").all()  # nothing moves there, he says
    assert not counts(second / "masks/2.png")[:, 50:].any()
    assert not (second / "masks/3.png").exists()  # it was found and is not found again
    again = EditedMasks.find(finished(second))  # his word outlives another training
    assert set(again.files) == {"0.png", "1.png", "2.png"}


def test_without_the_folder_everything_is_found_anew(tmp_path):
    made, out = scene(tmp_path), tmp_path / "train"
    write_masks(out, made, regions(0), EditedMasks())
    (out / "masks/0.png").unlink()
    (out / "masks").rmdir()
    assert not EditedMasks.find(finished(out, missing=["0.png"])).files
    assert not EditedMasks.find(None).files


def test_an_edited_mask_may_have_another_size_but_not_another_shape(tmp_path):
    made, out = scene(tmp_path), tmp_path / "train"
    write_masks(out, made, regions(0), EditedMasks())
    write_png(out / "masks/0.png", np.full((2 * H, 2 * W), 255, np.uint8))
    edited = EditedMasks.find(finished(out, changed=["0.png"]))
    assert edited.read(made.train[0]).all()
    write_png(out / "masks/0.png", np.full((H, H), 255, np.uint8))
    with raises(InputError, "40x40", "60x40"):
        edited.read(made.train[0])
    (out / "masks/0.png").write_bytes(b"no picture")
    with raises(InputError, "mask"):
        edited.read(made.train[0])


def test_masks_of_no_view_are_named(tmp_path):
    edited = EditedMasks({"other.png": tmp_path / "other.png", "0.png": None})
    assert edited.unused(scene(tmp_path).train) == ["other.png"]


def test_a_continued_run_has_the_masks_of_the_run_before(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    summary = write_masks(first, scene(tmp_path), regions(2), EditedMasks())
    copy_masks(first, summary, second)
    assert read_summary(second) == summary
    assert (second / "masks/2.png").read_bytes() == (first / "masks/2.png").read_bytes()


def test_blocks_mask_what_either_finds_and_leave_a_users_mask(tmp_path):
    made, out = scene(tmp_path), tmp_path / "train"
    white = np.full((H, W), 255, np.uint8)
    write_png(tmp_path / "0.png", white)
    write_masks(out, made, None, EditedMasks({"0.png": tmp_path / "0.png"}))
    blocks = [tmp_path / "a", tmp_path / "b"]
    write_masks(blocks[0], made, regions(0, 1), EditedMasks())
    write_masks(blocks[1], made, [cv2.flip(one.astype(np.uint8), 1) > 0 for one in regions(1)],
                EditedMasks())
    join_masks(out, blocks, made)
    assert counts(out / "masks/0.png").all()
    assert counts(out / "masks/1.png").mean() < 0.05
    assert read_summary(out).by_hand == ("0.png",)


def test_a_damaged_record_is_a_typed_error(tmp_path):
    (tmp_path / "masks.json").write_text('{"shares": 3}')
    with raises(FormatError, "damaged"):
        read_summary(tmp_path)
