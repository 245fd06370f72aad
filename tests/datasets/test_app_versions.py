"""Versions of apps and names that their files may have: every one gives the same cameras.

Written field by field after what the apps' sources say, apart from the writers of `app_sets`, with
the cameras of `plain_captures`. Pictures show nothing.
"""

import json
import math
import struct

import numpy as np
import pytest
from facts import assert_facts, raises
from plain_captures import (
    COUNT,
    CX,
    CY,
    DEPTH,
    DH,
    DW,
    FX,
    FY,
    HEIGHT,
    T0,
    TRUTH,
    WIDTH,
    arkit,
    check,
    gray,
    looking,
    matrix,
    picture,
    quat,
    text,
    y_up,
)

from recon_cli.datasets.layouts import read_posed, recognise
from recon_cli.datasets.packed import unpacked
from recon_cli.errors import FormatError, InputError


def polycam(folder, kinds=("corrected_",), sizes=()):
    for at in range(COUNT):
        stem, pose = str(1_700_000_000_000_000 + 250_000 * at), arkit(at)
        for kind in kinds:
            value = {"fx": FX, "fy": FY, "cx": CX, "cy": CY, "blur_score": 7.5 * at,
                     "neighbors": [], "manual_keyframe": False, "center_depth": 1.5}
            value |= {f"t_{row}{column}": pose[row, column]
                      for row in range(3) for column in range(4)}
            if kind in sizes:
                value |= {"width": WIDTH, "height": HEIGHT}
            picture(folder / "keyframes" / f"{kind}images" / f"{stem}.jpg", seed=at)
            text(folder / "keyframes" / f"{kind}cameras" / f"{stem}.json", value)
        gray(folder / "keyframes" / "depth" / f"{stem}.png", np.rint(1000 * DEPTH), np.uint16)
        gray(folder / "keyframes" / "confidence" / f"{stem}.png", np.full((DH, DW), 127), np.uint8)


def test_polycam_with_and_without_sizes_and_corrected_cameras(tmp_path):
    for number, more in enumerate((
            {}, {"sizes": ("corrected_",)}, {"kinds": ("",), "sizes": ("",)}, {"kinds": ("",)})):
        folder = tmp_path / str(number)
        polycam(folder, **more)
        assert recognise(folder) == "polycam"
        check(read_posed(folder))
        check(read_posed(folder / "keyframes"))
        assert set(read_posed(folder).images[0].depth.read_confidence().ravel()) == {1}


def metadata(*, lists=True, sizes=True, depth_sizes=True):
    """What Record3D writes: K column by column, poses and intrinsics by frame."""
    poses = [[*quat(arkit(at)), *arkit(at)[:3, 3].tolist()] for at in range(COUNT)]
    value = {"fps": 30, "K": [FX, 0, 0, 0, FY, 0, CX, CY, 1], "poses": poses,
             "cameraType": 1, "initPose": [0, 0, 0, 1, 0, 0, 0]}
    if sizes:
        value |= {"w": WIDTH, "h": HEIGHT}
    if depth_sizes:
        value |= {"dw": DW, "dh": DH}
    if lists:
        value |= {"perFrameIntrinsicCoeffs": [[FX, FY, CX, CY]] * COUNT,
                  "frameTimestamps": [T0 + at / 30 for at in range(COUNT)]}
    return value


def exr(path, values, compression, half=False):
    import OpenEXR

    path.parent.mkdir(parents=True, exist_ok=True)
    OpenEXR.File({"compression": getattr(OpenEXR, compression), "type": OpenEXR.scanlineimage},
                 {"R": values.astype(np.float16 if half else np.float32)}).write(str(path))


@pytest.mark.parametrize("inside", ["", "EXR_RGBD"])
@pytest.mark.parametrize("compression", [
    "NO_COMPRESSION", "ZIPS_COMPRESSION", "ZIP_COMPRESSION", "PIZ_COMPRESSION"])
