"""Versions of apps and names that their files may have: every one gives the same cameras.

Written field by field after what the apps' sources say, apart from the writers of `app_sets`: axes
are turned by hand here, and pictures show nothing.
"""

import json
import math
import struct

import numpy as np
import pytest
from PIL import Image

from recon_cli.datasets.layouts import read_posed, recognise
from recon_cli.datasets.packed import unpacked

COUNT, WIDTH, HEIGHT = 5, 64, 48
FX, FY, CX, CY = 50.0, 51.0, 33.0, 23.0
DW, DH = 16, 12
DEPTH = 1 + 0.1 * np.arange(DH)[:, None] + 0.01 * np.arange(DW)  # metres; no symmetry
T0 = 1000.25


def looking(at):
    """Returns position [3] and the axes right, down, ahead of a camera, z up."""
    yaw, pitch, roll = 0.3 * at, -0.2 + 0.05 * at, 0.04 * at
    ahead = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch),
                      math.sin(pitch)])
    right = np.cross(ahead, [0, 0, 1])
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    right, down = (math.cos(roll) * right + math.sin(roll) * down,
                   -math.sin(roll) * right + math.cos(roll) * down)
    return np.array([0.5 * at, 0.2 * at * at, 1.5 + 0.1 * at]), (right, down, ahead)


def matrix(position, *axes):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack(axes, axis=1), position
    return pose


TRUTH = [matrix(place, *axes) for place, axes in map(looking, range(COUNT))]


def y_up(vector):
    """(x, y, z) of a world with y up, of a vector of the one with z up."""
    x, y, z = vector
    return np.array([x, z, -y])


def arkit(at):
    """Camera to world of ARKit: y up, the camera looks along -z."""
    place, (right, down, ahead) = looking(at)
    return matrix(y_up(place), y_up(right), y_up(-down), y_up(-ahead))


def quat(pose):
    """x y z w, of a rotation whose trace is large enough, else by the largest diagonal."""
    m = pose[:3, :3]
    values = np.array([
        1 + m[0, 0] - m[1, 1] - m[2, 2], 1 - m[0, 0] + m[1, 1] - m[2, 2],
        1 - m[0, 0] - m[1, 1] + m[2, 2], 1 + np.trace(m)])
    largest = int(values.argmax())
    size = math.sqrt(values[largest]) / 2
    x, y, z, w = np.sqrt(np.maximum(values, 0)) / 2
    if largest == 3:
        x, y, z = (np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / (4 * size))
    else:
        one, two, three = [(0, 1, 2), (1, 2, 0), (2, 0, 1)][largest]
        found = np.zeros(3)
        found[one] = size
        found[two] = (m[one, two] + m[two, one]) / (4 * size)
        found[three] = (m[one, three] + m[three, one]) / (4 * size)
        x, y, z = found
        w = (m[three, two] - m[two, three]) / (4 * size)
    return [float(value) for value in (x, y, z, w)]


def picture(path, size=(WIDTH, HEIGHT), seed=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.random.default_rng(seed).integers(0, 255, (size[1], size[0], 3), np.uint8)
    Image.fromarray(values).save(path)


def gray(path, values, kind):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values.astype(kind)).save(path)


def text(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))


def check(posed, *, relative=False, depth=True, inner=(FX, FY, CX, CY), count=COUNT):
    """Asserts the cameras, in the order of the capture, z up where up is known."""
    images = [image for image in posed.images if "right" not in image.name]
    assert len(images) == count, posed.notices
    found = [np.linalg.inv(image.viewmat) for image in images]
    if posed.up == (0, 1, 0):
        turn = np.eye(4)
        turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
        found = [turn @ pose for pose in found]
    truth = TRUTH[:count]
    if relative:
        found = [np.linalg.inv(found[0]) @ pose for pose in found]
        truth = [np.linalg.inv(TRUTH[0]) @ pose for pose in truth]
    np.testing.assert_allclose(found, truth, atol=2e-5)
    for image in images:
        np.testing.assert_allclose(image.lens.params[:4], inner, atol=1e-4)
        assert (image.depth is not None) == depth
        if depth:
            np.testing.assert_allclose(image.depth.read(), DEPTH, atol=6e-4)
            own = image.depth.own_lens(DW, DH)
            np.testing.assert_allclose(own.params[:4], (
                FX * DW / WIDTH, FY * DH / HEIGHT, CX * DW / WIDTH, CY * DH / HEIGHT), atol=1e-4)


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
    with pytest.raises(Exception, match="5 frames that hold several cameras beside each other"):
        read_posed(tmp_path)


