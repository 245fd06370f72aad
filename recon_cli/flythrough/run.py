"""Renders the frames of a request into a folder and encodes videos of them.

Its render.json records the settings. Frames are written atomically: those of the same settings are
kept, so an interrupted run continues; with other settings all are rendered again.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from recon_cli.context import StageContext
from recon_cli.errors import (
    ConfigError,
    FormatError,
    WorkspaceError,
    format_count,
    list_names,
    name_command,
)
from recon_cli.flythrough.camera_path import write_camera_path
from recon_cli.flythrough.camera_plan import CameraPlan, check_frame_memory, plan_cameras
from recon_cli.flythrough.model_trust import load_trust
from recon_cli.flythrough.output import (
    FOLDERS,
    VIDEO_FRAMES,
    DepthScale,
    VideoEncoding,
    check_encoding,
    depth_scale,
    encode_video,
    write_frame,
    write_picture,
)
from recon_cli.flythrough.panorama import join_faces, render_panorama
from recon_cli.flythrough.request import DEPTH, TRUST, VIDEOS, RenderRequest
from recon_cli.flythrough.trained_scene import TrainedScene, open_trained_scene
from recon_cli.io.images import is_whole_png
from recon_cli.pipeline.execute import Job, render_context
from recon_cli.progress import format_megabytes
from recon_cli.render import render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.trust.scene_trust import Trust
from recon_cli.workspace import layout
from recon_cli.workspace.atomic import (
    LEFTOVERS,
    clear_leftovers,
    read_json,
    write_json,
)
from recon_cli.workspace.json_record import sha256_json
from recon_cli.workspace.layout import HOLDER, LOCK, disk_errors
from recon_cli.workspace.steps import StepFolder

RECORD = "render.json"
PATH = "camera_path.json"
_SCHEMA = 1  # goes up when a frame changes meaning

logger = logging.getLogger("recon")


class FrameFolder:
    """The frames in one folder, and the record of their settings.

    `names` are the stems of all frames, in order; `outputs` are of rgb, depth, alpha, trust.
    """

    def __init__(self, root: Path, names: Sequence[str], outputs: Sequence[str]) -> None:
        self.root, self.names, self.outputs = root, tuple(names), tuple(outputs)
        self._steps = StepFolder(root)
        self._folders = [folder for output in outputs for folder in FOLDERS[output]]

    def prepare(self, settings: Mapping[str, Any], about: Mapping[str, Any]) -> tuple[str, ...]:
        """Prepares the folder for these settings and returns which frames are missing.

        `settings` are JSON values of all that decides a frame, `about` more of them for
        readers of the record. FormatError if the record of an earlier run is damaged.
        """
        settings = {"schema": _SCHEMA, **settings}
        before = self.read_record()
        if before is not None and before["digest"] != sha256_json(settings):
            changed = sorted(key for key in {*settings, *before["settings"]}
                             if settings.get(key) != before["settings"].get(key))
            logger.warning("%s: all frames are rendered again, because settings changed: %s",
                           self.root, ", ".join(changed) or "its record was edited by hand")
            self._clear()
            before = None
        clear_leftovers(self.root)
        missing = tuple(name for name in self.names if not all(
            is_whole_png(self.frame_path(folder, name)) for folder in self._folders))
        self._steps = StepFolder(self.root, key=sha256_json(settings))
        self._steps.forget(*(name for name in self._pictures if Path(name).stem in missing))
        if changed := list(self._steps.list_damage()):
            logger.warning("%s: kept, though not as they were rendered (delete them to render them "
                           "again): %s", self.root, list_names(changed))
        video = before["video"] if before and not missing else None
        write_json(self.root / RECORD, {
            "digest": sha256_json(settings), "settings": settings, "frames": len(self.names),
            **about, "video": video})
        for folder in self._folders:
            (self.root / folder).mkdir(exist_ok=True)
        return missing

    def record_pictures(self) -> None:
        """Records the digest of every picture that has none yet."""
        known = set(self._steps.steps)
        for name in self._pictures:
            if name not in known:
                self._steps.finish(name, paths=[self.root / name])

    @property
    def _pictures(self) -> list[str]:
        """The paths of all pictures, relative to the folder."""
        return [self.frame_path(folder, name).relative_to(self.root).as_posix()
                for folder in self._folders for name in self.names]

    def frame_path(self, folder: str, name: str) -> Path:
        """Returns the path of a frame's picture in one of the folders."""
        return self.root / folder / f"{name}.png"

    def record_video(self, encoding: dict[str, Any]) -> None:
        """Adds the encoding of the finished video of these frames to the record."""
        write_json(self.root / RECORD, {**(self.read_record() or {}), "video": encoding})

    def read_record(self) -> dict[str, Any] | None:
        """Returns the record of an earlier run; None in a new folder."""
        path = self.root / RECORD
        if not path.exists():
            return None
        record = read_json(path, hint=f"Delete {self.root}.")
        if not isinstance(record, dict) or not isinstance(record.get("settings"), dict) or not (
                {"digest", "video"} <= record.keys()):
            raise FormatError(
                f"{path} is not a record of recon render.", hint=f"Delete {self.root}.")
        return record

    def _clear(self) -> None:
        """Removes the files of an earlier run; its record stays until there is a new one."""
        for folder in {folder for folders in FOLDERS.values() for folder in folders}:
            if (self.root / folder).is_symlink():  # it may lead anywhere
                (self.root / folder).unlink()
            for picture in (self.root / folder).glob("*.png"):
                picture.unlink()
        videos = [self.root / f"{output}.{form}" for output in FOLDERS for form in VIDEOS]
        for path in (*videos, self.root / PATH):
            path.unlink(missing_ok=True)