def test_record3d_folders_of_any_compression_and_age(tmp_path, inside, compression):
    home = tmp_path / inside if inside else tmp_path
    for at in range(COUNT):
        picture(home / "rgb" / f"{at}.jpg", seed=at)
        exr(home / "depth" / f"{at}.exr", DEPTH, compression)
    picture(home / "rgb" / "3(2).jpg")
    for more in ({}, {"lists": False}, {"lists": False, "sizes": False, "depth_sizes": False}):
        text(home / "metadata.json", metadata(**more))
        assert recognise(tmp_path) == "record3d"
        posed = read_posed(tmp_path)
        assert posed.up is None
        assert posed.find_up
        check(posed, relative=True)


def test_half_floats_and_what_is_no_depth_are_read(tmp_path):
    values = DEPTH.copy()
    values[0, :3] = np.inf, np.nan, -1
    for at in range(COUNT):
        picture(tmp_path / "rgb" / f"{at}.jpg", seed=at)
        exr(tmp_path / "depth" / f"{at}.exr", values, "ZIP_COMPRESSION", half=True)
    text(tmp_path / "metadata.json", metadata())
    depth = read_posed(tmp_path).images[0].depth.read()
    assert not depth[0, :3].any()
    np.testing.assert_allclose(depth[1:], DEPTH[1:], atol=2e-3)


def test_r3d_without_the_size_of_its_depth_has_the_shape_of_the_photos(tmp_path):
    import zipfile

    import lzfse

    for number, more in enumerate(({}, {"depth_sizes": False})):
        path = tmp_path / f"{number}.zip"  # renamed
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("metadata", json.dumps(metadata(**more)))
            for at in range(COUNT):
                picture(tmp_path / "one.jpg", seed=at)
                archive.writestr(f"rgbd/{at}.jpg", (tmp_path / "one.jpg").read_bytes())
                archive.writestr(f"rgbd/{at}.depth", lzfse.compress(
                    DEPTH.astype("<f4").tobytes()))
                archive.writestr(f"rgbd/{at}.conf", lzfse.compress(bytes([2]) * DH * DW))
        assert recognise(path) == "record3d"
        with unpacked(path, tmp_path / "out") as folder:
            posed = read_posed(folder)
            check(posed, relative=True)
            assert posed.images[0].depth.read_confidence().min() == 2


def video(path):
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=60)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for at in range(COUNT):
            values = np.random.default_rng(at).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(values, format="rgb24")))
        container.mux(stream.encode(None))


def stray(folder, version, old_depth=False):
    folder.mkdir(parents=True)
    heads = {"old": "timestamp, frame, x, y, z, qx, qy, qz, qw", "new": (
        "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x, "
        "distortion_center_y")}
    lines = [heads["old" if version == "old" else "new"]]
    for at in range(COUNT):
        place, axes = looking(at)  # OpenCV's axes in ARKit's world
        pose = matrix(y_up(place), *map(y_up, axes))
        row = [T0 + at / 60, f"{at:06d}", *pose[:3, 3], *quat(pose)]
        if version != "old":
            row += [FX, FY, CX, CY, *(("", "") if version == "new" else (CX, CY))]
        lines.append(", ".join(map(str, row)))
        if old_depth:
            (folder / "depth").mkdir(exist_ok=True)
            np.save(folder / "depth" / f"{at:06d}.npy", np.rint(1000 * DEPTH).astype(np.uint16))
        else:
            gray(folder / "depth" / f"{at:06d}.png", np.rint(1000 * DEPTH), np.uint16)
        gray(folder / "confidence" / f"{at:06d}.png", np.full((DH, DW), 2), np.uint8)
    text(folder / "odometry.csv", "\n".join(lines) + "\n")
    text(folder / "camera_matrix.csv", f"{FX}, 0.0, {CX}\n0.0, {FY}, {CY}\n0.0, 0.0, 1.0\n")
    video(folder / "rgb.mp4")


def test_stray_scanner_before_and_after_intrinsics_of_each_frame(tmp_path):
    for version, old in (("old", False), ("old", True), ("new", False), ("center", False)):
        folder = tmp_path / f"{version}{old}"
        stray(folder, version, old)
        assert recognise(folder) == "stray"
        posed = read_posed(folder)
        assert [image.frame for image in posed.images] == list(range(COUNT))
        check(posed)