def angles(pose):
    """Heading, pitch, roll of Rz(-heading) Rx(pitch) Ry(roll), found by search, in degrees."""
    from scipy.optimize import least_squares

    def turn(h, p, r):
        h, p, r = np.radians([-h, p, r])
        z = [[math.cos(h), -math.sin(h), 0], [math.sin(h), math.cos(h), 0], [0, 0, 1]]
        x = [[1, 0, 0], [0, math.cos(p), -math.sin(p)], [0, math.sin(p), math.cos(p)]]
        y = [[math.cos(r), 0, math.sin(r)], [0, 1, 0], [-math.sin(r), 0, math.cos(r)]]
        return np.array(z) @ x @ y

    starts = [(h, p, 0.0) for h in range(-180, 180, 60) for p in (0.0, 60.0, 100.0)]
    fits = [least_squares(lambda v: (turn(*v) - pose[:3, :3]).ravel(), one, xtol=1e-15, ftol=1e-15)
            for one in starts]
    best = min(fits, key=lambda fit: fit.cost)
    assert best.cost < 1e-18
    return best.x


@pytest.mark.parametrize("columns", [
    "name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2",
    "f,name,roll,pitch,heading,alt,y,x", "#cameras 5\n#name,x,y,alt,heading,pitch,roll,f,px,py"])
@pytest.mark.parametrize("suffix", [".jpg", ""])
def test_reality_scan_with_columns_in_any_order(tmp_path, columns, suffix):
    keys = columns.splitlines()[-1].lstrip("#").split(",")
    middle = "px" in keys
    lines = ["#" * (columns[0] not in "#f") + columns]
    longer = max(WIDTH, HEIGHT)
    for at in range(COUNT):
        picture(tmp_path / "photos" / f"img {at}.jpg", seed=at)
        place, (right, down, ahead) = looking(at)
        heading, pitch, roll = angles(matrix(place, right, -down, -ahead))
        row = dict(zip(("x", "y", "alt"), place, strict=True)) | {
            "name": f'"img {at}{suffix}"', "heading": heading, "pitch": pitch, "roll": roll,
            "f": FX * 36 / longer, "px": (CX - WIDTH / 2) / longer,
            "py": (CY - HEIGHT / 2) / longer}
        lines.append(",".join(str(row.get(key, 0)) for key in keys))
    text(tmp_path / "out.csv", "\n".join(lines) + "\n")
    assert recognise(tmp_path) == "realityscan"
    check(read_posed(tmp_path), depth=False, inner=(FX, FX, CX, CY) if middle else (
        FX, FX, WIDTH / 2, HEIGHT / 2))