def render_frames(request: RenderRequest, job: Job) -> str:
    """Renders the missing frames of a request and describes the files written.

    StageError without a fresh model, ConfigError for a size, view or codec that cannot be used,
    FormatError for a damaged file, WorkspaceError for a folder that cannot be used.
    """
    with disk_errors(job.workspace.root, "reading the model"):
        trained = open_trained_scene(job, request.model)
        if trained.frames is not None:
            request = replace(request, views=trained.frames.find(request.views))
    plan = plan_cameras(request, trained)
    encoding = _check(request, plan)
    ctx = render_context(job.compute, job.progress)
    trust = load_trust(job, trained, ctx) if TRUST in request.outputs else None
    folder = _make_folders(request, plan, job.workspace.root)
    with disk_errors(folder, "rendering"), layout.hold_lock(
            folder, "render", other="another folder with --out"):
        frames = FrameFolder(folder, list(plan.cameras), request.outputs)
        scale = depth_scale(trained.scene, metres=trained.metres)
        missing = frames.prepare(
            _frame_settings(request, plan, trained, scale) | (
                {} if trust is None else {"trust": trust.describe_pictures()}),
            {"device": ctx.device, "backend": ctx.backend})
        if plan.path is not None:
            write_camera_path(folder / PATH, plan.path)
        _render_missing(frames, missing, request, plan, trained, scale, trust, ctx)
        frames.record_pictures()
        files = _encode_videos(frames, encoding, ctx) if encoding else []
    if request.out_file is not None:
        with disk_errors(request.out_file.absolute().parent, f"writing {request.out_file.name}"):
            write_picture(files[0] if files else frames.frame_path(
                VIDEO_FRAMES[frames.outputs[0]], frames.names[0]), request.out_file)
        files = [request.out_file]
    if request.out_file is not None:
        logger.info("%s of frames stay in %s to continue from; %s frees them",
                    format_megabytes(layout.size_of(frames.root)), frames.root,
                    name_command("clean --renders"))
    return "\n".join([
        f"{format_count(len(frames.names), 'frame')} in {frames.root}, {len(missing)} of them "
        "rendered now", *map(str, files)])


def _check(request: RenderRequest, plan: CameraPlan) -> VideoEncoding | None:
    """Returns the encoding of the video, if there is one, once the request is known to work."""
    largest = max(plan.cameras.values(), key=lambda camera: camera.width * camera.height)
    check_frame_memory(largest.width, largest.height)
    if request.out_file is not None and not request.video and len(plan.cameras) > 1:
        raise ConfigError(
            f"{request.out_file} is one picture, but there are {len(plan.cameras)} frames.",
            hint="Give a folder with --out, or one view with --views.")
    if not request.video or plan.path is None:
        return None
    codec, crf = request.quality
    encoding = VideoEncoding(
        codec, crf, largest.width, largest.height, plan.path.fps or 1.0, request.video)
    check_encoding(encoding)
    return encoding


