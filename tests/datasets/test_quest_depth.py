"""Depth of a headset, whichever way its rows lie: read where that shows, and else left."""

import numpy as np
import pytest
from app_shots import ARKIT, cut, quat, shots
from facts import assert_facts
from phone_writers import quest

from recon_cli.datasets.layouts import read_posed

HEAD = ("timestamp_ms", "ovr_timestamp", *(f"create_pose_location_{axis}" for axis in "xyz"),
        *(f"create_pose_rotation_{axis}" for axis in "xyzw"), *(
            f"fov_{side}_angle_tangent" for side in ("left", "right", "top", "down")),
        "near_z", "far_z", "width", "height")
NEAR = 0.1


@pytest.fixture(scope="module")
def photos(shared_data):
    taken = shots(shared_data / "rooms" / "office", 20, 5, factor=2, moving=False)
    return list(map(cut, taken))


@pytest.fixture(scope="module")
def depths(shared_data):
    """The same places through a camera whose middle moves."""
    return list(map(cut, shots(shared_data / "rooms" / "office", 20, 5, factor=2)))


def write_depth(folder, frames, *, bottom_first=False, swapped=False, far=np.inf, late_ms=7,
                eye="left"):
    home = folder / f"{eye}_depth"
    home.mkdir()
    lines = [",".join(HEAD)]
    for frame in frames:
        fx, fy, cx, cy = frame.inner
        width, height = frame.size
        z = frame.depth
        with np.errstate(divide="ignore"):
            # the depth buffer of a perspective camera, 0 near and 1 far
            values = 1 - NEAR / z if np.isinf(far) else far * (z - NEAR) / (z * (far - NEAR))
        values = np.where(z > 0, values, 1).astype("<f4")
        stamp = round(frame.time * 1000) + late_ms
        (home / f"{stamp}.raw").write_bytes(np.ascontiguousarray(
            values[::-1] if bottom_first else values).tobytes())
        mirror = np.diag([1.0, 1, -1, 1])
        unity = mirror @ ARKIT @ frame.c2w @ np.diag([1.0, -1, 1, 1])
        sides = [cx / fx, (width - cx) / fx]
        lines.append(",".join(map(str, (
            stamp, 0, *unity[:3, 3], *quat(unity), *(sides[::-1] if swapped else sides), cy / fy,
            (height - cy) / fy, NEAR, far, z.shape[1], z.shape[0]))))
    (folder / f"{eye}_depth_descriptors.csv").write_text("\n".join(lines) + "\n")


@pytest.mark.integration
@pytest.mark.parametrize("more", [
    {}, {"bottom_first": True}, {"swapped": True}, {"bottom_first": True, "swapped": True},
    {"far": 30.0}])
def test_depth_is_read_however_it_lies_in_its_file(photos, depths, tmp_path, more):
    quest(tmp_path, photos, eyes=("left",))
    write_depth(tmp_path, depths, **more)
    posed = read_posed(tmp_path)
    assert not any("depth" in notice for notice in posed.notices)
    for image, shot in zip(posed.images, photos, strict=True):
        depth = image.depth.read()
        rows, columns = (((np.arange(count) + 0.5) * side / count / 4).astype(int)
                         for count, side in zip(depth.shape, shot.size[::-1], strict=True))
        truth = shot.depth[np.ix_(rows, columns)]
        known = (depth > 0) & (truth > 0)
        assert known.mean() > 0.85
        off = np.abs(depth[known] / truth[known] - 1)
        assert np.median(off) < 0.01  # a pixel of depth is four of the photo wide
        assert np.percentile(off, 90) < 0.06


@pytest.mark.parametrize(("frames", "maps", "late_ms"), [
    pytest.param(3, 1, 0, id="without motion"), pytest.param(20, 20, 100_000, id="another time")])
def test_depth_that_fits_no_frame_is_left(photos, depths, tmp_path, frames, maps, late_ms):
    quest(tmp_path, photos[:frames], eyes=("left",))
    write_depth(tmp_path, depths[:maps], late_ms=late_ms)
    posed = read_posed(tmp_path)
    assert not any(image.depth for image in posed.images)
    assert_facts("\n".join(posed.notices), frames, "depth", "frames")


def test_rows_without_a_camera_and_files_cut_short_are_counted(photos, depths, tmp_path):
    quest(tmp_path, photos, eyes=("left",))
    write_depth(tmp_path, depths)
    path = tmp_path / "left_depth_descriptors.csv"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:-1], lines[-1][:30]]))
    posed = read_posed(tmp_path)
    assert sum(image.depth is not None for image in posed.images) == len(photos) - 1
    assert_facts("\n".join(posed.notices), 1, "frame", "camera")
    short = next((tmp_path / "left_depth").iterdir())
    short.write_bytes(short.read_bytes()[:-4])
    assert not any(image.depth for image in read_posed(tmp_path).images)
