"""Small data sets with poses in every layout, made on the fly: one walk past a tilted plane."""

import json

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 32, 24
FOCAL, CX, CY = 30.0, 16.5, 11.0  # pixel centres at +0.5
NORMAL, OFFSET = np.array([0.1, -0.2, 1.0]), 4.0  # the plane NORMAL . x = OFFSET
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def pose(index):
    """Returns camera to world, OpenCV axes: a step along x and a small turn for each frame."""
    angle = 0.05 * index
    c2w = np.eye(4)
    c2w[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    c2w[:3, 3] = [0.1 * index, 0.05, -0.2]
    return c2w


def plane_depth(c2w, width=WIDTH, height=HEIGHT, focal=FOCAL, cx=CX, cy=CY):
    """Returns the z-depth of the plane in closed form."""
    x, y = np.meshgrid(np.arange(width) + 0.5 - cx, np.arange(height) + 0.5 - cy) / np.array(focal)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ c2w[:3, :3].T
    return (OFFSET - NORMAL @ c2w[:3, 3]) / (rays @ NORMAL)


def write_image(path, width=WIDTH, height=HEIGHT, color=(200, 100, 50)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (width, height), color).save(path)


def write_depth(path, depth, scale):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(depth * scale).astype(np.uint16)).save(path)


def make_replica(folder, frames=4, tests=2, every=2, scale=6553.5):
    """Writes a Replica sequence with depth for every second frame."""
    write_replica_part(folder, range(frames), every, scale)
    if tests:
        write_replica_part(folder / "test", range(10, 10 + tests), 1, scale)
    (folder / "cam_params.json").write_text(json.dumps({"camera": {
        "w": WIDTH, "h": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": CX - 0.5, "cy": CY - 0.5,
        "scale": scale}}))
    return folder


def write_replica_part(folder, places, every, scale):
    for number, place in enumerate(places):
        write_image(folder / "results" / f"frame{number:06d}.jpg")
        if number % every == 0:
            write_depth(
                folder / "results" / f"depth{number:06d}.png", plane_depth(pose(place)), scale)
    (folder / "traj.txt").write_text("".join(
        " ".join(f"{value:.9e}" for value in pose(place).ravel()) + "\n" for place in places))


def make_scannet(folder, frames=4, lost=(1,), depth_size=(WIDTH // 2, HEIGHT // 2)):
    """Writes a ScanNet scene whose depth is half as large as its colours."""
    for number in range(frames):
        c2w = pose(number)
        write_image(folder / "color" / f"{number}.jpg")
        half = plane_depth(c2w, *depth_size, FOCAL / 2, CX / 2, CY / 2)
        write_depth(folder / "depth" / f"{number}.png", half, 1000)
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / "pose" / f"{number}.txt",
                   np.full((4, 4), -np.inf) if number in lost else c2w)
    (folder / "intrinsic").mkdir()
    for kind, share in (("color", 1), ("depth", 2)):
        np.savetxt(folder / "intrinsic" / f"intrinsic_{kind}.txt", [
            [FOCAL / share, 0, CX / share - 0.5, 0], [0, FOCAL / share, CY / share - 0.5, 0],
            [0, 0, 1, 0], [0, 0, 0, 1]])
    return folder


def make_seven_scenes(folder, frames=4, lost=(1,)):
    """Writes a 7-Scenes sequence with its intrinsics; one corner of the depth is unknown."""
    for number in range(frames):
        c2w = pose(number)
        write_image(folder / f"frame-{number:06d}.color.png")
        depth = plane_depth(c2w)
        depth[:2, :3] = 65.535
        write_depth(folder / f"frame-{number:06d}.depth.png", depth, 1000)
        np.savetxt(folder / f"frame-{number:06d}.pose.txt",
                   np.full((4, 4), -np.inf) if number in lost else c2w)
    np.savetxt(folder / "camera-intrinsics.txt", [
        [FOCAL, 0, CX - 0.5], [0, FOCAL, CY - 0.5], [0, 0, 1]])
    return folder


def make_tum(folder, frames=4):
    """Writes a TUM RGB-D sequence whose motion capture ends before the last frame.

    Frames are .1 s apart, depth comes 5 ms later, and the path has a pose each .02 s.
    """
    def write_list(name, rows):
        (folder / name).write_text("# a comment\n" + "".join(
            " ".join(map(str, row)) + "\n" for row in rows))

    for number in range(frames):
        write_image(folder / "rgb" / f"{number}.png", 640, 480)
        write_depth(folder / "depth" / f"{number}.png",
                    plane_depth(pose(number), 640, 480, 525.0, 320.0, 240.0), 5000)
    write_list("rgb.txt", [(f"{10 + 0.1 * n:.6f}", f"rgb/{n}.png") for n in range(frames)])
    write_list("depth.txt", [
        (f"{10.005 + 0.1 * n:.6f}", f"depth/{n}.png") for n in range(frames)])
    rows = []
    for step in range(5 * frames - 5):  # from .03 s before the first frame on
        at = 0.2 * step - 0.3
        half = 0.05 * at / 2  # as in `pose`
        turn = 0, np.sin(half), 0, np.cos(half)
        rows.append((f"{10 + 0.1 * at:.6f}", 0.1 * at, 0.05, -0.2, *turn))
    write_list("groundtruth.txt", rows)
    return folder


def transforms(frames=4, **more):
    """Returns what a transforms.json of nerfstudio holds."""
    return {
        "fl_x": FOCAL, "fl_y": FOCAL, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT, **more,
        "frames": [
            {"file_path": f"images/{number:04d}.png",
             "transform_matrix": (pose(number) @ OPENGL).tolist()} for number in range(frames)]}


def make_transforms(folder, value=None, name="transforms.json"):
    """Writes a transforms.json and the images that it lists."""
    value = transforms() if value is None else value
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(json.dumps(value))
    for frame in value["frames"]:
        write_image(folder / frame["file_path"])
    return folder
