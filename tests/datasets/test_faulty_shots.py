"""Faults that any layout may have: what is kept is right, and what is lost is told by number.

A fault changes the shots before they are written, or the files after it, so that one table holds
for every layout. The worst outcome would be a set that reads well and is wrong.
"""

import dataclasses
import functools
import re
import shutil

import numpy as np
import pytest
from app_sets import APPS
from app_shots import shots
from ingest_media import take
from phone_writers import relative, stray
from PIL import Image

from recon_cli.datasets.layouts import read_posed, recognise
from recon_cli.errors import ReconError
from recon_cli.workspace.records import POSES, read_poses

COUNT, LOST = 6, 2  # shots, and the one with a fault
PICTURES = (".jpg", ".png", ".rgba")


@pytest.fixture(scope="session")
def frames(shared_data):
    return shots(shared_data / "rooms" / "office", count=COUNT, factor=4)


@pytest.fixture(scope="session")
def still(shared_data):
    return shots(shared_data / "rooms" / "office", count=COUNT, factor=4, moving=False)


def change(taken, which, **values):
    return [dataclasses.replace(shot, **{key: make(shot) for key, make in values.items()})
            if shot.number in which else shot for shot in taken]


def nowhere(shot):
    pose = shot.c2w.copy()
    pose[:3, 3] = np.nan
    return pose


def not_a_number(taken):
    return change(taken, {LOST}, c2w=nowhere)


def no_pose_at_all(taken):
    return change(taken, range(COUNT), c2w=nowhere)


def one_pose_for_all(taken):
    return change(taken, range(COUNT), c2w=lambda _: taken[0].c2w)


def stretched(taken):
    return change(taken, {LOST}, c2w=lambda shot: shot.c2w * [1.3, 1, 1, 1])


def columns_as_rows(taken):
    return change(taken, range(COUNT), c2w=lambda shot: shot.c2w.T)


def intrinsics_of_a_larger_size(taken):
    return change(taken, range(COUNT), inner=lambda shot: tuple(2 * np.array(shot.inner)))


def lose_a_picture(folder):
    photos = list_photos(folder)
    for path in photos:
        if path.stem == photos[len(photos) // 2].stem and "depth" not in path.name:
            path.unlink()


def reduce_pictures(folder):
    for path in list_photos(folder):
        image = Image.open(path)
        image.resize((image.width // 2, image.height // 2)).save(path)


def cut_a_picture(folder):
    photos = list_photos(folder)
    path = photos[len(photos) // 2]
    path.write_bytes(path.read_bytes()[:50])


def list_photos(folder):
    """Returns the pictures that a layout's frames are, not depth, confidence or thumbnails."""
    others = ("depth", "conf", "thumb", "(")
    return [path for path in sorted(folder.rglob("*")) if path.suffix in PICTURES and not any(
        word in path.name or word in path.parent.name for word in others)]


WRITERS = {"stray": functools.partial(stray, between=1)}
QUATERNIONS = ("record3d", "r3d", "stray", "arkitscenes", "rtabmap", "realityscan", "opensfm",
               "colmap rig", "quest", "bundler", "metashape", "llff", "polycam")
SOLVED = ("realityscan", "metashape", "bundler", "opensfm", "llff", "colmap rig")
# Which layouts a fault does not fit: a turn alone is a turn however it is read; intrinsics of
# photogrammetry are for the size that it says; a video has no single pictures.
FAULTS = {
    "not a number": (not_a_number, None, ()),
    "no pose at all": (no_pose_at_all, None, ()),
    "one pose for all": (one_pose_for_all, None, SOLVED),
    "stretched": (stretched, None, tuple(set(QUATERNIONS) - {"llff", "bundler", "polycam"})),
    "columns as rows": (columns_as_rows, None, QUATERNIONS),
    "intrinsics of a larger size": (intrinsics_of_a_larger_size, None, SOLVED),
    "a picture is missing": (None, lose_a_picture, ("stray",)),
    "a picture is cut short": (None, cut_a_picture, ("stray",)),
    # Bundler's cameras say no size, so that only the matches of sfm can refuse them.
    "pictures were reduced": (None, reduce_pictures, ("stray", "quest", "bundler")),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", APPS)
def test_what_is_kept_is_right_and_what_is_lost_is_told(name, fault, frames, still, tmp_path):
    before, after, unfit = FAULTS[fault]
    if name in unfit:
        pytest.skip("the layout cannot hold this fault")
    app = dataclasses.replace(APPS[name], write=WRITERS.get(name, APPS[name].write))
    good = frames if app.own else still
    app.write(tmp_path, good)
    whole = len(read_posed(tmp_path).images)
    if before is not None:
        for path in tmp_path.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        app.write(tmp_path, before(good))
    if after is not None:
        after(tmp_path)
    assert recognise(tmp_path) == app.name
    try:
        posed = read_posed(tmp_path)
    except ReconError as error:
        assert (bool(error.hint), error.exit_code) == (True, 3)  # noqa: PT017  # as right
        return
    assert_right(posed, app, good)
    told = " ".join(posed.notices)
    if len(posed.images) < whole:
        numbers = re.findall(r"(?:left out|missing|without a picture): (\d+)", told)
        assert sum(map(int, numbers)) >= whole - len(posed.images), told
    if fault in ("intrinsics of a larger size", "pictures were reduced"):
        assert "scaled" in told


def assert_right(posed, app, good):
    """Asserts that each image has the camera of one of the good shots, at the size of its file."""
    world = relative(good) if app.world is None else app.world
    truth = np.stack([world @ shot.c2w for shot in good])
    for image in posed.images:
        if "camera2" in image.name or "right" in image.name:
            continue
        pose = np.linalg.inv(image.viewmat)
        number = int(np.abs(truth - pose).max(axis=(1, 2)).argmin())
        np.testing.assert_allclose(pose, truth[number], atol=1e-5)
        wanted = np.array(good[number].inner) * image.lens.width / (
            good[number].size[0] // 2 * 2 if app.name == "stray" else good[number].size[0])
        params = image.lens.params
        np.testing.assert_allclose(
            (params if len(params) > 3 else (params[0], *params))[:4], wanted, rtol=0.02)


OTHER_DEPTH = {
    "metres": lambda depth: depth / 1000, "centimetres": lambda depth: depth / 10,
    "feet": lambda depth: depth * 0.3048, "upside down": lambda depth: depth[::-1],
    "mirrored": lambda depth: depth[:, ::-1]}


@pytest.mark.integration
@pytest.mark.parametrize("kind", OTHER_DEPTH)
@pytest.mark.parametrize("name", [name for name, app in APPS.items() if app.depth])
def test_depth_in_another_unit_or_order_is_not_used(name, kind, frames, tmp_path):
    taken = change(frames, range(COUNT), depth=lambda shot: OTHER_DEPTH[kind](shot.depth))
    APPS[name].write(tmp_path / "capture", taken)
    summary = take(tmp_path / "capture", tmp_path / "out")
    assert summary.kind == APPS[name].name
    assert not (tmp_path / "out" / "depth.json").exists()
    assert read_poses(tmp_path / "out" / POSES).points is None
