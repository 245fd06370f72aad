"""`recon train --view`: shows a training in the browser at a bounded cost.

The cost of an update, up to its drawing by the browser, is measured, and the next one is due when
it has become a small share of the time since. Without a browser nothing is copied.
"""

from __future__ import annotations

import dataclasses
import logging
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import viser
from numpy.typing import NDArray

from recon_cli.context import TrainCallback, TrainReport
from recon_cli.errors import ReconError
from recon_cli.scene.camera import Camera
from recon_cli.scene.camera_paths import visible_depths
from recon_cli.scene.gravity import mean_up
from recon_cli.scene.splats import Splats
from recon_cli.viewer.content import FAR, browser_camera, move_browser, set_initial_camera
from recon_cli.viewer.gaussians import pack_splats, show_backdrop
from recon_cli.viewer.server import Server
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.summaries import WorldSummary

SHARE = 0.04  # of the training's time that updates may take
# viser's page keeps drawing for a quarter of a second after an update (RENDER_SETTLE_MS).
_SETTLE_SECONDS = 0.25
_PATIENCE_SECONDS = 30.0  # for a browser that does not answer, such as one in a hidden tab
_ECHO = "recon-echo"  # a key under which no browser stores anything

logger = logging.getLogger("recon")


class LiveView(TrainCallback):
    """Sends the Gaussians in training to all browsers of a server."""

    def __init__(self, server: Server, workspace: Workspace) -> None:
        self._server, self._workspace = server, workspace
        self._work = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recon-view")
        self._text = server.gui.add_markdown("Waiting for the training to start.")
        server.gui.add_markdown(
            "*Colours are the mean over all directions. `recon view` shows the finished scene.*")
        self._node: viser.GaussianSplatHandle | None = None
        self._label, self._until = "", 0
        self._psnr_db: float | None = None
        self._due = 0.0  # by the clock of time.perf_counter
        self._busy = False
        self._closed = False

    def on_begin(self, label: str, until: int, cameras: Sequence[Camera], splats: Splats) -> None:
        """Moves all browsers to the first training camera."""
        self._label, self._until, self._psnr_db = label, until, None
        try:
            up = self._up(cameras)
            depths = visible_depths(cameras[0], splats.means.detach().cpu().double().numpy())
            distance = float(np.median(depths)) if len(depths) else 1.0
            start = browser_camera(cameras[0], distance, FAR)
            self._server.scene.set_up_direction(up)
            show_backdrop(self._server.scene, splats)
            set_initial_camera(self._server, start)
            for client in self._server.get_clients().values() if self._node is None else ():
                move_browser(client, start, up, cameras[0])
        except Exception:  # the viewer must never end a training
            logger.debug("the browsers could not be placed", exc_info=True)

    def on_step(self, iteration: int, splats: Splats) -> None:
        """Sends the Gaussians if an update is due and a browser is connected."""
        start = time.perf_counter()
        if self._busy or start < self._due or not self._server.get_clients():
            return
        self._busy = True
        flat = dataclasses.replace(splats, sh_rest=splats.sh_rest[:0])
        copy = flat.map(lambda tensor: tensor.detach().cpu().clone())
        self._work.submit(self._send, iteration, copy, start)

    def on_report(self, report: TrainReport) -> None:
        """Keeps the PSNR for the next update."""
        self._psnr_db = report.validation_psnr_db

    def close(self) -> None:
        """Stops sending updates."""
        self._closed = True
        self._work.shutdown(wait=False, cancel_futures=True)

    def _send(self, iteration: int, splats: Splats, start: float) -> None:
        """Sends an update, waits until it is drawn, and schedules the next one."""
        try:
            self._show(iteration, splats)
            for client in self._server.get_clients().values():
                self._wait_for(client)
        except Exception:  # the viewer must never end a training
            if not self._closed:
                logger.debug("an update could not be shown", exc_info=True)
        finally:
            cost = time.perf_counter() - start + _SETTLE_SECONDS
            self._due = start + cost / SHARE
            self._busy = False

    def _show(self, iteration: int, splats: Splats) -> None:
        packed = pack_splats(splats)
        colors = packed.colors(None)
        psnr = "" if self._psnr_db is None else f", validation **{self._psnr_db:.2f} dB**"
        with self._server.atomic():
            if self._node is None:
                self._node = self._server.scene.add_gaussian_splats(
                    "/gaussians", packed.centers, packed.covariances, colors, packed.opacities,
                    scale=packed.scale)
            else:
                self._node.scale = packed.scale
                self._node.set_gaussians(
                    packed.centers, packed.covariances, colors, packed.opacities)
            self._text.content = (
                f"{self._label}: step **{iteration:,}** of {self._until:,}{psnr}, "
                f"{len(splats):,} Gaussians")
        self._server.flush()

    def _wait_for(self, client: viser.ClientHandle) -> None:
        """Waits until a browser has drawn the update: it answers between two frames."""
        for _ in range(2):
            try:
                client.local_storage.get_item(_ECHO, timeout=_PATIENCE_SECONDS)
            except (RuntimeError, TimeoutError):  # disconnected, or in a hidden tab
                return

    def _up(self, cameras: Sequence[Camera]) -> NDArray[np.float64]:
        try:
            world = WorldSummary.read(self._workspace.folder("place"))
            if world and world.evidence.up_found:
                return np.array([0.0, 0.0, 1.0])
        except (ReconError, OSError):
            pass  # the cameras give an approximate up
        return mean_up(np.stack([camera.viewmat for camera in cameras]))