def nerfcapture(folder, writer):
    """`script`: nerfcapture2nerf.py; `app`: the app itself; `fork`: folders rgb and depth."""
    photos, depths = ("rgb", "depth") if writer == "fork" else ("images", "images")
    entries = []
    for at in (2, 0, 1, 4, 3):
        picture(folder / photos / f"{at}.png", seed=at)
        name = f"{at}.png" if writer == "fork" else f"{at}.depth.png"
        if writer == "app":
            gray(folder / depths / name, np.minimum(DEPTH, 1) * 255, np.uint8)
        else:
            gray(folder / depths / name, np.rint(DEPTH / (10 / 65535)), np.uint16)
        entry = {"file_path": f"{photos}/{at}", "depth_path": f"{depths}/{name}",
                 "transform_matrix": arkit(at).tolist(), "fl_x": FX, "fl_y": FY, "cx": CX,
                 "cy": CY, "w": WIDTH, "h": HEIGHT}
        if writer == "fork":
            entry["file_path"] += ".png"
        entries.append(entry | ({"timestamp": T0 + at} if writer == "app" else {}))
    scale = {"depth_integer_scale": 1.0} if writer == "app" else {"integer_depth_scale": 10 / 65535}
    text(folder / "transforms.json", {"fl_x": 1.0, **scale, "frames": entries})


@pytest.mark.parametrize("writer", ["script", "app", "fork"])
def test_nerfcapture_by_its_script_its_app_and_a_fork(tmp_path, writer):
    nerfcapture(tmp_path, writer)
    assert recognise(tmp_path) == "nerfcapture"
    posed = read_posed(tmp_path)
    assert posed.metric
    check(posed, depth=writer != "app")


def scanner_app(folder):
    for at in range(COUNT):
        picture(folder / f"frame_{at:05d}.jpg", seed=at)
        gray(folder / f"depth_{at:05d}.png", np.rint(1000 * DEPTH), np.uint16)
        gray(folder / f"conf_{at:05d}.png", np.full((DH, DW), 1), np.uint8)
        text(folder / f"frame_{at:05d}.json", {
            "cameraPoseARFrame": arkit(at).ravel().tolist(), "frame_index": at, "time": T0 + at,
            "intrinsics": [FX, 0, CX, 0, FY, CY, 0, 0, 1], "cameraGrain": 0.1,
            "projectionMatrix": np.eye(4).ravel().tolist()})


def test_3d_scanner_app(tmp_path):
    scanner_app(tmp_path)
    assert recognise(tmp_path) == "3dscannerapp"
    check(read_posed(tmp_path))


def arkit_scenes(home, kind, unused=()):
    """Photos of a kind; the poses, 10 a second, lie between those of the photos for some."""
    def axis_angle(m):
        angle = math.acos((np.trace(m) - 1) / 2)
        axis = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
        return axis / (2 * math.sin(angle)) * angle

    scale = {"lowres_wide": 1, "vga_wide": 2, "wide": 4}[kind]
    lines = []
    for at in range(COUNT):
        stem, w2c = f"4242_{T0 + at / 10:.3f}", np.linalg.inv(TRUTH[at])
        picture(home / kind / f"{stem}.png", (WIDTH * scale, HEIGHT * scale), seed=at)
        text(home / f"{kind}_intrinsics" / f"4242_{T0 + at / 10 - 0.001:.3f}.pincam", " ".join(
            map(str, (WIDTH * scale, HEIGHT * scale, *(scale * np.array([FX, FY, CX, CY]))))))
        gray(home / "lowres_depth" / f"{stem}.png", np.rint(1000 * DEPTH), np.uint16)
        gray(home / "confidence" / f"{stem}.png", np.full((DH, DW), 2), np.uint8)
        lines.append(" ".join(map(str, (T0 + at / 10 + 0.0004, *axis_angle(w2c[:3, :3]),
                                        *w2c[:3, 3]))))
        for other in unused:
            picture(home / other / f"{stem}.png", seed=at)
    text(home / "lowres_wide.traj", "\n".join(lines) + "\n")
    return scale


