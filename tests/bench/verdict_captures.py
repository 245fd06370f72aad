"""The captures whose models `bench_verdict` judges: frames, features, matches and a model of each.

What is found stays in a folder for each capture, so that a second run reads it from there.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
from damaged_videos import turn_before
from numpy.typing import NDArray
from workbench import mapping_job

from recon_cli.config.stages import IngestConfig
from recon_cli.context import StageContext, StageInputs
from recon_cli.progress import NullProgress
from recon_cli.sfm.features import features, matching
from recon_cli.sfm.job import CLIP_SECONDS, MappingJob, Reporter
from recon_cli.sfm.mapping import mapper
from recon_cli.stages import ingest
from recon_cli.workspace import records

FEATURES = 2000  # of an image; two thirds of the default take half of the time
MODEL = "model.done"  # in a capture's folder
THIN = sorted({*range(40)} - {15, 17, 20, 26, 39})  # seeds; those left out repeat a choice


@dataclass(frozen=True)
class Capture:
    """One capture of the table.

    Attributes:
        name: as printed.
        source: makes or names what is ingested, given DATA and the capture's folder.
        frames: chosen from a video; photos are taken every `stride`.
        size: longest side of a frame, pixels.
        features: most keypoints of an image.
        exhaustive: match all pairs; else neighbours and images that look alike.
        label: what its model is where no reference tells: good or broken, by eye. tum_rpy is good
            by its rotations, off by 1.2 degrees in the median. Of lockers one camera is 6% off the
            poses of others, which fewer of its matches agree with. corridor leaps twice.
        turning: it hardly moves, so that displacements of its cameras say nothing.
        thin: so few frames that mappers go wrong in more ways than one; mapped with other seeds and
            thresholds too, and nothing else is made from it.
    """

    name: str
    source: Callable[[Path, Path], Path]
    frames: int = 60
    stride: int = 1
    size: int = 800
    features: int = FEATURES
    exhaustive: bool = True
    label: str = ""
    turning: bool = False
    thin: bool = False


def given(path: str) -> Callable[[Path, Path], Path]:
    """A capture that lies in the data."""
    return lambda data, _folder: data / path


def every(path: str, stride: int) -> Callable[[Path, Path], Path]:
    """Every so many photos of a folder."""
    def link(data: Path, folder: Path) -> Path:
        photos = folder / "photos"
        photos.mkdir(exist_ok=True)
        for photo in sorted((data / path).iterdir())[::stride]:
            if not (photos / photo.name).exists():
                (photos / photo.name).symlink_to(photo.resolve())
        return photos
    return link


def thinned(room: str, seed: int) -> Callable[[Path, Path], Path]:
    """10 to 21 frames of a room's video, 3 to 8 apart, numbered as in the video."""
    def write(data: Path, folder: Path) -> Path:
        photos = folder / "photos"
        photos.mkdir(exist_ok=True)
        video = av.open(str(data / "rooms" / room / "video.mp4"))
        images = [frame.to_ndarray(format="bgr24") for frame in video.decode(video=0)]
        draws = np.random.default_rng(seed)
        step = int(draws.integers(3, 9))
        count = min(int(draws.integers(10, 22)), len(images) // step)
        first = int(draws.integers(0, len(images) - step * count + 1))
        for index in range(first, first + step * count, step):
            cv2.imwrite(str(photos / f"{index:06d}.png"), images[index])
        return photos
    return write


def reduced(path: str, count: int, size: int) -> Callable[[Path, Path], Path]:
    """A video of `count` of a video's frames, reduced: mapping every frame would take hours."""
    def write(data: Path, folder: Path) -> Path:
        photos = folder / "photos"
        photos.mkdir(exist_ok=True)
        stream = cv2.VideoCapture(str(data / path))
        total = int(stream.get(cv2.CAP_PROP_FRAME_COUNT))
        wanted = set(np.linspace(0, total - 1, count).astype(int).tolist())
        for index in range(total):
            ok, frame = stream.read()
            if ok and index in wanted:
                scale = min(1.0, size / max(frame.shape[:2]))
                frame = cv2.resize(frame, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                cv2.imwrite(str(photos / f"{index:06d}.png"), frame)
        return photos
    return write


ROOMS = ("living", "office")


def rooms_with_one_poster(
    size: float, middles: tuple[int, int], step: int
) -> Callable[[Path, Path], Path]:
    """Frames of two rooms, numbered on, in both of which the same poster hangs, `size` metres wide.

    It hangs in the middle of one frame of each. Nothing else ties the rooms together: a mapper lays
    one poster over the other.
    """
    def write(data: Path, folder: Path) -> Path:
        photos = folder / "photos"
        photos.mkdir(exist_ok=True)
        poster = cv2.imread(str(sorted((data / "snowmiku_photos").glob("*.[jJ]*"))[0]))
        for offset, (room, middle) in enumerate(zip(ROOMS, middles, strict=True)):
            frames = data / "rooms" / room
            lens = json.loads((frames / "cam_params.json").read_text(encoding="utf-8"))["camera"]
            poses = np.loadtxt(frames / "traj.txt").reshape(-1, 4, 4)
            matrix = np.array([[lens["fx"], 0, lens["cx"]], [0, lens["fy"], lens["cy"]], [0, 0, 1]])
            corners = _poster_corners(frames, middle, poses[middle], lens, size)
            for index in range(0, len(poses), step):
                image = cv2.imread(str(frames / "results" / f"frame{index:06d}.jpg"))
                _hang(image, poster, corners, np.linalg.inv(poses[index]), matrix)
                cv2.imwrite(str(photos / f"{1000 * offset + index:06d}.png"), image)
        return photos
    return write


def _poster_corners(
    frames: Path, index: int, pose: NDArray[np.float64], lens: dict[str, float], size: float
) -> NDArray[np.float64]:  # [4, 3], clockwise from the top left
    """Where a poster hangs: before what a frame shows in its middle, towards the camera."""
    depth = cv2.imread(str(frames / "results" / f"depth{index:06d}.png"), cv2.IMREAD_UNCHANGED)
    near = np.median(depth[120:220, 200:400]) / lens["scale"] - 0.1
    half = size / 2
    local = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    return np.column_stack([local, np.full(4, near)]) @ pose[:3, :3].T + pose[:3, 3]


def _hang(
    image: NDArray[np.uint8], poster: NDArray[np.uint8], corners: NDArray[np.float64],
    world_to_camera: NDArray[np.float64], matrix: NDArray[np.float64]
) -> None:
    """Paints the poster into an image, before everything else."""
    local = corners @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    if local[:, 2].min() < 0.2:
        return
    places = local @ matrix.T
    places = (places[:, :2] / places[:, 2:]).astype(np.float32)
    height, width = 400, 400
    small = cv2.resize(poster, (width, height), interpolation=cv2.INTER_AREA)
    source = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    warp = cv2.getPerspectiveTransform(source, places)
    size = (image.shape[1], image.shape[0])
    painted = cv2.warpPerspective(small, warp, size, flags=cv2.INTER_AREA)
    inside = cv2.warpPerspective(np.full((height, width), 255, np.uint8), warp, size)
    image[inside > 127] = painted[inside > 127]


def overlay(path: str, count: int, blur: float) -> Callable[[Path, Path], Path]:
    """Frames of a video that are nearly bare, all under one text that does not move."""
    def write(data: Path, folder: Path) -> Path:
        photos = reduced(path, count, 640)(data, folder)
        draws = np.random.default_rng(0)
        for photo in sorted(photos.iterdir()):
            image = cv2.imread(str(photo))
            image = cv2.GaussianBlur(image, (0, 0), blur) // 2 + 60
            image = image + draws.normal(0, 2, image.shape)
            image = np.clip(image, 0, 255).astype(np.uint8)
            for line, text in enumerate(("CAM 04  LIVE 1080p", "Main St. entrance #27")):
                cv2.putText(image, text, (20, 40 + 30 * line), cv2.FONT_HERSHEY_SIMPLEX, 0.9,
                            (255, 255, 255), 2)
            cv2.imwrite(str(photo), image)
        return photos
    return write


def turning(data: Path, folder: Path) -> Path:
    """A camera that turns on the spot before a far, flat picture."""
    photos = folder / "photos"
    photos.mkdir(exist_ok=True)
    picture = cv2.imread(str(sorted((data / "desk_monitors").rglob("*.[jJ]*"))[0]))
    for index, image in enumerate(turn_before(picture, 40, 9.75)):
        cv2.imwrite(str(photos / f"{index:06d}.png"), image)
    return photos


CAPTURES = (
    Capture("fox", given("fox/images")),
    Capture("living", given("rooms/living/video.mp4")),
    Capture("office", given("rooms/office/video.mp4")),
    Capture("office_noisy", given("rooms/office/video_noisy.mp4")),
    Capture("living_noisy", given("rooms/living/video_noisy.mp4")),
    Capture("bedroom", given("video_bedroom/room.mp4"), frames=52, label="good"),
    Capture("trident", given("walks/trident_desk/video.mp4"), frames=80),
    Capture("redkitchen", given("walks/redkitchen/video.mp4"), frames=30, label="good"),
    Capture("house_entry", given("video_house_entry/video.mp4"), frames=80),
    Capture("tum_rpy", given("walks/tum_fr1_rpy/video.mp4"), frames=70, label="good", turning=True),
    Capture("lobby_walk", given("walks/forward_walks/lobby_walk.mp4"), label="good"),
    Capture("kitchen_walk", given("walks/forward_walks/kitchen_walk.mp4"), frames=50, label="good"),
    Capture("study_walk", given("walks/forward_walks/study_walk.mp4"), frames=50, label="good"),
    Capture("dining_walk", given("walks/forward_walks/dining_walk.mp4"), frames=50, label="good"),
    Capture("snowmiku", every("snowmiku_photos", 2), label="good"),
    Capture("desk", given("desk_monitors"), size=1000, label="good"),
    Capture("tello", every("walks/tello_lab/images", 3)),
    Capture("lockers", every("walks/club_room_lockers/images", 2), label="good"),
    Capture("corridor", every("walks/office_corridor_plants/images", 4), label="broken"),
    Capture("loop", given("walks/living_room_loop/video.mp4"), frames=90, label="good"),
    Capture("one_poster", rooms_with_one_poster(1.2, (50, 50), 2)),
    Capture("one_poster_large", rooms_with_one_poster(1.8, (80, 0), 3)),
    Capture("overlay_bare", overlay("rooms/office/video.mp4", 60, 12.0), label="broken"),
    Capture("office_faint_text", overlay("rooms/office/video.mp4", 60, 3.0), label="broken"),
    Capture("office_text", overlay("rooms/office/video.mp4", 60, 0.6)),
    Capture("turning", turning, label="broken"),
    Capture("bonsai", given("walks/bonsai/images"), features=3000, exhaustive=False, label="good"),
    *(Capture(f"{ROOMS[seed % 2]}_thin{seed}", thinned(ROOMS[seed % 2], seed), thin=True)
      for seed in THIN),
)


def quiet() -> Reporter:
    """A reporter that nobody listens to."""
    return Reporter(io.BytesIO())


def job_of(capture: Capture, folder: Path) -> MappingJob:
    """The job of a capture whose frames are chosen; its database lies in the folder."""
    frames = records.read_frame_list(folder)
    return mapping_job(
        folder, folder, max_features=capture.features, accept_weak=True,
        times={frame.name: frame.time_seconds + CLIP_SECONDS * frame.group
               for frame in frames.frames if frame.time_seconds is not None})


def prepare(capture: Capture, data: Path, out: Path) -> MappingJob:
    """Frames, features, matches and the models of a capture; quick where they are there."""
    folder = (out / capture.name).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / records.LIST).exists():
        source = capture.source(data, folder)
        config = IngestConfig(frames=capture.frames, max_size=capture.size, holdout="none")
        ctx = StageContext(threads=1, progress=NullProgress())
        ingest.run(config, StageInputs(sources=(source,)), folder, ctx)
    job = job_of(capture, folder)
    job.attempts.mkdir(exist_ok=True)
    if not (folder / "matched").exists():
        job.database.unlink(missing_ok=True)
        matching.create_database(job)
        features.extract_features(job, quiet())
        pairs = matching.exhaustive_pairs(job.names)
        if not capture.exhaustive:
            pairs = matching.sequential_pairs(job.names)
            pairs |= matching.similar_pairs(job.database, job.names, seed=0, besides=pairs)
        matching.match_pairs(job, pairs, quiet())
        (folder / "matched").touch()
    if not (folder / MODEL).exists():
        models = sorted(
            mapper.map_incrementally(job, quiet()), key=mapper.model_size, reverse=True)
        for index, model in enumerate(models):
            mapper.adjust(model)
            (folder / f"mapped{index}").mkdir(exist_ok=True)
            model.write(folder / f"mapped{index}")
        (folder / MODEL).write_text(
            json.dumps([model.num_reg_images() for model in models]), encoding="utf-8")
    return job