def _make_folders(request: RenderRequest, plan: CameraPlan, workspace: Path) -> Path:
    """Returns the folder of the frames; it and the folder of --out exist afterwards."""
    folder = workspace / layout.RENDERS / f"{plan.name}-{'-'.join(request.outputs)}"
    if request.out is not None and request.out_file is None:
        folder = request.out.absolute()
    layout.make_folder(folder)
    others = {path.name for path in folder.iterdir() if not path.match(LEFTOVERS)} - {LOCK, HOLDER}
    if others and RECORD not in others:
        raise WorkspaceError(
            f"{folder} is not empty: it holds {min(others)}, but no {RECORD}, so recon did not "
            "create it.", hint="Give a new or an empty folder with --out.")
    if request.out_file is not None:
        layout.make_folder(request.out_file.absolute().parent)
        if request.out_file.is_dir():
            raise WorkspaceError(
                f"{request.out_file} is a folder, but a file is to be written there.",
                hint="Give another file with --out.")
    return folder


def _frame_settings(
    request: RenderRequest, plan: CameraPlan, trained: TrainedScene, scale: DepthScale
) -> dict[str, Any]:
    """Returns everything that decides the pixels of a frame, as JSON values."""
    cameras = plan.cameras
    return {
        **({"panorama": True} if request.panorama else {}),
        "model": trained.model, "gaussians": trained.digest, "sh_degree": trained.config.sh_degree,
        "outputs": list(request.outputs), "background": list(request.background or ()) or "own",
        "sizes": [list(size) for size in sorted(
            {(camera.width, camera.height) for camera in cameras.values()})],
        "cameras": sha256_json({
            name: [camera.fx, camera.fy, camera.cx, camera.cy, camera.viewmat.tolist()]
            for name, camera in cameras.items()}),
        "depth": scale.describe_pictures() if DEPTH in request.outputs else None,
    }


def _render_missing(
    frames: FrameFolder, missing: Sequence[str], request: RenderRequest, plan: CameraPlan,
    trained: TrainedScene, scale: DepthScale, trust: Trust | None, ctx: StageContext,
) -> None:
    splats = trained.splats.map(lambda tensor: tensor.to(ctx.device))
    background = splats.background if request.background is None else (
        torch.tensor(request.background, device=ctx.device) / 255)
    surfaces = scale.select_surfaces(splats) if DEPTH in request.outputs else splats
    draw = render_panorama if request.panorama else render
    total = len(frames.names)
    with torch.no_grad(), ctx.progress.bar(
            "render", total, unit="frame", done=total - len(missing)) as bar:
        for name in missing:
            camera, degree = plan.cameras[name], trained.config.sh_degree
            output = draw(splats, camera, background, degree, backend=ctx.backend)
            for_depth = output if surfaces is splats else draw(
                surfaces, camera, background, degree, backend=ctx.backend)
            expected = None if trust is None else _expect(
                trust, splats, camera, ctx.backend, panorama=request.panorama)
            write_frame(frames.root, name, output, for_depth, request.outputs, scale, expected)
            bar.advance()


def _expect(
    trust: Trust, splats: Splats, camera: Camera, backend: str, *, panorama: bool
) -> NDArray[np.float32]:
    """Returns the expected error of a frame, [H, W]."""
    if not panorama:
        return trust.expected_error(splats, camera, backend)
    return join_faces(camera, lambda face: trust.expected_error(splats, face, backend))


def _encode_videos(frames: FrameFolder, encoding: VideoEncoding, ctx: StageContext) -> list[Path]:
    """Returns one video an output, encoded again unless frames and settings are the same."""
    videos = {output: frames.root / f"{output}.{encoding.form}" for output in frames.outputs}
    record = frames.read_record()
    if record and record["video"] == asdict(encoding) and all(
            path.is_file() for path in videos.values()):
        return list(videos.values())
    with ctx.progress.bar("encode", len(videos) * len(frames.names), unit="frame") as bar:
        for output, path in videos.items():
            pictures = [frames.frame_path(VIDEO_FRAMES[output], name) for name in frames.names]
            encode_video(pictures, path, encoding, threads=ctx.threads, on_frame=bar.advance)
    frames.record_video(asdict(encoding))
    return list(videos.values())
