"""One browser: its own camera, model, box and colours, and the panel that sets them."""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from concurrent.futures import Executor

import numpy as np
import viser
from numpy.typing import NDArray

from recon_cli.errors import ReconError
from recon_cli.viewer.content import Content, ShownView, eye_of
from recon_cli.viewer.crop_box import Box, box_around
from recon_cli.viewer.frustums import Frustums, stand
from recon_cli.viewer.gaussians import Packed
from recon_cli.viewer.photo_pairs import Pictures

NO_VIEW = "none"
UPS = {"+z": (0, 0, 1), "-y": (0, -1, 0), "+y": (0, 1, 0), "-z": (0, 0, -1), "+x": (1, 0, 0),
       "-x": (-1, 0, 0)}  # recon's own first, then COLMAP's usual one
_REST_SECONDS = 0.25  # a camera that has not moved for so long has stopped
_MOVED = 1e-3  # of the distance to what is looked at: less changes no colour
_BOX_COLOR = (255, 170, 0)

logger = logging.getLogger("recon")


class Session:
    """What one browser is shown, from its arrival until it leaves.

    Args:
        client: the browser.
        content: what there is.
        pictures: of its views; None where there are none.
        work: does what takes long, one thing after the other.
    """

    def __init__(
        self, client: viser.ClientHandle, content: Content, pictures: Pictures | None,
        work: Executor,
    ) -> None:
        self._client, self._content, self._pictures, self._work = client, content, pictures, work
        self._lock = threading.RLock()
        self._gone = False
        self._model = next(iter(content.models))
        self._box = box_around(self._packed.splats)
        self._rows: NDArray[np.int64] = np.arange(len(self._packed.splats))
        self._seen_from: NDArray[np.float64] | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._current: ShownView | None = None
        self._frustums: Frustums | None = None  # until they are asked for: they begin hidden,
        # for who stands at a camera has those beside it before his eyes
        self._by_label = {shown.label: shown for shown in content.views}
        with client.atomic():
            self._node = self._add_gaussians()
            self._add_panel()
        if any(packed.splats.sh_degree for packed in content.models.values()):
            client.camera.on_update(self._moved)

    def leave(self) -> None:
        """Stops working for a browser that is gone."""
        self._gone = True

    @property
    def _packed(self) -> Packed:
        return self._content.models[self._model]

    def _add_gaussians(self) -> viser.GaussianSplatHandle:
        packed = self._packed
        self._seen_from = np.asarray(self._client.camera.position)
        return self._client.scene.add_gaussian_splats(
            "/gaussians", packed.centers, packed.covariances,
            packed.colors(self._seen_from.tolist()), packed.opacities, scale=packed.scale)

    def _add_panel(self) -> None:
        gui = self._client.gui
        self._count = gui.add_markdown(self._count_text())
        models = list(self._content.models)
        if len(models) > 1:
            model = gui.add_dropdown("Model", models, initial_value=self._model)
            model.on_update(lambda _: self._take_model(model.value))
        if self._content.up is None:
            up = gui.add_dropdown("Up", list(UPS), hint="The axis of the file that points up.")
            up.on_update(lambda _: self._client.scene.set_up_direction(UPS[up.value]))
        if self._pictures is not None:
            self._add_views()
        self._add_crop()
        if any(packed.splats.sh_degree for packed in self._content.models.values()):
            gui.add_markdown(
                "*Colours are those seen from where the camera last stopped: the browser draws "
                "no spherical harmonics by itself.*")

    def _add_views(self) -> None:
        gui = self._client.gui
        self._cameras = gui.add_checkbox("Cameras", False, hint="All cameras with their photos; "
                                         "held-out ones are orange. A click jumps to one.")
        self._cameras.on_update(lambda _: self._show_cameras())
        with gui.add_folder("Views"):
            self._view = gui.add_dropdown("Jump to", [NO_VIEW, *self._by_label])
            self._view.on_update(self._chosen)
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
            self._crop_text = gui.add_markdown(self._crop_words())
        self._edges = self._client.scene.add_line_segments(
            "/crop", self._box.edges(), _BOX_COLOR, thickness=2.0, thickness_units="screen",
            visible=False)
        for control in (self._crop, self._low, self._high):
            control.on_update(lambda _: self._take_box())

    def _crop_words(self) -> str:
        if not self._box.holds_something:
            return "The lowest corner is not below the highest: nothing is hidden."
        if self._pictures is None:
            return f"From `{self._box.words}` in the units of the file."
        return f"`recon export --crop {self._box.words}`"

    def _count_text(self) -> str:
        total = len(self._packed.splats)
        return f"**{len(self._rows):,}** of {total:,} Gaussians ({self._model})"

    def _take_model(self, name: str) -> None:
        with self._lock:
            self._model = name
            self._refresh()
            if self._current is not None:
                self._compare(self._current)

    def _take_box(self) -> None:
        with self._lock:
            self._box = Box.between(self._low.value, self._high.value)
            self._crop_text.content = self._crop_words()
            self._edges.points = self._box.edges()
            self._edges.visible = self._crop.value
            self._refresh()

    def _refresh(self) -> None:
        """Sends the Gaussians that are to be seen."""
        packed = self._packed
        if self._crop.value and self._box.holds_something:
            self._rows = np.nonzero(self._box.inside(packed.splats))[0]
        else:
            self._rows = np.arange(len(packed.splats))
        self._seen_from = np.asarray(self._client.camera.position)
        colors = packed.colors(self._seen_from.tolist())
        rows = self._rows
        with self._client.atomic():
            self._node.visible = len(rows) > 0
            if len(rows):
                self._node.scale = packed.scale
                self._node.set_gaussians(
                    packed.centers[rows], packed.covariances[rows], colors[rows],
                    packed.opacities[rows])
            self._count.content = self._count_text()

    async def _moved(self, _camera: viser.CameraHandle) -> None:
        """Waits until the camera rests; each movement begins the wait anew."""
        if self._timer is not None:
            self._timer.cancel()
        self._timer = asyncio.get_running_loop().call_later(
            _REST_SECONDS, lambda: self._later(self._recolor))

    def _recolor(self) -> None:
        """Colours the Gaussians for where the camera has stopped."""
        with self._lock:
            place = np.asarray(self._client.camera.position)
            far = self._seen_from is None or bool(
                np.linalg.norm(place - self._seen_from) > _MOVED * self._content.distance)
            if far and len(self._rows):
                self._seen_from = place
                self._node.rgbs = self._packed.colors(place.tolist())[self._rows]

    def _chosen(self, event: viser.GuiEvent[viser.GuiDropdownHandle[str]]) -> None:
        if event.client is not None:  # the user, and not the list that follows a jump
            self._jump_to(event.target.value)

    def _step(self, by: int) -> None:
        labels = list(self._by_label)
        at = labels.index(self._current.label) if self._current else (-1 if by > 0 else 0)
        self._jump_to(labels[(at + by) % len(labels)])

    def _show_cameras(self) -> None:
        with self._lock:
            if self._frustums is None and self._cameras.value and self._pictures is not None:
                frustums, pictures = Frustums(
                    self._client, self._content, self._jump_to), self._pictures
                self._later(lambda: frustums.fill(pictures, lambda: self._gone))
                self._frustums = frustums
            if self._frustums is not None:
                self._frustums.show(self._cameras.value)

    def _jump_to(self, label: str) -> None:
        """Puts the camera where a view was taken, and the photo into the panel.

        Hides the cameras, among which the browser then stands.
        """
        with self._lock:
            shown = self._current = self._by_label.get(label)
            if self._view.value != label:
                self._view.value = label  # type: ignore[misc]  # has a setter
            for part in (self._truth, self._ours, self._score):
                part.visible = False
            if shown is not None:
                self._cameras.value = False  # type: ignore[misc]  # has a setter
                eye = eye_of(shown.view.camera, self._content.distance, self._content.start.far)
                stand(self._client, eye, self._content.up, shown.view.camera)
                self._compare(shown)

    def _compare(self, shown: ShownView) -> None:
        """Shows a view's photo, and our render of it and its score as soon as they are there."""
        model, packed, pictures = self._model, self._packed, self._pictures
        assert pictures is not None

        def photo() -> None:
            image, _ = pictures.photo(shown.view)
            with self._lock:
                if self._current == shown:
                    self._truth.image, self._truth.visible = image, True

        def rendered() -> None:
            if (self._current, self._model) != (shown, model):
                return  # the user has gone on
            image, psnr_db = pictures.rendered(shown.view, packed.splats)
            with self._lock, self._client.atomic():
                if (self._current, self._model) == (shown, model):
                    score = "its mask leaves too little to score" if psnr_db is None else (
                        f"PSNR **{psnr_db:.2f} dB**")
                    self._score.content = f"{shown.label}, {model}: {score}"
                    self._ours.image = image
                    self._ours.visible = self._score.visible = True

        self._later(photo)
        self._later(rendered)

    def _later(self, task: Callable[[], None]) -> None:
        """Does something that takes long after what was asked for before, unless the user left."""
        def run() -> None:
            if self._gone:
                return
            try:
                task()
            except ReconError as error:
                logger.warning("%s", error.message)
                self._client.add_notification("This did not work", f"{error.message} {error.hint}")
            except Exception:
                if not self._gone:
                    logger.exception("the viewer could not do what was asked for")

        try:
            self._work.submit(run)
        except RuntimeError:  # the viewer is closing
            self._gone = True
