"""The folder "Measure" of the control panel of one browser."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray

from recon_cli.scene.splats import Splats
from recon_cli.viewer.measure import LENGTHS, SHEETS, describe_points, find_scale, locate_click

_COLOR = (255, 60, 60)
_TYPED = "a length, typed below"
_POINT = 0.004  # of the distance to the target of the camera


class MeasurePanel:
    """Takes clicks while it is switched on; `submit` queues slow work, `splats` are shown now."""

    def __init__(
        self, client: viser.ClientHandle, splats: Callable[[], Splats], distance: float,
        metres: bool, submit: Callable[[Callable[[], None]], None],
    ) -> None:
        self._client, self._splats, self._submit = client, splats, submit
        self._size, self._scale = _POINT * distance, 1.0 if metres else None
        self._lock = threading.RLock()
        self._points: list[NDArray[np.float64]] = []
        self._lines: viser.LineSegmentsHandle | None = None
        gui = client.gui
        with gui.add_folder("Measure", expand_by_default=False):
            self._on = gui.add_checkbox("Click points", False)
            self._text = gui.add_markdown(self._describe())
            back = gui.add_button_group("Points", ("undo", "clear"))
            self._size_of = gui.add_dropdown(
                "Known size", (_TYPED, *LENGTHS, *SHEETS), hint="What the last points are the ends "
                "or corners of: sets the scale of this page.")
            self._known = gui.add_number(
                "Known length (m)", 0.0, min=0.0, step=0.001,
                hint="Of the last two points: sets the scale of this page.")
        self._on.on_update(lambda _: self._listen())
        back.on_click(lambda _: self._drop(back.value == "clear"))
        self._known.on_update(lambda _: self._set_scale())
        self._size_of.on_update(lambda _: self._set_scale())

    def _listen(self) -> None:
        self._client.scene.remove_click_callback()
        if self._on.value:
            self._client.scene.on_click()(self._on_click)

    def _on_click(self, event: viser.SceneClickEvent) -> None:
        origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
        self._submit(lambda: self.add(origin, direction))

    def add(self, origin: NDArray[np.float64], direction: NDArray[np.float64]) -> None:
        """Adds the point of the surface that a ray meets; a ray that meets nothing is told."""
        # one ray of a scene on the CPU: the portable backend needs no compiled kernels
        point = locate_click(self._splats(), origin, direction, "torch")
        if point is None:
            self._text.content = "Nothing opaque is there. " + self._describe()
            return
        with self._lock:
            self._points.append(point)
            self._refresh()

    def _drop(self, every: bool) -> None:
        with self._lock:
            self._points = [] if every else self._points[:-1]
            self._refresh()

    def _set_scale(self) -> None:
        with self._lock:
            found = find_scale(
                np.array(self._points).reshape(-1, 3), self._size_of.value, self._known.value)
            if isinstance(found, str):
                self._text.content = f"{found} {self._describe()}"
                return
            self._scale, command = found
            self._refresh()
            self._text.content += f"\n\nFor files: `{command}`"

    def _describe(self) -> str:
        return describe_points(np.array(self._points).reshape(-1, 3), self._scale)

    def _refresh(self) -> None:
        points = np.array(self._points).reshape(-1, 3)
        with self._client.atomic():
            self._text.content = self._describe()
            self._client.scene.add_point_cloud(
                "/measure/points", points, _COLOR, point_size=self._size)
            closed = np.concatenate([points, points[:1]]) if len(points) > 2 else points
            if self._lines is not None:
                self._lines.remove()
                self._lines = None
            if len(closed) > 1:
                self._lines = self._client.scene.add_line_segments(
                    "/measure/lines", np.stack([closed[:-1], closed[1:]], axis=1), _COLOR,
                    thickness=2.0, thickness_units="screen")
