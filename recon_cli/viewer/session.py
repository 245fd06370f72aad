"""The session of one browser: its camera, model, crop box, colours and control panel."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np
import viser
from numpy.typing import NDArray

from recon_cli.config.stages import MODEL_LABELS
from recon_cli.errors import ReconError
from recon_cli.scene.camera import Camera
from recon_cli.scene.splats import quaternion
from recon_cli.viewer.content import (
    HELD_OUT,
    CropBox,
    LabeledView,
    PhotoPairs,
    ViewerContent,
    box_around,
    browser_camera,
    move_browser,
    vertical_fov,
)
from recon_cli.viewer.gaussians import PackedGaussians, show_backdrop
from recon_cli.viewer.keyframes import LEAST_MOVE, KeyframePanel
from recon_cli.viewer.measure_panel import MeasurePanel
from recon_cli.viewer.trust_tint import TrustTint

_FRUSTUM_SIZE = 0.03  # of the distance to the target of the camera
_HELD_OUT_COLOR, _FRUSTUM_COLOR = (255, 140, 40), (150, 170, 200)
NO_VIEW = "none"
UPS = {"+z": (0, 0, 1), "-y": (0, -1, 0), "+y": (0, 1, 0), "-z": (0, 0, -1), "+x": (1, 0, 0),
       "-x": (-1, 0, 0)}  # recon's own first, then COLMAP's usual one
_REST_SECONDS = 0.25  # a camera that has not moved for this long has stopped
_BOX_COLOR = (255, 170, 0)

logger = logging.getLogger("recon")


class Session:
    """Shows the content in one browser, from its connection until it leaves.

    `photos` are of the views and `trust` tints, both None without views; `work` runs slow tasks one
    at a time.
    """

    def __init__(
        self, client: viser.ClientHandle, content: ViewerContent, photos: PhotoPairs | None,
        work: Executor, trust: TrustTint | None = None,
    ) -> None:
        self._trust, self._tinted = trust, False
        self._client, self._content, self._photos, self._work = client, content, photos, work
        self._lock = threading.RLock()
        self._gone = False
        self._model = next(iter(content.models))
        self._box = box_around(self._packed.splats)
        self._rows: NDArray[np.int64] = np.arange(len(self._packed.splats))
        self._seen_from: NDArray[np.float64] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._current: LabeledView | None = None
        # Frustums are hidden until requested: next to a camera they block the view.
        self._frustums: Frustums | None = None
        self._by_label = {view.label: view for view in content.views}
        with client.atomic():
            self._node = self._add_gaussians()
            self._add_panel()
        if trust is not None or any(
                packed.splats.sh_degree for packed in content.models.values()):
            client.camera.on_update(self._on_move)

    def leave(self) -> None:
        """Stops working for a browser that has disconnected."""
        self._gone = True
        self._path.stop()

    @property
    def _packed(self) -> PackedGaussians:
        return self._content.models[self._model]

    def _add_gaussians(self) -> viser.GaussianSplatHandle:
        packed = self._packed
        self._seen_from = np.asarray(self._client.camera.position)
        show_backdrop(self._client.scene, packed.splats)
        return self._client.scene.add_gaussian_splats(
            "/gaussians", packed.centers, packed.covariances,
            self._colors(self._seen_from.tolist()), packed.opacities, scale=packed.scale)

    def _colors(self, position: list[float]) -> NDArray[np.uint8]:
        """Returns the colours [N, 3] as seen from a place, tinted if that is on."""
        packed = self._packed
        colors = packed.colors(position)
        if self._trust is None or not self._tinted:
            return colors
        return self._trust.colors(self._model, packed, colors, position)

    def _add_panel(self) -> None:
        gui = self._client.gui
        self._count = gui.add_markdown(self._count_text())
        if self._content.masked:
            gui.add_markdown(self._content.masked)
        models = list(self._content.models)
        if len(models) > 1:
            labels = {MODEL_LABELS.get(name, name): name for name in models}
            model = gui.add_dropdown("Model", list(labels), initial_value=self._label)
            model.on_update(lambda _: self._set_model(labels[model.value]))
        if self._content.up is None:
            up = gui.add_dropdown("Up", list(UPS), hint="The axis of the file that points up.")
            up.on_update(lambda _: self._client.scene.set_up_direction(UPS[up.value]))
        if self._photos is not None:
            self._add_views()
        if self._trust is not None:
            self._tint = gui.add_checkbox(
                "Trust", False, hint="Tints the scene by the error to expect from where you stand: "
    "blue is trusted, red is unreliable.")
            self._tint.on_update(lambda _: self._set_tint())
        self._add_crop()
        self._measure = MeasurePanel(
            self._client, lambda: self._packed.splats, self._content.distance,
            self._content.metres, self._submit)
        self._path = KeyframePanel(
            self._client, self._content.paths, self._content.distance, self._move_to)
        if any(packed.splats.sh_degree for packed in self._content.models.values()):
            gui.add_markdown(
                "*Colours are as seen from where the camera last stopped: the browser does not "
                "evaluate spherical harmonics.*")

    def _add_views(self) -> None:
        gui = self._client.gui
        self._cameras = gui.add_checkbox("Cameras", False, hint="All cameras with their photos; "
                                         "held-out ones are orange. A click jumps to one.")
        self._cameras.on_update(lambda _: self._show_cameras())
        with gui.add_folder("Views"):
            self._view = gui.add_dropdown("Jump to", [NO_VIEW, *self._by_label])
            self._view.on_update(self._on_select)
            step = gui.add_button_group("Step", ("previous", "next"))
            step.on_click(lambda _: self._step(1 if step.value == "next" else -1))
            blank = np.zeros((1, 1, 3), np.uint8)
            self._truth = gui.add_image(blank, label="Photo", visible=False)
            self._ours = gui.add_image(blank, label="Rendered by recon", visible=False)
            self._score = gui.add_markdown("", visible=False)

    def _add_crop(self) -> None:
        gui = self._client.gui
        step = float(f"{max(np.subtract(self._box.high, self._box.low)) / 200:.0e}")
        with gui.add_folder("Crop", expand_by_default=False):
            self._crop = gui.add_checkbox("Hide what is outside", False)
            self._low = gui.add_vector3("Lowest", self._box.low, step=step)
            self._high = gui.add_vector3("Highest", self._box.high, step=step)
            self._crop_text = gui.add_markdown(self._crop_text_content())
        self._edges = self._client.scene.add_line_segments(
            "/crop", self._box.edges(), _BOX_COLOR, thickness=2.0, thickness_units="screen",
            visible=False)
        for control in (self._crop, self._low, self._high):
            control.on_update(lambda _: self._set_box())

    def _crop_text_content(self) -> str:
        if not self._box.is_valid:
            return "The lowest corner is not below the highest, so nothing is hidden."
        if self._photos is None:
            return f"From `{self._box.arguments}` in the units of the file."
        return f"`recon export --crop {self._box.arguments}`"

    def _count_text(self) -> str:
        total = len(self._packed.splats)
        return f"**{len(self._rows):,}** of {total:,} Gaussians ({self._label})"

    def _set_tint(self) -> None:
        """Turns the tint on once the trust of the model is known, or off."""
        wanted, trust, model = self._tint.value, self._trust, self._model
        assert trust is not None

        def show() -> None:
            if wanted:
                trust.prepare(model)
            with self._lock:
                if self._tint.value == wanted and self._model == model:
                    self._tinted = wanted
                    self._refresh()

        self._submit(show)

    @property
    def _label(self) -> str:
        """The name of the model that is shown, for the user."""
        return MODEL_LABELS.get(self._model, self._model)

    def _set_model(self, name: str) -> None:
        with self._lock:
            self._model = name
            if self._tinted:
                self._tinted = False  # until that of the other model is known
                self._set_tint()
            self._refresh()
            if self._current is not None:
                self._compare(self._current)

    def _set_box(self) -> None:
        with self._lock:
            self._box = CropBox.between(self._low.value, self._high.value)
            self._crop_text.content = self._crop_text_content()
            self._edges.points = self._box.edges()
            self._edges.visible = self._crop.value
            self._refresh()

    def _refresh(self) -> None:
        """Sends the visible Gaussians."""
        packed = self._packed
        if self._crop.value and self._box.is_valid:
            self._rows = np.nonzero(self._box.contains(packed.splats))[0]
        else:
            self._rows = np.arange(len(packed.splats))
        self._seen_from = np.asarray(self._client.camera.position)
        colors = self._colors(self._seen_from.tolist())
        rows = self._rows
        with self._client.atomic():
            self._node.visible = len(rows) > 0
            if len(rows):
                self._node.scale = packed.scale
                self._node.set_gaussians(
                    packed.centers[rows], packed.covariances[rows], colors[rows],
                    packed.opacities[rows])
            self._count.content = self._count_text()

    async def _on_move(self, _camera: viser.CameraHandle) -> None:
        """Recolours once the camera has stopped; each movement restarts the wait."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(
            _REST_SECONDS, lambda: self._submit(self._recolor))

    def _recolor(self) -> None:
        """Colours the Gaussians as seen from the camera."""
        with self._lock:
            position = np.asarray(self._client.camera.position)
            far = self._seen_from is None or bool(
                np.linalg.norm(position - self._seen_from) > LEAST_MOVE * self._content.distance)
            if far and len(self._rows):
                self._seen_from = position
                self._node.rgbs = self._colors(position.tolist())[self._rows]

    def _on_select(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        if event.client is not None:  # the user, not the list that follows a jump
            self._jump_to(event.target.value)

    def _step(self, by: int) -> None:
        labels = list(self._by_label)
        at = labels.index(self._current.label) if self._current else (-1 if by > 0 else 0)
        self._jump_to(labels[(at + by) % len(labels)])

    def _show_cameras(self) -> None:
        with self._lock:
            if self._frustums is None and self._cameras.value and self._photos is not None:
                frustums, photos = Frustums(
                    self._client, self._content, self._jump_to), self._photos
                self._submit(lambda: frustums.add_photos(photos, lambda: self._gone))
                self._frustums = frustums
            if self._frustums is not None:
                self._frustums.parent.visible = self._cameras.value

    def _jump_to(self, label: str) -> None:
        """Moves the camera to a view, hides the frustums and shows the view's photo."""
        self._path.stop()
        with self._lock:
            view = self._current = self._by_label.get(label)
            if self._view.value != label:
                self._view.value = label  # type: ignore[misc]  # has a setter
            for part in (self._truth, self._ours, self._score):
                part.visible = False
            if view is not None:
                self._cameras.value = False  # type: ignore[misc]  # has a setter
                self._move_to(view.view.camera)
                self._compare(view)

    def _move_to(self, camera: Camera) -> None:
        content = self._content
        target = browser_camera(camera, content.distance, content.start.far)
        move_browser(self._client, target, content.up, camera)

    def _compare(self, view: LabeledView) -> None:
        """Shows a view's photo, then recon's render of it and its score."""
        model, packed, photos = self._model, self._packed, self._photos
        assert photos is not None

        def show_photo() -> None:
            image, _ = photos.load_photo(view.view)
            with self._lock:
                if self._current == view:
                    self._truth.image, self._truth.visible = image, True

        def show_render() -> None:
            if (self._current, self._model) != (view, model):
                return  # the user has moved on
            image, psnr_db = photos.render_view(view.view, packed.splats)
            with self._lock, self._client.atomic():
                if (self._current, self._model) == (view, model):
                    score = "its mask leaves too little to score" if psnr_db is None else (
                        f"PSNR **{psnr_db:.2f} dB**")
                    self._score.content = (
                        f"{view.label}, {MODEL_LABELS.get(model, model)}: {score}")
                    self._ours.image = image
                    self._ours.visible = self._score.visible = True

        self._submit(show_photo)
        self._submit(show_render)

    def _submit(self, task: Callable[[], None]) -> None:
        """Queues a slow task, which is dropped if the user has left by then."""
        def run() -> None:
            if self._gone:
                return
            try:
                task()
            except ReconError as error:
                logger.warning("%s", error.message)
                self._client.add_notification("Error", f"{error.message} {error.hint}")
            except Exception:
                if not self._gone:
                    logger.exception("a task of the viewer failed")

        try:
            self._work.submit(run)
        except RuntimeError:  # the viewer is closing
            self._gone = True


class Frustums:
    """The cameras of all views in one browser.

    `jump` is called with the label of the view whose camera was clicked.
    """

    def __init__(
        self, client: viser.ClientHandle, content: ViewerContent, jump: Callable[[str], None]
    ) -> None:
        self._client, self._content, self._jump = client, content, jump
        self.parent = client.scene.add_frame("/cameras", show_axes=False)  # shows or hides all
        with client.atomic():
            self._handles = {
                view.label: self._add(number, view) for number, view in enumerate(content.views)}

    def _add(self, number: int, view: LabeledView) -> viser.CameraFrustumHandle:
        camera = view.view.camera
        handle = self._client.scene.add_camera_frustum(
            f"/cameras/{number}", vertical_fov(camera), camera.width / camera.height,
            scale=_FRUSTUM_SIZE * self._content.distance, thickness=1.5, thickness_units="screen",
            color=_HELD_OUT_COLOR if view.part == HELD_OUT else _FRUSTUM_COLOR,
            wxyz=quaternion(camera.viewmat[:3, :3].T), position=camera.center,
            cast_shadow=False, receive_shadow=False)
        handle.on_click(lambda _: self._jump(view.label))
        return handle

    def add_photos(self, photos: PhotoPairs, stopped: Callable[[], bool]) -> None:
        """Shows the photos in the frustums, until `stopped` returns True."""
        for view in self._content.views:
            if stopped():
                return
            self._handles[view.label].image = photos.thumbnail(view.view)