def metashape(folder, *, component="full", initial=True, where="component", slave=False):
    """The chunk is half as large as the world, turned about z, and moved."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    scale, shift = (2.0, np.array([10.0, 20, 30])) if component == "full" else (1.0, np.zeros(3))
    turn = turn if component == "full" else np.eye(3)
    world = ("<transform><rotation>" + " ".join(map(str, turn.ravel())) + "</rotation><translation>"
             + " ".join(map(str, shift)) + f"</translation><scale>{scale}</scale></transform>")
    world = world * (component == "full")
    size = f'<resolution width="{WIDTH}" height="{HEIGHT}"/>'
    first = f'<calibration class="initial">{size}<f>1</f><cx>9</cx></calibration>' * initial
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?><document version="1.5.0"><chunk label="a">'
        f'<sensors next_id="1"><sensor id="0" label="x" type="frame">{size}{first}'
        f'<calibration type="frame" class="adjusted">{size}<f>{FY}</f><cx>{CX - WIDTH / 2}</cx>'
        f"<cy>{CY - HEIGHT / 2}</cy><b1>{FX - FY}</b1></calibration></sensor>"
        '<sensor id="1" label="y" type="spherical"/></sensors>']
    if where == "component":
        lines.append(f'<components><component id="0">{world}</component></components>')
    lines.append("<cameras>")
    for at in range(COUNT):
        picture(folder / "img" / f"IMG {at}.JPG", seed=at)
        local = np.eye(4)
        local[:3, :3] = turn.T @ TRUTH[at][:3, :3]
        local[:3, 3] = turn.T @ (TRUTH[at][:3, 3] - shift) / scale
        label = (f"IMG {at}", f"IMG {at}.JPG", rf"C:\img\IMG {at}.JPG")[at % 3]
        component_id = 'component_id="0"' * (where == "component")
        lines.append(
            f'<camera id="{at}" sensor_id="0" {component_id} label="{label}"><transform>'
            + " ".join(map(str, local.ravel())) + "</transform></camera>")
    lines.append('<camera id="8" sensor_id="1" master_id="0" label="s"/>' * slave + "</cameras>")
    text(folder / "c.xml", "".join(lines) + world * (where == "chunk") + "</chunk></document>")


@pytest.mark.parametrize("more", [
    {}, {"initial": False}, {"component": "none"}, {"where": "chunk"}, {"slave": True}])
def test_metashape_by_its_versions(tmp_path, more):
    metashape(tmp_path, **more)
    assert recognise(tmp_path) == "metashape"
    posed = read_posed(tmp_path)
    assert posed.metric == (more.get("component") != "none")
    check(posed, depth=False)


def test_components_that_nothing_places_are_left_out(tmp_path):
    metashape(tmp_path, component="none")
    path = tmp_path / "c.xml"
    path.write_text(path.read_text().replace(
        '<component id="0">', '<component id="1"/><component id="0">').replace(
        'component_id="0" label="IMG 1.JPG"', 'component_id="1" label="IMG 1.JPG"'))
    posed = read_posed(tmp_path)
    assert len(posed.images) == COUNT - 1
    assert any("1 frame of further components" in notice for notice in posed.notices)


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
    assert any("2 frames that the headset says failed" in notice for notice in posed.notices)


def test_bundler_llff_and_opensfm(tmp_path):
    lines, rows, shots = ["# Bundle file v0.3", f"{COUNT} 0"], [], {}
    for at in range(COUNT):
        place, (right, down, ahead) = looking(at)
        for kind in ("bundler", "llff/images", "opensfm/images"):
            picture(tmp_path / kind / f"{at}.jpg", seed=at)
        # Bundler: a point p is at R p + t, x right, y up, looking along -z
        turn = np.stack([right, -down, -ahead])
        lines += [f"{FX} 0 0", *(" ".join(map(str, row)) for row in (*turn, -turn @ place))]
        rows.append([*np.column_stack([down, right, -ahead, place, [HEIGHT, WIDTH, FX]]).ravel(),
                     0.5, 9.0])
        turn = np.stack([right, down, ahead])
        angle = math.acos((np.trace(turn) - 1) / 2)
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        shots[f"{at}.jpg"] = {"camera": "c", "rotation": (
            axis / (2 * math.sin(angle)) * angle).tolist(), "translation": (-turn @ place).tolist()}
    text(tmp_path / "bundler" / "bundle.out", "\n".join(lines) + "\n")
    text(tmp_path / "bundler" / "list.txt", "".join(f"{at}.jpg\n" for at in range(COUNT)))
    np.save(tmp_path / "llff" / "poses_bounds.npy", rows)
    text(tmp_path / "opensfm" / "reconstruction.json", [{"shots": shots, "points": {}, "cameras": {
        "c": {"projection_type": "perspective", "width": WIDTH, "height": HEIGHT,
              "focal": FX / WIDTH, "k1": 0, "k2": 0}}}])
    for kind in ("bundler", "llff", "opensfm"):
        assert recognise(tmp_path / kind) == kind
        posed = read_posed(tmp_path / kind)
        found = [np.linalg.inv(image.viewmat) for image in posed.images]
        np.testing.assert_allclose(found, TRUTH, atol=1e-5)
        np.testing.assert_allclose(posed.images[0].lens.params[0], FX)


def test_a_packed_stream_of_another_shape_than_its_photo_is_refused(tmp_path):
    import lzfse

    for at in range(COUNT):
        picture(tmp_path / "rgbd" / f"{at}.jpg", seed=at)
        data = lzfse.compress(struct.pack("<7f", *[1] * 7))
        (tmp_path / "rgbd" / f"{at}.depth").write_bytes(data)
    text(tmp_path / "metadata", metadata(depth_sizes=False))
    with pytest.raises(Exception, match="nothing says in how many rows"):
        read_posed(tmp_path).images[0].depth.read()
