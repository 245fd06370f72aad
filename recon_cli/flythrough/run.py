"""From a request to pictures and videos: what is there already is not rendered again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from recon_cli.context import StageContext
from recon_cli.errors import ConfigError, WorkspaceError
from recon_cli.flythrough.camera_path import write_camera_path
from recon_cli.flythrough.frames import PATH, Frames, refuse_foreign
from recon_cli.flythrough.images import (
    SHOWN,
    DepthScale,
    depth_scale,
    refuse_what_does_not_fit,
    write_pictures,
)
from recon_cli.flythrough.plan import Plan, plan
from recon_cli.flythrough.request import DEPTH, Request
from recon_cli.flythrough.source import Source, open_source
from recon_cli.flythrough.video import Encoding, encode, refuse_what_cannot_be_encoded
from recon_cli.pipeline.execute import Job, rendering
from recon_cli.render import RenderOutput, render
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import Splats
from recon_cli.workspace import lock
from recon_cli.workspace.atomic import write_bytes
from recon_cli.workspace.digests import sha256_json
from recon_cli.workspace.layout import disk_errors

FOLDER = "render"  # in the workspace


def run(request: Request, job: Job) -> str:
    """Renders what is missing of a request and returns what was made, in words.

    Raises:
        StageError: the workspace holds no trained model that is fresh.
        ConfigError: a size, a view or a codec cannot be had.
        FormatError: a file cannot be read.
        WorkspaceError: the folder is in use, full, not writable, or holds files of others.
    """
    with disk_errors(job.workspace.root, "reading the model"):
        source = open_source(job, request.model)
    asked = plan(request, source)
    encoding = _checked(request, asked)
    ctx = rendering(job.compute, job.progress)
    folder = _folder(request, asked, job.workspace.root)
    with disk_errors(folder, "rendering"), lock.held(
            folder, "render", other="another folder with --out"):
        frames = Frames(folder, list(asked.cameras), request.outputs)
        scale = depth_scale(source.scene, metres=source.metres)
        missing = frames.begin(
            _settings(request, asked, source, scale),
            {"device": ctx.device, "backend": ctx.backend})
        if asked.path is not None:
            write_camera_path(folder / PATH, asked.path)
        _render(frames, missing, request, asked, source, scale, ctx)
        made = _encode(frames, encoding, request, ctx) if encoding else []
    if request.out_file is not None:
        made = [_delivered(request.out_file, made, frames)]
    return _told(frames, len(missing), made)


def _checked(request: Request, asked: Plan) -> Encoding | None:
    """Returns how the frames are to be encoded, if they are, once all of it can be done."""
    largest = max(asked.cameras.values(), key=lambda camera: camera.width * camera.height)
    refuse_what_does_not_fit(largest.width, largest.height)
    if request.out_file is not None and not request.video and len(asked.cameras) > 1:
        raise ConfigError(
            f"{request.out_file} is one picture, but there are {len(asked.cameras)} frames.",
            hint="Give a folder with --out, or one view with --views.")
    if not request.video or asked.path is None:
        return None
    codec, crf = request.quality
    encoding = Encoding(codec, crf, largest.width, largest.height, asked.path.fps or 1.0)
    refuse_what_cannot_be_encoded(encoding)
    return encoding


def _folder(request: Request, asked: Plan, workspace: Path) -> Path:
    """Returns the folder of the frames, made where it was not there."""
    folder = workspace / FOLDER / f"{asked.name}-{'-'.join(request.outputs)}"
    if request.out is not None and request.out_file is None:
        folder = request.out.absolute()
    _make(folder)
    refuse_foreign(folder)
    if request.out_file is not None:
        _make(request.out_file.absolute().parent)
        if request.out_file.is_dir():
            raise WorkspaceError(
                f"{request.out_file} is a folder, but a file is to be written there.",
                hint="Give another file with --out.")
    return folder


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise WorkspaceError(
            f"The folder {folder} cannot be made: {error.strerror}.",
            hint="Give another one with --out.") from error


def _settings(
    request: Request, asked: Plan, source: Source, scale: DepthScale
) -> dict[str, Any]:
    """Returns everything that decides what a frame shows, as JSON values."""
    cameras = asked.cameras
    return {
        "model": source.model, "gaussians": source.digest, "sh_degree": source.sh_degree,
        "outputs": list(request.outputs), "background": list(request.background),
        "sizes": [list(size) for size in sorted(
            {(camera.width, camera.height) for camera in cameras.values()})],
        "cameras": sha256_json({
            name: [camera.fx, camera.fy, camera.cx, camera.cy, camera.viewmat.tolist()]
            for name, camera in cameras.items()}),
        "depth": scale.to_json() if DEPTH in request.outputs else None,
    }


def _render(
    frames: Frames, missing: Sequence[str], request: Request, asked: Plan, source: Source,
    scale: DepthScale, ctx: StageContext,
) -> None:
    splats = source.splats.map(lambda tensor: tensor.to(ctx.device))
    background = torch.tensor(request.background, device=ctx.device) / 255
    near = scale.surfaces(splats) if DEPTH in request.outputs else splats
    total = len(frames.names)
    with torch.no_grad(), ctx.progress.bar(
            "render", total, unit="frame", done=total - len(missing)) as bar:
        for name in missing:
            def rendered(what: Splats, camera: Camera = asked.cameras[name]) -> RenderOutput:
                return render(what, camera, background, source.sh_degree, backend=ctx.backend)

            shown = rendered(splats)
            surfaces = shown if near is splats else rendered(near)
            write_pictures(frames.root, name, shown, surfaces, request.outputs, scale)
            bar.advance()


def _encode(
    frames: Frames, encoding: Encoding, request: Request, ctx: StageContext
) -> list[Path]:
    """Returns the videos, made anew unless they are those of these frames and settings."""
    videos = {output: frames.root / f"{output}.mp4" for output in request.outputs}
    if frames.video == asdict(encoding) and all(path.is_file() for path in videos.values()):
        return list(videos.values())
    with ctx.progress.bar("encode", len(videos) * len(frames.names), unit="frame") as bar:
        for output, path in videos.items():
            pictures = [frames.picture(SHOWN[output], name) for name in frames.names]
            encode(pictures, path, encoding, threads=ctx.threads, on_frame=bar.advance)
    frames.video = asdict(encoding)
    return list(videos.values())


def _delivered(file: Path, videos: Sequence[Path], frames: Frames) -> Path:
    """Copies the one video or picture to where it was asked for."""
    with disk_errors(file.absolute().parent, f"writing {file.name}"):
        made = videos[0] if videos else frames.picture(frames.outputs[0], frames.names[0])
        write_bytes(file, made.read_bytes())
    return file


def _told(frames: Frames, rendered: int, made: Sequence[Path]) -> str:
    total = len(frames.names)
    lines = [f"{total} frame{'s' * (total != 1)} in {frames.root}, {rendered} of them rendered now"]
    return "\n".join([*lines, *map(str, made)])
