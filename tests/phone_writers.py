"""Writers of captures of phones and headsets; see `app_sets`."""

import json
import zipfile
from fractions import Fraction

import av
import cv2
import numpy as np
from app_shots import ARKIT, GL, jpeg, levels, millimetres, quat, rotation
from PIL import Image


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
        turn = rotation(w2c).as_rotvec()
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


QUEST_COLUMNS = (
    "frame_index", "file_name", "unix_time_ms", "timestamp_us_realtime", "width", "height",
    "format", "camera_position", "pose_pos_x", "pose_pos_y", "pose_pos_z", "pose_rot_x",
    "pose_rot_y", "pose_rot_z", "pose_rot_w", "pose_ok", "get_texture_ok", "get_colors_ok", "error")


def quest(folder, frames, baseline=0.06, eyes=("left", "right")):
    """Writes both cameras: the left one at the true place, the right one beside it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "session_info.json").write_text(
        json.dumps({"sessionFormatVersion": 2, "captureBackend": "MRUK"}))
    mirror = np.diag([1.0, 1, -1, 1])
    for eye, offset in zip(eyes, (0.0, baseline), strict=False):
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
            values = [frame.number, f"{stamp}.rgba", stamp // 1000, stamp, width, height,
                      "RGBA32", eye, *unity[:3, 3], *quat(unity), good, "true", "true", ""]
            lines.append(",".join(map(str, values)))
        (folder / f"{eye}_camera_mruk_frame_metadata.csv").write_text("\n".join(lines) + "\n")
