"""Small captures in the layouts of scanning apps and photogrammetry, of a room with exact poses.

The writers follow what the apps write, and share no code with the readers. `shots` takes frames of
the rendered office (z up, metres, OpenCV's axes); a writer puts them into the world and the axes of
its app and returns nothing: `expected` says where the cameras lie in that world.
"""

import dataclasses
import json
import zipfile
from fractions import Fraction

import av
import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

GL = np.diag([1.0, -1.0, -1.0, 1.0])
# From z up to y up; then a heading and an origin of the app's own.
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
HEADING = np.eye(4)
HEADING[:3, :3] = Rotation.from_rotvec([0, 0.7, 0]).as_matrix()
HEADING[:3, 3] = [0.4, -1.3, 0.25]
ARKIT = HEADING @ Y_UP
STEPS = 5  # the room has depth for every fifth frame
CROP = 6  # columns: what the middle moves by, so that each frame has its own intrinsics


@dataclasses.dataclass(frozen=True, eq=False)
class Shot:
    number: int
    rgb: np.ndarray
    depth: np.ndarray  # metres, of a fraction of the size
    c2w: np.ndarray  # OpenCV, z up, metres
    inner: tuple  # fx fy cx cy for rgb
    time: float

    @property
    def size(self):
        return self.rgb.shape[1], self.rgb.shape[0]


