"""Real captures through ingest, denoise and sfm: `python tests/bench/bench_captures.py DATA OUT`.

DATA is the folder of test data. Each capture gets a workspace in OUT and a row of a table: what was
chosen and registered, which mapper gave the model (trusted, or a trusted part), how far the cameras
are from the reference where there is one, seconds and peak memory of sfm. Name captures behind OUT
to run only those, or files and folders that are not in DATA.
"""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
import zlib  # noqa: F401  # pycolmap must not be the first to load it
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import click
import cv2
import numpy as np
import pycolmap
from damaged_videos import CHANGES, bare, damaged, still, turning
from PIL import Image
from pose_errors import Poses, compare, model_poses, reference_poses, trident_poses
from scipy.spatial.transform import Rotation
from workbench import FOLDER, print_head, print_row, read_json, run_recon

from recon_cli.capture.decoded_picture import LostPacket
from recon_cli.capture.video import decode

HEADINGS = (
    "capture", "chosen", "registered", "left out", "way", "reprojection px", "centre RMSE",
    "centre median / max",
    "rotation median / max", "weak link", "explained", "fold", "sfm s", "sfm CPU s", "MB",
    "ended with")


@dataclass(frozen=True)
class Capture:
    """One row.

    Attributes:
        source: makes or names what is ingested.
        truth: the reference by frame name, None where there is none.
        metric: the reference is in metres.
        options: of each verb.
    """

    source: Callable[[Path, Path], Path]
    truth: Callable[[Path, Path], Poses] | None = None
    metric: bool = False
    options: dict[str, tuple[str, ...]] = field(default_factory=dict)


def given(path: str) -> Callable[[Path, Path], Path]:
    """A capture that lies in the data."""
    return lambda data, _out: data / path


def room(name: str) -> Callable[[Path, Path], Poses]:
    """True poses of a rendered room; frame k of the video is line k."""
    def read(data: Path, out: Path) -> Poses:
        poses = reference_poses(data / "rooms" / name / "traj.txt")
        if not (out / "places.txt").exists():
            return poses
        # a video that was cut together from the room
        places = np.loadtxt(out / "places.txt").astype(int)
        return {f"{index:06d}.png": poses[f"{place:06d}.png"]
                for index, place in enumerate(places) if place >= 0}
    return read


def fox(data: Path, _out: Path) -> Poses:
    """Poses of fox that others found."""
    return reference_poses(data / "fox")


def trident(data: Path, _out: Path) -> Poses:
    """Poses that others found."""
    return trident_poses(data)


def rpy(data: Path, _out: Path) -> Poses:
    """Motion capture; frame k of the video is line k of rgb.txt."""
    folder = data / "walks" / "tum_fr1_rpy"
    path = np.loadtxt(folder / "groundtruth.txt")
    times = np.array([float(line.split()[0]) for line in (folder / "rgb.txt").read_text(
        encoding="utf-8").splitlines() if not line.startswith("#")])
    rows = np.abs(path[:, :1] - times).argmin(axis=0)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(path[rows, 4:8]).as_matrix()
    poses[:, :3, 3] = path[rows, 1:4]
    return {f"{index:06d}.png": pose for index, pose in enumerate(poses)}


def lockers(data: Path, out: Path) -> Poses:
    """Poses that others found."""
    model = pycolmap.Reconstruction(data / "walks" / "club_room_lockers" / "sparse" / "0")
    images = (model.image(number) for number in model.reg_image_ids())
    poses = {Path(image.name).name: np.vstack(
        [image.cam_from_world().inverse().matrix(), [0, 0, 0, 1]]) for image in images}
    listed = read_json(out / "ws" / "ingest" / "frames.json")
    return {frame["name"]: poses[frame["source"]] for frame in listed["frames"]
            if frame["source"] in poses}


def dumped(path: str, stride: int) -> Callable[[Path, Path], Path]:
    """Each `stride`-th frame of a video as a folder of JPEGs, 0001.jpg and so on."""
    def write(data: Path, out: Path) -> Path:
        folder = out / "photos"
        folder.mkdir(parents=True, exist_ok=True)
        pictures = (item for item in decode(data / path, threads=1)
                    if not isinstance(item, LostPacket))
        for number, picture in enumerate(itertools.islice(pictures, 0, None, stride), 1):
            Image.fromarray(picture.rgb()).save(folder / f"{number:04d}.jpg", quality=95)
        return folder
    return write


def every(truth: Callable[[Path, Path], Poses], stride: int) -> Callable[[Path, Path], Poses]:
    """The poses of a video by the names of the frames that `dumped` takes from it."""
    def read(data: Path, out: Path) -> Poses:
        poses = truth(data, out)
        return {f"{place // stride + 1:04d}.png": pose for name, pose in poses.items()
                if (place := int(name[:6])) % stride == 0}
    return read


def noisy_fox(data: Path, out: Path) -> Path:
    """Fox with Gaussian noise of sigma 20."""
    folder, draws = out / "photos", np.random.default_rng(0)
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted((data / "fox" / "images").iterdir()):
        image = cv2.imread(str(path)).astype(np.float64)
        image += draws.normal(0, 20, image.shape)
        cv2.imwrite(str(folder / f"{path.stem}.png"), np.clip(np.rint(image), 0, 255))
    return folder


def blurred_video(data: Path, out: Path) -> Path:
    """880 frames of office, 269 of them blurred."""
    subprocess.run([
        sys.executable, str(Path(__file__).with_name("bench_frame_choice.py")),
        str(data / "rooms" / "office"), str(out)], check=True)
    return out / "video.mp4"


