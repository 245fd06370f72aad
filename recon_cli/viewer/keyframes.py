"""The folder "Camera path" of the panel: keyframes, a preview, a file for `recon render`."""

from __future__ import annotations

import shlex
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray
from viser.transforms import SO3

from recon_cli.errors import ReconError, WorkspaceError
from recon_cli.flythrough.camera_path import CameraPath, write_camera_path
from recon_cli.flythrough.request import FPS
from recon_cli.scene.camera import Camera
from recon_cli.scene.camera_paths import keyframe_path

SIZE = (1280, 720)  # of the file, where there is no capture whose shape it could have
_PREVIEW_FPS = 20.0  # browsers move smoothly, and a slow connection keeps up
_SECONDS = 4.0  # from keyframe to keyframe, at first
LEAST_MOVE = 1e-3  # of the distance to the target, and radians: nearer keyframes are the same
_FILES = 999  # paths in one folder, at most
_COLOR = (255, 200, 60)


@dataclass(frozen=True)
class PathFolder:
    """Where paths are saved, and the command that renders one."""

    folder: Path
    workspace: Path | None  # None for a splat file, which `recon render` does not take
    size: tuple[int, int] = SIZE  # width and height of the frames

    def save(self, path: CameraPath) -> str:
        """Writes a path into the first free file and returns what to do with it, in Markdown.

        WorkspaceError if it cannot be written.
        """
        for number in range(1, _FILES + 1):
            file = self.folder / f"path-{number}.json"
            if not file.exists():
                break
        else:
            raise WorkspaceError(
                f"{self.folder} holds {_FILES} paths.", hint="Delete those that you do not need.")
        try:
            write_camera_path(file, path)
        except OSError as error:
            raise WorkspaceError(f"{file} cannot be written: {error.strerror}.",
                                 hint="Check the folder and the space that is left.") from error
        if self.workspace is None:
            return f"Saved: `{file}`. Programs that read nerfstudio's paths take it."
        words = ["recon", "render", "-w", str(self.workspace), "--path", str(file), "--out",
                 f"{file.stem}.mp4"]
        return f"Saved. For the video: `{shlex.join(words)}`"


class KeyframePanel:
    """Keeps the keyframes of one browser.

    `move` puts the browser's camera where a camera is.
    """

    def __init__(
        self, client: viser.ClientHandle, folder: PathFolder, distance: float,
        move: Callable[[Camera], None],
    ) -> None:
        self._client, self._folder, self._distance = client, folder, distance
        self._move = move
        self._lock = threading.RLock()
        self._viewmats: list[NDArray[np.float64]] = []
        self._fovs_deg: list[float] = []
        self._line: viser.LineSegmentsHandle | None = None
        self._stop = threading.Event()
        self._playing: threading.Thread | None = None
        gui = client.gui
        with gui.add_folder("Camera path", expand_by_default=False):
            edit = gui.add_button_group("Keyframe", ("add", "remove last"))
            self._seconds = gui.add_number(
                "Seconds", _SECONDS, min=0.5, max=600.0, step=0.5,
                hint="Of the whole path, which has the same speed everywhere.")
            use = gui.add_button_group("Path", ("preview", "save"))
            self._text = gui.add_markdown(self._describe())
        edit.on_click(lambda _: self._add() if edit.value == "add" else self._remove())
        use.on_click(lambda _: self._preview() if use.value == "preview" else self._save())

    def stop(self) -> None:
        """Ends a preview and waits for it."""
        self._stop.set()
        playing = self._playing
        if playing is not None and playing is not threading.current_thread():
            playing.join(timeout=2.0)

    def _add(self) -> None:
        """Adds the camera as it is now."""
        camera = self._client.camera
        viewmat, fov = np.eye(4), float(np.degrees(camera.fov))
        viewmat[:3, :3] = SO3(camera.wxyz).as_matrix().T
        viewmat[:3, 3] = -viewmat[:3, :3] @ camera.position
        with self._lock:
            if self._viewmats and np.allclose(
                    self._scaled(viewmat), self._scaled(self._viewmats[-1]), atol=LEAST_MOVE):
                self._text.content = "Move the camera first: it is where the last keyframe is."
                return
            self._viewmats.append(viewmat)
            self._fovs_deg.append(fov)
            if len(self._viewmats) > 2:
                self._seconds.value += _SECONDS  # type: ignore[misc]  # has a setter
            self._refresh()

    def _scaled(self, viewmat: NDArray[np.float64]) -> NDArray[np.float64]:
        """Returns a pose in units of the distance to what is seen."""
        return np.asarray(viewmat / np.array([1.0, 1.0, 1.0, self._distance]))

    def _remove(self) -> None:
        with self._lock:
            del self._viewmats[-1:], self._fovs_deg[-1:]
            self._refresh()

    def _describe(self) -> str:
        count = len(self._viewmats)
        if not count:
            return "Go to a place and add it; do so again. The path leads smoothly through all."
        return f"**{count}** keyframe{'s' * (count > 1)}{'; add another' * (count == 1)}"

    def _refresh(self) -> None:
        """Draws the path and says how many keyframes it has."""
        self._text.content = self._describe()
        if self._line is not None:
            self._line.remove()
            self._line = None
        if len(self._viewmats) > 1:
            rows = np.stack([camera.center for camera in self._make(
                16 * len(self._viewmats)).cameras()]).astype(np.float32)
            self._line = self._client.scene.add_line_segments(
                "/path", np.stack([rows[:-1], rows[1:]], axis=1), _COLOR, thickness=2.0,
                thickness_units="screen")

    def _make(self, count: int, fps: float = FPS) -> CameraPath:
        viewmats, fovs = keyframe_path(
            np.stack(self._viewmats), np.array(self._fovs_deg), count)
        return CameraPath(viewmats, fovs, *self._folder.size, fps)

    def _ready(self) -> bool:
        if len(self._viewmats) < 2:
            self._text.content = "A path needs two keyframes or more."
        return len(self._viewmats) > 1

    def _preview(self) -> None:
        """Plays the path in the browser; a second click ends it."""
        with self._lock:
            if self._playing is not None and self._playing.is_alive():
                self._stop.set()
                return
            if not self._ready():
                return
            path = self._make(max(2, round(self._seconds.value * _PREVIEW_FPS)), _PREVIEW_FPS)
            self._stop.clear()
            self._playing = threading.Thread(
                target=self._play, args=(path,), name="recon-preview", daemon=True)
            self._playing.start()

    def _play(self, path: CameraPath) -> None:
        if self._line is not None:
            self._line.visible = False
        start, cameras = time.monotonic(), path.cameras()
        while not self._stop.is_set():
            # by the clock, so that a browser that is slow sees fewer frames and not a slower path
            at = round((time.monotonic() - start) * _PREVIEW_FPS)
            self._move(cameras[min(at, len(cameras) - 1)])
            if at >= len(cameras) - 1:
                break
            self._stop.wait(1 / _PREVIEW_FPS)
        with self._lock:
            if self._line is not None and not self._stop.is_set():
                self._line.visible = True

    def _save(self) -> None:
        with self._lock:
            if not self._ready():
                return
            path = self._make(max(2, round(self._seconds.value * FPS)))
            try:
                self._text.content = self._folder.save(path)
            except ReconError as error:
                self._text.content = f"{error.message} {error.hint}"
