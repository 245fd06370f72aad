"""The viewer: a server, and a session for each browser that comes."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import viser

from recon_cli.viewer.beside import Pictures
from recon_cli.viewer.content import Content, Eye
from recon_cli.viewer.server import Server, serving
from recon_cli.viewer.session import UPS, Session


@contextmanager
def showing(
    content: Content, pictures: Pictures | None, host: str, port: int | None
) -> Iterator[tuple[Server, str]]:
    """Yields a server that shows a scene to every browser that comes, and its address.

    Args:
        content: what is shown.
        pictures: of its views; None where there are none.
        host: address to listen on.
        port: None takes the first free one.

    Raises:
        ConfigError: the port is taken, or the address is none of this machine.
    """
    sessions: dict[int, Session] = {}
    with serving(host, port, label="recon") as (server, address):
        work = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recon-view")
        up = UPS["+z"] if content.up is None else content.up
        server.scene.set_up_direction(np.asarray(up, float))
        begin_at(server, content.start)

        def come(client: viser.ClientHandle) -> None:
            sessions[client.client_id] = Session(client, content, pictures, work)

        def go(client: viser.ClientHandle) -> None:
            session = sessions.pop(client.client_id, None)
            if session is not None:
                session.leave()

        server.on_client_connect(come)
        server.on_client_disconnect(go)
        try:
            yield server, address
        finally:
            for session in sessions.values():
                session.leave()
            work.shutdown(cancel_futures=True)


def begin_at(server: Server, eye: Eye) -> None:
    """Sets where browsers that come from now on begin."""
    camera = server.initial_camera
    camera.position, camera.look_at = eye.position, eye.look_at
    camera.fov, camera.near, camera.far = eye.fov, eye.near, eye.far
