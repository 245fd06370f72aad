"""`recon train --view`: a training that is looked at, for next to none of its time.

An update costs the moment of copying, the packing and sending in another thread, and what a browser
on the same machine takes to draw it. All of that is waited for and measured, and the next update
comes when it has become a small share of the time since: whatever an update costs, its share of the
training's time is bounded. Without a browser nothing is copied.
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

from recon_cli.errors import ReconError
from recon_cli.flythrough.smooth import depths_seen
from recon_cli.scene.camera import Camera
from recon_cli.scene.gravity import MIN_CAMERAS, camera_up
from recon_cli.scene.splats import Splats
from recon_cli.viewer.content import FAR, eye_of
from recon_cli.viewer.frustums import stand
from recon_cli.viewer.gaussians import packed
from recon_cli.viewer.server import Server, begin_at
from recon_cli.workspace.layout import Workspace
from recon_cli.workspace.summaries import WorldSummary

SHARE = 0.04  # of the training's time, for all updates together
# viser's page goes on drawing for a quarter of a second after an update (RENDER_SETTLE_MS).
_SETTLE_SECONDS = 0.25
_PATIENCE_SECONDS = 30.0  # with a browser that does not answer, as one in a hidden tab
_ECHO = "recon-echo"  # a name that no browser keeps anything under

logger = logging.getLogger("recon")


class LiveView:
    """A watcher that shows what it sees to all browsers.

    Args:
        server: where browsers come.
        workspace: of the training; its sfm says where up is.
    """

    def __init__(self, server: Server, workspace: Workspace) -> None:
        self._server, self._workspace = server, workspace
        self._work = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recon-view")
        self._text = server.gui.add_markdown("Waiting for the training to begin.")
        server.gui.add_markdown(
            "*Colours are the mean over all directions. `recon view` shows the finished scene.*")
        self._node: viser.GaussianSplatHandle | None = None
        self._label, self._until = "", 0
        self._psnr_db: float | None = None
        self._due = 0.0  # by the clock of time.perf_counter
        self._busy = False
        self._closed = False

    def begin(self, label: str, until: int, cameras: Sequence[Camera], splats: Splats) -> None:
        """Puts all browsers where the first training camera stands."""
        self._label, self._until, self._psnr_db = label, until, None
        try:
            self._begin_at(cameras, splats)
        except Exception:  # nothing of this may end a training
            logger.debug("the browsers could not be placed", exc_info=True)

    def _begin_at(self, cameras: Sequence[Camera], splats: Splats) -> None:
        up = self._up(cameras)
        seen = depths_seen(cameras[0], splats.means.detach().cpu().double().numpy())
        eye = eye_of(cameras[0], float(np.median(seen)) if len(seen) else 1.0, FAR)
        self._server.scene.set_up_direction(up)
        begin_at(self._server, eye)
        if self._node is None:
            for client in self._server.get_clients().values():
                stand(client, eye, up, cameras[0])

    def step(self, iteration: int, splats: Splats) -> None:
        """Sends the Gaussians where that is due and somebody is there."""
        start = time.perf_counter()
        if self._busy or start < self._due or not self._server.get_clients():
            return
        self._busy = True
        kept = dataclasses.replace(splats, sh_rest=splats.sh_rest[:0])
        copy = kept.map(lambda tensor: tensor.detach().cpu().clone())
        self._work.submit(self._send, iteration, copy, start)

    def report(self, iteration: int, validation_psnr_db: float | None) -> None:  # noqa: ARG002
        """Keeps the PSNR for the next update."""
        self._psnr_db = validation_psnr_db

    def close(self) -> None:
        """Ends what is under way."""
        self._closed = True
        self._work.shutdown(wait=False, cancel_futures=True)

    def _send(self, iteration: int, splats: Splats, start: float) -> None:
        """Sends an update, waits until it is drawn, and says when the next one may come."""
        try:
            self._show(iteration, splats)
            for client in self._server.get_clients().values():
                self._wait_for(client)
        except Exception:  # nothing of this may end a training
            if not self._closed:
                logger.debug("an update could not be shown", exc_info=True)
        finally:
            cost = time.perf_counter() - start + _SETTLE_SECONDS
            self._due = start + cost / SHARE
            self._busy = False

    def _show(self, iteration: int, splats: Splats) -> None:
        found = packed(splats)
        colors = found.colors(None)
        psnr = "" if self._psnr_db is None else f", validation **{self._psnr_db:.2f} dB**"
        with self._server.atomic():
            if self._node is None:
                self._node = self._server.scene.add_gaussian_splats(
                    "/gaussians", found.centers, found.covariances, colors, found.opacities,
                    scale=found.scale)
            else:
                self._node.scale = found.scale
                self._node.set_gaussians(
                    found.centers, found.covariances, colors, found.opacities)
            self._text.content = (
                f"{self._label}: step **{iteration:,}** of {self._until:,}{psnr}, "
                f"{len(splats):,} Gaussians")
        self._server.flush()

    def _wait_for(self, client: viser.ClientHandle) -> None:
        """Waits until a browser has drawn what it was sent: it answers between two pictures."""
        for _ in range(2):
            try:
                client.local_storage.get_item(_ECHO, timeout=_PATIENCE_SECONDS)
            except (RuntimeError, TimeoutError):  # gone, or in a hidden tab
                return

    def _up(self, cameras: Sequence[Camera]) -> NDArray[np.float64]:
        try:
            world = WorldSummary.read(self._workspace.folder("sfm"))
            if world and world.evidence.up_found:
                return np.array([0.0, 0.0, 1.0])
        except (ReconError, OSError):
            pass  # a look at a training does without
        if len(cameras) < MIN_CAMERAS:
            return np.asarray(-cameras[0].viewmat[1, :3])
        return camera_up(np.stack([camera.viewmat for camera in cameras])).up
