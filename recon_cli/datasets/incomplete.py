"""Captures of apps that lack the file of their poses: refused, rather than read as mere photos.

A row says what shows the app, and which file is missing then. Whoever wants the pictures alone is
told what to type.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Traces:
    """Files of a capture, as patterns below its folder."""

    app: str
    marks: tuple[str, ...]  # all of them show the app
    lacks: tuple[str, ...]  # one of which it needs
    pictures: str  # what to give to find the cameras from the pictures


ROWS: tuple[Traces, ...] = (
    Traces("Polycam", ("keyframes/images", "keyframes/depth"),
           ("keyframes/cameras", "keyframes/corrected_cameras"), "keyframes/images"),
    Traces("Polycam", ("keyframes/corrected_images",),
           ("keyframes/cameras", "keyframes/corrected_cameras"), "keyframes/corrected_images"),
    Traces("Record3D", ("rgbd/*.depth",), ("metadata",), "rgbd"),
    Traces("Record3D", ("rgb", "depth/*.exr"), ("metadata.json",), "rgb"),
    Traces("Record3D", ("EXR_RGBD/rgb", "EXR_RGBD/depth/*.exr"), ("EXR_RGBD/metadata.json",),
           "EXR_RGBD/rgb"),
    Traces("Stray Scanner", ("rgb.mp4", "confidence/*.png"), ("odometry.csv",), "rgb.mp4"),
    Traces("Stray Scanner", ("rgb.mp4", "camera_matrix.csv"), ("odometry.csv",), "rgb.mp4"),
    Traces("Stray Scanner", ("odometry.csv", "camera_matrix.csv"), ("rgb.mp4",), ""),
    Traces("NeRFCapture", ("images/*.depth.png",), ("transforms.json",), "images"),
    Traces("3D Scanner App", ("frame_*.jpg", "depth_*.png", "conf_*.png"), ("frame_*.json",),
           "frame_*.jpg"),
    Traces("ARKitScenes", ("lowres_wide", "lowres_depth"), ("lowres_wide.traj",), "lowres_wide"),
    Traces("ARKitScenes", ("*_frames/lowres_wide", "*_frames/lowres_depth"),
           ("*_frames/lowres_wide.traj",), "*_frames/lowres_wide"),
    Traces("RTAB-Map", ("*_rgb", "*_calib/*.yaml"), ("*_poses*.txt",), "*_rgb"),
    Traces("a Quest headset", ("*_camera_mruk_rgba",), ("*_camera_mruk_frame_metadata.csv",), ""),
)


def find_incomplete(folder: Path) -> tuple[str, Sequence[Path]] | None:
    """Returns what a folder lacks, in words, and its pictures, which may be none; else None."""
    if not folder.is_dir():
        return None
    for row in ROWS:
        if all(_any(folder, mark) for mark in row.marks) and not any(
                _any(folder, name) for name in row.lacks):
            pictures = sorted(folder.glob(row.pictures)) if row.pictures else []
            if len(pictures) > 1:  # of files, as a shell takes them
                pictures = [folder / row.pictures]
            return f"a capture of {row.app} without {' or '.join(row.lacks)}", pictures
    return None


def _any(folder: Path, pattern: str) -> bool:
    return next(folder.glob(pattern), None) is not None