@pytest.mark.parametrize(("inside", "kind", "unused"), [
    ("4242_frames", "lowres_wide", ()), ("", "vga_wide", ()), ("", "wide", ("lowres_wide",)),
    ("", "lowres_wide", ("wide",)), ("", "lowres_wide", ("ultrawide",))])
def test_arkit_scenes_of_any_kind_of_photo(tmp_path, inside, kind, unused):
    scale = arkit_scenes(tmp_path / inside if inside else tmp_path, kind, unused)
    assert recognise(tmp_path) == "arkitscenes"
    posed = read_posed(tmp_path)
    assert posed.up == (0, 0, 1)
    assert {image.lens.width for image in posed.images} == {WIDTH * scale}
    # .4 ms of 100 ms beside the pose that belongs to the photo
    for image, truth in zip(posed.images, TRUTH, strict=True):
        np.testing.assert_allclose(np.linalg.inv(image.viewmat), truth, atol=8e-3)


BASE = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0.2], [0, -1, 0, 0.4], [0, 0, 0, 1]])


def rtabmap(folder, *, name="rtabmap", ids="id", files="stamp", base=False, cameras=("",),
            model="plumb_bob", numbers=(0, 0, 0, 0, 0), photos="rgb", confidence=None):
    for camera in cameras:
        lines = ["#timestamp x y z qx qy qz qw" + (" id" if ids else "")]
        for at in range(COUNT):
            stamp = f"{1_600_000_000 + T0 + at / 3:.6f}"
            stem = (stamp if files == "stamp" else str(at + 1)) + camera
            pose = TRUTH[at] @ (np.linalg.inv(BASE) if base else np.eye(4))
            lines.append(" ".join(map(str, (stamp, *pose[:3, 3], *quat(pose)))) + (
                f" {at + 1}" if ids else ""))
            picture(folder / f"{name}_{photos}" / f"{stem}.jpg", seed=at)
            if photos == "rgb":
                gray(folder / f"{name}_depth" / f"{stem}.png", np.rint(1000 * DEPTH), np.uint16)
            if confidence is not None:
                gray(folder / f"{name}_confidence" / f"{stem}.png",
                     np.where(np.arange(DW) < 4, 0, confidence) * np.ones((DH, 1)), np.uint8)
            text(folder / f"{name}_calib" / f"{stem}.yaml", "\n".join([
                "%YAML:1.0", "---", f'camera_name: "{stem}"', f"image_width: {WIDTH}",
                f"image_height: {HEIGHT}", "camera_matrix:", "   rows: 3", "   cols: 3",
                f"   data: [ {FX}, 0., {CX}, 0., {FY},", f"       {CY}, 0., 0., 1. ]",
                f"distortion_model: {model}", "distortion_coefficients:", "   rows: 1",
                f"   cols: {len(numbers)}", f"   data: [ {', '.join(map(str, numbers))} ]",
                "local_transform:", "   rows: 3", "   cols: 4",
                f"   data: [ {', '.join(map(str, BASE[:3].ravel()))} ]"]) + "\n")
        if ids:
            lines.append("0.000000 9 9 9 0 0 0 1 -12")
        end = "poses" if base else "camera_poses"
        text(folder / f"{name}_{end}{camera}.txt", "\n".join(lines) + "\n")


@pytest.mark.parametrize("more", [
    {}, {"ids": ""}, {"files": "id"}, {"name": "my walk"}, {"base": True},
    {"confidence": 2}, {"confidence": 100}, {"confidence": 255}, {"cameras": ("_0",)},
    {"photos": "left"}, {"model": "rational_polynomial", "numbers": (0.01,) + (0,) * 7},
    {"model": "equidistant", "numbers": (0.01, 0, 0, 0)}])