def shots(room, count=6, step=15, factor=2, moving=True):
    """Returns frames of a room in the Replica layout, reduced by a factor."""
    poses = np.loadtxt(room / "traj.txt").reshape(-1, 4, 4)
    found = []
    for index in range(count):
        at = index * step
        assert at % STEPS == 0
        rgb = np.asarray(Image.open(room / "results" / f"frame{at:06d}.jpg"))
        z = np.asarray(Image.open(room / "results" / f"depth{at:06d}.png")) / 6553.5
        height, width = rgb.shape[0] // factor, rgb.shape[1] // factor
        rgb = cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA)
        left = index % 3 * CROP // 2 * moving
        rgb = rgb[:, left:width - (CROP - left) * moving if moving else None]
        # Depth of a quarter of the photo's size, at the middles of its pixels.
        columns = ((np.arange(rgb.shape[1] // 4) + 0.5) * 4 + left) * factor
        rows = (np.arange(rgb.shape[0] // 4) + 0.5) * 4 * factor
        depth = z[np.ix_(rows.astype(int), columns.astype(int))]
        inner = (300 / factor, 300 / factor, 300 / factor - left, 170 / factor)
        found.append(Shot(index, np.ascontiguousarray(rgb), depth, poses[at], inner, 10 + 0.1 * at))
    return found


def cut(shot):
    """Returns a shot whose photo is a whole number of depth pixels large."""
    width, height = shot.depth.shape[1] * 4, shot.depth.shape[0] * 4
    return dataclasses.replace(shot, rgb=np.ascontiguousarray(shot.rgb[:height, :width]))


def jpeg(path, rgb):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(rgb).save(path, quality=95)


def millimetres(path, depth):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(path)


def levels(path, depth, high=2):
    """Writes confidence: the left column low, the next one medium, the rest high."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.full(depth.shape, high, np.uint8)
    values[:, 0], values[:, 1] = 0, high // 2
    Image.fromarray(values).save(path)


def quat(matrix):
    return Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()  # x y z w


def polycam(folder, frames, corrected=True, sizes=True):
    for frame in frames:
        stem = str(1_700_000_000_000_000 + round(frame.time * 1e6))
        pose, place = (ARKIT @ frame.c2w @ GL)[:3], folder / "keyframes"
        value = dict(zip(("fx", "fy", "cx", "cy"), frame.inner, strict=True))
        value |= {f"t_{row}{column}": float(pose[row, column])
                  for row in range(3) for column in range(4)}
        value["blur_score"] = 100.0 + frame.number
        for kind in ("corrected_", "") if corrected else ("",):
            text = dict(value)
            if not kind:  # drifted
                text["t_03"] += 0.02 * frame.number * corrected
            if sizes:
                text |= {"width": frame.size[0], "height": frame.size[1]}
            jpeg(place / f"{kind}images" / f"{stem}.jpg", frame.rgb)
            (place / f"{kind}cameras").mkdir(exist_ok=True)
            (place / f"{kind}cameras" / f"{stem}.json").write_text(json.dumps(text))
        millimetres(place / "depth" / f"{stem}.png", frame.depth)
        levels(place / "confidence" / f"{stem}.png", frame.depth, 255)
    (folder / "mesh_info.json").write_text("{}")
    jpeg(folder / "thumbnail.jpg", frames[0].rgb)


def relative(frames):
    """Returns the world of a recording whose first camera is at the origin, ARKit's axes."""
    return np.linalg.inv(frames[0].c2w @ GL)


def record3d_metadata(frames, own=True):
    """Returns what `metadata` holds, with places in the lists that no file has."""
    world, size = relative(frames), frames[0].size
    count = 10 * len(frames)
    poses, inner, times = [[0, 0, 0, 1, 9, 9, 9]] * count, [[1, 1, 1, 1]] * count, [0.0] * count
    for frame in frames:
        pose, at = world @ frame.c2w @ GL, 7 * frame.number + 2
        poses[at] = [*quat(pose), *pose[:3, 3].tolist()]
        inner[at], times[at] = list(frame.inner), frame.time
    fx, fy, cx, cy = frames[0].inner
    value = {
        "w": size[0], "h": size[1], "dw": frames[0].depth.shape[1], "dh": frames[0].depth.shape[0],
        "fps": 60, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1], "initPose": [0, 0, 0, 1, 0, 0, 0],
        "poses": poses, "frameTimestamps": times}
    if own:
        value["perFrameIntrinsicCoeffs"] = inner
    return value


def record3d(folder, frames, inside="EXR_RGBD", own=True):
    import OpenEXR

    home = folder / inside if inside else folder
    (home / "depth").mkdir(parents=True)
    for frame in frames:
        at = 7 * frame.number + 2
        jpeg(home / "rgb" / f"{at}.jpg", frame.rgb)
        OpenEXR.File(
            {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage},
            {"R": frame.depth.astype(np.float32)}).write(str(home / "depth" / f"{at}.exr"))
    jpeg(home / "rgb" / "9(3).jpg", frames[0].rgb)
    (home / "metadata.json").write_text(json.dumps(record3d_metadata(frames, own)))


def r3d_entries(frames):
    """Returns the content of an .r3d by name."""
    import lzfse

    entries = {"metadata": json.dumps(record3d_metadata(frames)).encode(), "icon": b"\xff\xd8\xff"}
    for frame in frames:
        stem = f"rgbd/{7 * frame.number + 2}"
        confidence = np.full(frame.depth.shape, 2, np.uint8)
        confidence[:, 0], confidence[:, 1] = 0, 1
        _, photo = cv2.imencode(".jpg", frame.rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
        entries |= {
            f"{stem}.jpg": photo.tobytes(),
            f"{stem}.depth": lzfse.compress(frame.depth.astype("<f4").tobytes()),
            f"{stem}.conf": lzfse.compress(confidence.tobytes())}
    return entries


def r3d(folder, frames):
    """Writes the recording as a folder; `pack` makes it a file."""
    for name, data in r3d_entries(frames).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)


def pack(path, frames):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in r3d_entries(frames).items():
            archive.writestr(name, data)
    return path


def video(path, frames, gap=3):
    """Writes frames with times that have a gap, without B-frames being forbidden."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=60)
        height, width = (side // 2 * 2 for side in frames[0].shape[:2])
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "12", "bf": "2"}
        stream.time_base = stream.codec_context.time_base = Fraction(1, 600)
        for at, rgb in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(
                np.ascontiguousarray(rgb[:height, :width]), format="rgb24")
            picture.pts, picture.time_base = 10 * (at + gap * (at > 2)), Fraction(1, 600)
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))


def stray(folder, frames, own=True, between=3):
    """Writes a video in which each shot is followed by frames of flat gray, with poses far off."""
    folder.mkdir(parents=True, exist_ok=True)
    head = "timestamp, frame, x, y, z, qx, qy, qz, qw"
    if own:
        head += ", fx, fy, cx, cy, distortion_center_x, distortion_center_y"
    lines, pictures = [head], []
    for frame in frames:
        pose = ARKIT @ frame.c2w
        for filler in range(between):
            number = frame.number * between + filler
            rgb = frame.rgb if not filler else np.full_like(frame.rgb, 40 * filler)
            pictures.append(rgb)
            shift = pose[:3, 3] + 7 * filler
            row = [f"{frame.time + filler / 60:.6f}", f"{number:06d}",
                   *(f"{one:.9f}" for one in (*shift, *quat(pose)))]
            if own:
                row += [*(f"{one:.6f}" for one in frame.inner), "", ""]
            lines.append(", ".join(row))
            if not filler:
                millimetres(folder / "depth" / f"{number:06d}.png", frame.depth)
                levels(folder / "confidence" / f"{number:06d}.png", frame.depth)
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    fx, fy, cx, cy = frames[-1].inner
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0\n")
    (folder / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n")
    video(folder / "rgb.mp4", pictures)


def nerfcapture(folder, frames, scale=10 / 65535, key="integer_depth_scale"):
    (folder / "images").mkdir(parents=True)
    entries = []
    for frame in reversed(frames):
        Image.fromarray(frame.rgb).save(folder / "images" / f"{frame.number}.png")
        full = cv2.resize(frame.depth, frame.size, interpolation=cv2.INTER_NEAREST)
        values = np.rint(full / scale)
        kind = np.uint16 if scale < 0.1 else np.uint8
        Image.fromarray(values.clip(0, np.iinfo(kind).max).astype(kind)).save(
            folder / "images" / f"{frame.number}.depth.png")
        fx, fy, cx, cy = frame.inner
        entries.append({
            "file_path": f"images/{frame.number}", "depth_path": f"images/{frame.number}.depth.png",
            "transform_matrix": (ARKIT @ frame.c2w @ GL).tolist(), "fl_x": fx, "fl_y": fy,
            "cx": cx, "cy": cy, "w": frame.size[0], "h": frame.size[1]})
    (folder / "transforms.json").write_text(json.dumps({key: scale, "frames": entries}))


def scanner_app(folder, frames):
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(3 * len(frames)):  # a pose for each, a photo for every third
        frame = frames[number // 3]
        fx, fy, cx, cy = frame.inner
        pose = ARKIT @ frame.c2w @ GL
        if number % 3:
            pose = pose + np.eye(4, k=3) * 0.01
        (folder / f"frame_{number:05d}.json").write_text(json.dumps({
            "cameraPoseARFrame": pose.ravel().tolist(), "frame_index": number, "motionQuality": 1,
            "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1], "time": frame.time + number % 3 / 60}))
        millimetres(folder / f"depth_{number:05d}.png", frame.depth)
        levels(folder / f"conf_{number:05d}.png", frame.depth)
        if number % 3 == 0:
            jpeg(folder / f"frame_{number:05d}.jpg", frame.rgb)
    jpeg(folder / "thumb_00000.jpg", frames[0].rgb)
    (folder / "info.json").write_text("{}")


def arkit_scenes(folder, frames, inside="42444946_frames"):
    home = folder / inside
    rows = []
    for frame in frames:
        stem = f"42444946_{frame.time:.3f}"
        (home / "lowres_wide").mkdir(parents=True, exist_ok=True)
        Image.fromarray(frame.rgb).save(home / "lowres_wide" / f"{stem}.png")
        near = f"42444946_{frame.time + 0.001 * (frame.number % 2):.3f}"
        (home / "lowres_wide_intrinsics").mkdir(exist_ok=True)
        (home / "lowres_wide_intrinsics" / f"{near}.pincam").write_text(
            " ".join(map(str, (*frame.size, *frame.inner))))
        millimetres(home / "lowres_depth" / f"{stem}.png", frame.depth)
        levels(home / "confidence" / f"{stem}.png", frame.depth)
        w2c = np.linalg.inv(frame.c2w)
        turn = Rotation.from_matrix(w2c[:3, :3]).as_rotvec()
        rows.append(" ".join(f"{one:.9f}" for one in (frame.time, *turn, *w2c[:3, 3])))
    (home / "lowres_wide.traj").write_text("\n".join(rows) + "\n")


YAML = """%YAML:1.0
---
camera_name: "1"
image_width: {w}
image_height: {h}
camera_matrix:
   rows: 3
   cols: 3
   data: [ {fx}, 0., {cx}, 0., {fy}, {cy}, 0., 0., 1. ]
distortion_model: plumb_bob
distortion_coefficients:
   rows: 1
   cols: 5
   data: [ 0., 0., 0., 0., 0. ]
local_transform:
   rows: 3
   cols: 4
   data: [ 0., 0., 1., 0., -1., 0., 0., 0., 0., -1., 0., 0. ]
"""


def rtabmap(folder, frames, name="rtabmap", camera=True, by_id=False, ids=True):
    rows = ["#timestamp x y z qx qy qz qw" + " id" * ids]
    local = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    for frame in reversed(frames):
        number, stamp = frame.number + 10, f"{frame.time:.6f}"
        stem = str(number) if by_id else stamp
        fx, fy, cx, cy = frame.inner
        jpeg(folder / f"{name}_rgb" / f"{stem}.jpg", frame.rgb)
        millimetres(folder / f"{name}_depth" / f"{stem}.png", frame.depth)
        (folder / f"{name}_calib").mkdir(exist_ok=True)
        (folder / f"{name}_calib" / f"{stem}.yaml").write_text(YAML.format(
            w=frame.size[0], h=frame.size[1], fx=fx, fy=fy, cx=cx, cy=cy))
        pose = frame.c2w if camera else frame.c2w @ np.linalg.inv(local)
        numbers = " ".join(f"{one:.6f}" for one in (*pose[:3, 3], *quat(pose)))
        rows.append(f"{stamp} {numbers}" + f" {number}" * ids)
    if ids:
        rows.append("0.000000 1 2 3 0 0 0 1 -7")  # a landmark
    end = "camera_poses" if camera else "poses"
    (folder / f"{name}_{end}.txt").write_text("\n".join(rows) + "\n")


def reality_scan(folder, frames, shift=(0.0, 0.0, 0.0)):
    lines = ["#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for frame in frames:
        jpeg(folder / f"photo_{frame.number:02d}.jpg", frame.rgb)
        width, height = frame.size
        longer = max(width, height)
        fx, _, cx, cy = frame.inner
        matrix = (frame.c2w @ GL)[:3, :3]
        # Rz(-h) Rx(p) Ry(r): the angles read off its entries
        pitch = np.degrees(np.arcsin(matrix[2, 1]))
        heading = np.degrees(np.arctan2(matrix[0, 1], matrix[1, 1]))
        roll = np.degrees(np.arctan2(-matrix[2, 0], matrix[2, 2]))
        values = (*(frame.c2w[:3, 3] + shift), heading, pitch, roll, fx * 36 / longer,
                  (cx - width / 2) / longer, (cy - height / 2) / longer, 0, 0, 0, 0, 0, 0)
        lines.append(f"photo_{frame.number:02d}.jpg," + ",".join(f"{one:.9f}" for one in values))
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n")


def metashape(folder, frames, scale=0.37, shift=(3.0, -2.0, 5.0)):
    """Writes a chunk in units of its own, turned; the component's transform brings metres back."""
    turn = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix()  # chunk to world
    shift = np.array(shift)
    lines = ['<?xml version="1.0" encoding="UTF-8"?>', '<document version="2.0.0">',
             '<chunk label="Chunk 1" enabled="true">', "<sensors>"]
    inner = {frame.inner: str(at) for at, frame in enumerate(frames)}
    width, height = frames[0].size
    for (fx, fy, cx, cy), number in inner.items():
        lines.append(
            f'<sensor id="{number}" label="unknown" type="frame">'
            f'<resolution width="{width}" height="{height}"/>'
            '<calibration type="frame" class="initial"><f>99</f></calibration>'
            '<calibration type="frame" class="adjusted">'
            f'<resolution width="{width}" height="{height}"/><f>{fy!r}</f>'
            f"<cx>{cx - width / 2!r}</cx><cy>{cy - height / 2!r}</cy><b1>{fx - fy!r}</b1>"
            "</calibration></sensor>")
    lines.append('</sensors><components><component id="0"><transform><rotation>'
                 + " ".join(map(repr, turn.ravel().tolist())) + "</rotation><translation>"
                 + " ".join(map(repr, shift.tolist())) + f"</translation><scale>{scale!r}</scale>"
                 "</transform></component></components><cameras><group>")
    for frame in frames:
        jpeg(folder / f"IMG_{frame.number}.jpg", frame.rgb)
        local = np.eye(4)
        local[:3, :3] = turn.T @ frame.c2w[:3, :3]
        local[:3, 3] = turn.T @ (frame.c2w[:3, 3] + shift_of(shift) - shift) / scale
        lines.append(
            f'<camera id="{frame.number}" sensor_id="{inner[frame.inner]}" component_id="0" '
            f'label="IMG_{frame.number}"><transform>'
            + " ".join(map(repr, local.ravel().tolist())) + "</transform></camera>")
    lines.append('</group><camera id="99" sensor_id="0" label="IMG_99"/></cameras></chunk>'
                 "</document>")
    (folder / "cameras.xml").write_text("\n".join(lines))


def shift_of(shift):
    """Returns what is added to the true positions: nothing, unless the world is a map's."""
    return shift if np.abs(shift).max() > 1e4 else np.zeros(3)


def bundler(folder, frames):
    lines = ["# Bundle file v0.3", f"{len(frames) + 1} 1"]
    flip = np.diag([1.0, -1.0, -1.0])
    for frame in frames:
        jpeg(folder / "images" / f"b{frame.number}.jpg", frame.rgb)
        w2c = np.linalg.inv(frame.c2w)
        rotation, shift = flip @ w2c[:3, :3], flip @ w2c[:3, 3]
        lines.append(f"{frame.inner[0]} 0 0")
        lines += [" ".join(f"{one:.12g}" for one in row) for row in (*rotation, shift)]
    lines += ["0 0 0"] * 5  # one that was not placed
    lines += ["1 2 3", "10 20 30", "2 0 5 1.0 2.0 1 6 1.0 2.0"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("".join(
        f"./images/b{frame.number}.jpg 0 {frame.inner[0]}\n" for frame in frames)
        + "./images/lost.jpg\n")


def opensfm(folder, frames, report=False):
    """Writes an OpenSfM reconstruction, or what OpenDroneMap's report holds."""
    cameras, shots_ = {}, {}
    for frame in frames:
        width, height = frame.size
        longer = max(frame.size)
        fx, fy, cx, cy = frame.inner
        jpeg(folder / "images" / f"o{frame.number}.jpg", frame.rgb)
        w2c = np.linalg.inv(frame.c2w)
        cameras[f"c{frame.number}"] = {
            "projection_type": "brown", "width": width, "height": height,
            "focal_x": fx / longer, "focal_y": fy / longer, "c_x": (cx - width / 2) / longer,
            "c_y": (cy - height / 2) / longer,
            **dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)}
        turn = Rotation.from_matrix(w2c[:3, :3]).as_rotvec().tolist()
        shots_[f"o{frame.number}.jpg"] = {
            "rotation": turn, "camera": f"c{frame.number}",
            "translation": (frame.c2w if report else w2c)[:3, 3].tolist()}
    if report:
        (folder / "odm_report").mkdir()
        (folder / "cameras.json").write_text(json.dumps(cameras))
        (folder / "odm_report" / "shots.geojson").write_text(json.dumps({
            "type": "FeatureCollection", "features": [
                {"type": "Feature", "properties": {"filename": name, **shot}}
                for name, shot in shots_.items()]}))
        return
    (folder / "opensfm").mkdir()
    (folder / "opensfm" / "reconstruction.json").write_text(json.dumps([
        {"cameras": {}, "shots": {}},
        {"cameras": cameras, "shots": shots_, "points": {
            "1": {"coordinates": [1.0, 2.0, 0.5], "color": [255, 0, 0]}}}]))


def llff(folder, frames):
    rows = []
    for frame in frames:
        jpeg(folder / "images" / f"l{frame.number:03d}.jpg", frame.rgb)
        right, down, ahead, position = frame.c2w[:3].T
        width, height = frame.size
        matrix = np.column_stack([down, right, -ahead, position, [height, width, frame.inner[0]]])
        rows.append([*matrix.ravel(), 0.5, 6.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


QUEST_COLUMNS = (
    "frame_index", "file_name", "unix_time_ms", "timestamp_us_realtime", "width", "height",
    "format", "camera_position", "pose_pos_x", "pose_pos_y", "pose_pos_z", "pose_rot_x",
    "pose_rot_y", "pose_rot_z", "pose_rot_w", "pose_ok", "get_texture_ok", "get_colors_ok", "error")


def quest(folder, frames, baseline=0.06):
    """Writes both cameras: the left one at the true place, the right one beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "session_info.json").write_text(
        json.dumps({"sessionFormatVersion": 2, "captureBackend": "MRUK"}))
    mirror = np.diag([1.0, 1, -1, 1])
    for eye, offset in (("left", 0.0), ("right", baseline)):
        home = folder / f"{eye}_camera_mruk_rgba"
        home.mkdir()
        lines = [",".join(QUEST_COLUMNS)]
        fx, fy, cx, cy = frames[0].inner
        width, height = frames[0].size
        (folder / f"{eye}_camera_mruk_intrinsics.json").write_text(json.dumps({
            "focalLength": {"x": fx, "y": fy}, "principalPoint": {"x": cx, "y": cy},
            "resolution": {"width": width, "height": height}}))
        for frame in frames:
            beside = np.eye(4)
            beside[0, 3] = offset
            # Unity: mirror z of the world, y of the camera; both are their own inverse.
            unity = mirror @ ARKIT @ frame.c2w @ beside @ np.diag([1.0, -1, 1, 1])
            stamp = round(frame.time * 1e6)
            rgba = np.dstack([frame.rgb, np.full(frame.rgb.shape[:2], 255, np.uint8)])
            (home / f"{stamp}.rgba").write_bytes(np.ascontiguousarray(rgba[::-1]).tobytes())
            good = "true" if frame.number != 1 or eye == "left" else "false"
            values = [frame.number, f"{stamp}.rgba", 0, stamp, width, height, "RGBA32", eye,
                      *unity[:3, 3], *quat(unity), good, "true", "true", ""]
            lines.append(",".join(map(str, values)))
        (folder / f"{eye}_camera_mruk_frame_metadata.csv").write_text("\n".join(lines) + "\n")


def rig(folder, frames):
    """Writes a COLMAP model of a rig of two cameras in folders of their own, as text."""
    import pycolmap

    model = pycolmap.Reconstruction()
    apart = pycolmap.Rigid3d(np.column_stack([np.eye(3), [-0.1, 0, 0]]))  # second from first
    width, height = frames[0].size
    one = pycolmap.Rig(rig_id=1)
    for camera in (1, 2):
        model.add_camera(pycolmap.Camera(
            camera_id=camera, model="PINHOLE", width=width, height=height, params=frames[0].inner))
    one.add_ref_sensor(model.camera(1).sensor_id)
    one.add_sensor(model.camera(2).sensor_id, apart)
    model.add_rig(one)
    for frame in frames:
        moment = pycolmap.Frame(frame_id=frame.number + 1, rig_id=1)
        for camera in (1, 2):
            image = 2 * frame.number + camera
            moment.add_data_id(pycolmap.data_t(model.camera(camera).sensor_id, image))
        moment.rig_from_world = pycolmap.Rigid3d(np.linalg.inv(frame.c2w)[:3])
        model.add_frame(moment)
        for camera in (1, 2):
            name = f"rig1/camera{camera}/image{frame.number:04d}.jpg"
            jpeg(folder / "images" / name, frame.rgb)
            model.add_image(pycolmap.Image(
                image_id=2 * frame.number + camera, name=name, camera_id=camera,
                frame_id=frame.number + 1))
        model.register_frame(frame.number + 1)
    model.add_point3D(np.array([1.0, 2, 0.5]), pycolmap.Track(), np.array([9, 9, 9], np.uint8))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_text(str(folder / "sparse" / "0"))




@dataclasses.dataclass(frozen=True)
class App:
    name: str  # of the layout
    write: object  # (folder, shots)
    world: object = None  # [4, 4] from the true world to that of the files; None: relative
    up: tuple | None = (0.0, 0.0, 1.0)
    metric: bool = True
    depth: bool = True
    accuracy: str = "tracked"
    own: bool = True  # each frame has its own intrinsics
    cameras: int = 1  # images of each shot


IDENTITY = np.eye(4)
Y = (0.0, 1.0, 0.0)
APPS = {
    "polycam": App("polycam", polycam, ARKIT, Y, accuracy="solved"),
    "record3d": App("record3d", record3d, None, None),
    "r3d": App("record3d", r3d, None, None),
    "stray": App("stray", stray, ARKIT, Y),
    "nerfcapture": App("nerfcapture", nerfcapture, ARKIT, Y),
    "3dscannerapp": App("3dscannerapp", scanner_app, ARKIT, Y),
    "arkitscenes": App("arkitscenes", arkit_scenes, IDENTITY),
    "rtabmap": App("rtabmap", rtabmap, IDENTITY, accuracy="solved"),
    "realityscan": App("realityscan", reality_scan, IDENTITY, metric=False, depth=False,
                        accuracy="solved"),
    "metashape": App("metashape", metashape, IDENTITY, depth=False, accuracy="solved"),
    "bundler": App("bundler", bundler, IDENTITY, None, metric=False, depth=False,
                    accuracy="solved", own=False),
    "opensfm": App("opensfm", opensfm, IDENTITY, metric=False, depth=False, accuracy="solved"),
    "llff": App("llff", llff, IDENTITY, None, metric=False, depth=False, accuracy="solved",
                 own=False),
    "colmap rig": App("colmap", rig, IDENTITY, None, metric=False, depth=False,
                       accuracy="solved", own=False, cameras=2),
    "quest": App("quest", quest, ARKIT, Y, depth=False, own=False, cameras=2),
}
