"""Writers of the cameras of photogrammetry programs; see `app_sets`."""

import json

import numpy as np
from app_shots import GL, jpeg, rotation
from scipy.spatial.transform import Rotation


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
        turn = rotation(w2c).as_rotvec().tolist()
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


def rig(folder, frames, baseline=0.1):
    """Writes a COLMAP model of a rig of two cameras in folders of their own, as text."""
    import pycolmap

    model = pycolmap.Reconstruction()
    apart = pycolmap.Rigid3d(np.column_stack([np.eye(3), [-baseline, 0, 0]]))  # second from first
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
