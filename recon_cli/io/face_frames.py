"""Which undistorted views are faces of which frame: faces.json beside them, where there are any."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from recon_cli.errors import FormatError, Hint
from recon_cli.workspace.atomic import read_json, write_json

FILE = "faces.json"
_HINT = Hint("sfm", again=True)


def write_face_frames(undistorted: Path, frames: Mapping[str, str]) -> None:
    """Writes the names of frames by those of their faces into a folder of undistorted views."""
    write_json(undistorted / FILE, dict(frames))


def read_face_frames(undistorted: Path) -> dict[str, str]:
    """Returns the names of frames by those of their faces; empty where no view is a face.

    FormatError if the file is damaged.
    """
    path = undistorted / FILE
    if not path.exists():
        return {}
    frames: dict[str, str] = read_json(path, dict, hint=_HINT)
    if not all(isinstance(frame, str) for frame in frames.values()):
        raise FormatError(f"{path} does not name frames.", hint=_HINT)
    return frames