CAPTURES = {
    "fox": Capture(given("fox/images"), fox),
    "fox, noise 20": Capture(noisy_fox, fox, options={
        "denoise": ("--force",), "sfm": ("--pairs", "sequential")}),
    "living": Capture(given("rooms/living/video.mp4"), room("living"), metric=True),
    "office": Capture(given("rooms/office/video.mp4"), room("office"), metric=True),
    "living, noisy": Capture(
        given("rooms/living/video_noisy.mp4"), room("living"), metric=True),
    "office, noisy": Capture(
        given("rooms/office/video_noisy.mp4"), room("office"), metric=True),
    "office, blurred": Capture(
        blurred_video, room("office"), metric=True, options={"ingest": ("--frames", "40")}),
    "bedroom": Capture(given("video_bedroom/room.mp4")),
    "house entry": Capture(given("video_house_entry/video.mp4")),
    "desk": Capture(given("desk_monitors/images")),
    "snowmiku": Capture(given("snowmiku_photos")),
    "trident": Capture(given("walks/trident_desk/video.mp4"), trident),
    "bonsai": Capture(given("walks/bonsai/images")),
    "living room loop": Capture(given("walks/living_room_loop/video.mp4")),
    "lockers": Capture(given("walks/club_room_lockers/images"), lockers),
    "corridor with plants": Capture(given("walks/office_corridor_plants/images")),
    "tello": Capture(given("walks/tello_lab/images")),
    "redkitchen": Capture(given("walks/redkitchen/video.mp4")),
    "fr1 rpy": Capture(given("walks/tum_fr1_rpy/video.mp4"), rpy, metric=True),
    **{f"walk {name}": Capture(given(f"walks/forward_walks/{name}.mp4"))
       for name in (
           "bedroom_walk", "classroom_walk", "dining_walk", "kitchen_walk", "lobby_walk",
           "study_walk")},
    **{f"office, {what}": Capture(
        damaged("rooms/office/video.mp4", change), room("office"), metric=True)
       for what, change in CHANGES.items()},
    **{f"bedroom, {what}": Capture(damaged("video_bedroom/room.mp4", change))
       for what, change in CHANGES.items() if change not in (still, bare)},
    "turning on the spot": Capture(turning),
    **{f"{name}, frame in {stride}": Capture(
        dumped(path, stride), None if truth is None else every(truth, stride),
        metric=truth is rpy)
       for name, path, truth in (
           ("living room loop", "walks/living_room_loop/video.mp4", None),
           ("trident", "walks/trident_desk/video.mp4", trident),
           ("house entry", "video_house_entry/video.mp4", None),
           ("fr1 rpy", "walks/tum_fr1_rpy/video.mp4", rpy))
       for stride in (3, 5)},
}


def measured(name: str, data: Path, out: Path) -> list[str]:
    """Returns the row of a capture."""
    capture = CAPTURES[name] if name in CAPTURES else Capture(lambda *_: Path(name).resolve())
    workspace = out / "ws"
    out.mkdir(parents=True, exist_ok=True)
    sources: dict[str, tuple[str, ...]] = {"ingest": (str(capture.source(data, out)),)}
    for verb in ("ingest", "denoise", "sfm"):
        done = run_recon(
            workspace, verb, *sources.get(verb, ()), *capture.options.get(verb, ()))
        if done.code:
            return [name, *[""] * (len(HEADINGS) - 2), f"exit {done.code}: {done.error}"]
    manifest = read_json(workspace / "sfm" / "manifest.json")
    cells = accuracy(capture, data, out)
    summary = read_json(workspace / "place" / "manifest.json")["summary"]
    verdict = read_json(workspace / "place" / "verdict.json")
    return [
        name, str(summary["frames"]), str(summary["registered"]), str(len(summary["left_out"])),
        next((rung["name"] for rung in summary["rungs"] if rung["kept"]), "given poses"),
        f"{summary['reprojection_error_px']:.2f}", *cells,
        share(verdict["weak_link"]["share"]), share(verdict["weak_link"]["explained"]),
        share(verdict["fold"]["share"]), f"{manifest['seconds']:.0f}",
        f"{sum(summary['cpu_seconds'].values()):.0f}",
        f"{manifest['peak_memory_bytes'] / 1e6:.0f}",
        "trusted" if verdict["trusted"] else "; ".join(verdict["problems"])]


def share(found: float | None) -> str:
    """A share that a test of the verdict found."""
    return "none" if found is None else f"{found:.2f}"


def accuracy(capture: Capture, data: Path, out: Path) -> tuple[str, str, str]:
    """Cells on the errors of the cameras."""
    if capture.truth is None:
        return "", "", ""
    errors = compare(model_poses(out / "ws" / "place" / "sparse"), capture.truth(data, out))
    return (
        f"{100 * errors.rmse:.2f} cm" if capture.metric else "",
        f"{errors.median_share:.2%} / {errors.max_share:.2%}",
        f"{errors.own_rotation_deg:.2f} / {errors.own_rotation_max_deg:.2f} deg")


@click.command()
@click.argument("data", type=FOLDER)
@click.argument("out", type=click.Path(file_okay=False, path_type=Path))
@click.argument("names", nargs=-1)
def main(data: Path, out: Path, names: tuple[str, ...]) -> None:
    """Prints a Markdown table, a row as soon as it is known."""
    print_head(*HEADINGS)
    for name in names or CAPTURES:
        if name not in CAPTURES and not Path(name).exists():
            raise click.BadParameter(f"{name} is neither a file nor one of {', '.join(CAPTURES)}.")
        folder = out.resolve() / re.sub(r"[^\w.]+", "_", name).strip("_")
        print_row(*measured(name, data.resolve(), folder))


if __name__ == "__main__":
    main()