def test_rtabmap_by_its_options(tmp_path, more):
    rtabmap(tmp_path, **more)
    assert recognise(tmp_path) == "rtabmap"
    posed = read_posed(tmp_path)
    check(posed, depth="photos" not in more)
    if "confidence" in more:
        levels = posed.images[0].depth.read_confidence()
        assert not levels[:, :4].any()
        assert levels[:, 4:].min() == 2
    models = {"rational_polynomial": "FULL_OPENCV", "equidistant": "OPENCV_FISHEYE"}
    assert posed.images[0].lens.model == models.get(more.get("model"), "PINHOLE")


def test_every_camera_of_a_rig_of_rtabmap_is_read(tmp_path):
    rtabmap(tmp_path, cameras=("_0", "_1"))
    assert len(read_posed(tmp_path).images) == 2 * COUNT


def test_pictures_of_several_cameras_in_one_are_counted(tmp_path):
    rtabmap(tmp_path, cameras=("_0",))
    for path in (tmp_path / "rtabmap_rgb").iterdir():
        path.rename(path.with_name(path.name.replace("_0", "")))
    with raises(InputError, 5, "cameras"):
        read_posed(tmp_path)


def test_quest_in_unitys_axes(tmp_path):
    text(tmp_path / "session_info.json", {"sessionFormatVersion": 2, "captureBackend": "MRUK"})
    head = ("frame_index,file_name,unix_time_ms,timestamp_us_realtime,width,height,format,"
            "camera_position,pose_pos_x,pose_pos_y,pose_pos_z,pose_rot_x,pose_rot_y,pose_rot_z,"
            "pose_rot_w,pose_ok,get_texture_ok,get_colors_ok,error")
    mirror = np.array([1.0, 1, -1])  # of a left-handed world with y up
    for eye in ("left", "right"):
        lines = [head]
        text(tmp_path / f"{eye}_camera_mruk_intrinsics.json", {
            "backend": "MRUK", "focalLength": {"x": FX, "y": FY},
            "principalPoint": {"x": CX, "y": CY}, "resolution": {"width": WIDTH, "height": HEIGHT}})
        for at in range(COUNT + 1):
            place, (right, down, ahead) = looking(at)
            pose = matrix(mirror * y_up(place), mirror * y_up(right), mirror * y_up(-down),
                          mirror * y_up(ahead))
            stamp = 1_781_849_907_379_988 + 33_000 * at
            top = np.full((HEIGHT // 2, WIDTH, 4), 200, np.uint8)
            file = tmp_path / f"{eye}_camera_mruk_rgba" / f"{stamp}.rgba"
            file.parent.mkdir(exist_ok=True)
            file.write_bytes(np.concatenate([top // 4, top]).tobytes())  # bottom row first
            fine = "True" if at < COUNT else "False"
            lines.append(",".join(map(str, (
                at, file.name, 0, stamp, WIDTH, HEIGHT, "RGBA32", eye, *pose[:3, 3], *quat(pose),
                "True", fine, "True", ""))))
        text(tmp_path / f"{eye}_camera_mruk_frame_metadata.csv", "\n".join(lines) + "\n")
    assert recognise(tmp_path) == "quest"
    posed = read_posed(tmp_path)
    check(posed, depth=False)
    assert len(posed.images) == 2 * COUNT
    rgb = posed.images[0].read()
    assert (rgb[0, 0, 0], rgb[-1, 0, 0]) == (200, 50)
    assert_facts("\n".join(posed.notices), 2, "frames", "headset")


def test_a_packed_stream_of_another_shape_than_its_photo_is_refused(tmp_path):
    import lzfse

    for at in range(COUNT):
        picture(tmp_path / "rgbd" / f"{at}.jpg", seed=at)
        data = lzfse.compress(struct.pack("<7f", *[1] * 7))
        (tmp_path / "rgbd" / f"{at}.depth").write_bytes(data)
    text(tmp_path / "metadata", metadata(depth_sizes=False))
    with raises(FormatError, "rows"):
        read_posed(tmp_path).images[0].depth.read()
