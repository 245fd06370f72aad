"""The viewer: a server, and a session for each browser that comes."""

from __future__ import annotations

import errno
import ipaddress
import logging
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numpy as np
import rich
import viser

from recon_cli.errors import ConfigError
from recon_cli.viewer.content import Content, Eye
from recon_cli.viewer.photo_pairs import Pictures
from recon_cli.viewer.session import UPS, Session

HOST, PORT = "127.0.0.1", 8080
_TRIED = 100  # ports after the first, where none was asked for

logger = logging.getLogger("recon")


class Server(viser.ViserServer):
    """A server that hands the scene to whoever connects, and to nobody else."""

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        """Opens no tunnel to a server of others, whoever asks for one: captures are private."""
        return None


@contextmanager
def serving(host: str, port: int | None, *, label: str) -> Iterator[tuple[Server, str]]:
    """Yields a running server and its address; the port is free again afterwards.

    Args:
        host: address to listen on.
        port: None takes PORT, or the first free one after it.
        label: title of the panel.

    Raises:
        ConfigError: the port is taken, or the address is none of this machine.
    """
    chosen = _free_port(host, port)
    # viser announces itself on stdout; the verbs say what a user has to know
    rich.get_console().quiet = True
    server = Server(host, chosen, label=label, verbose=False)
    try:
        if server.get_port() != chosen:  # viser goes on to the next port in silence
            raise _taken(chosen)
        server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        if not _own_machine_only(host):
            logger.warning(
                "everyone who reaches this machine by the network can look at the scene: "
                "--host is %s", host)
        yield server, _address(host, chosen)
    finally:
        server.stop()


def _free_port(host: str, port: int | None) -> int:
    if port is not None:
        if not _is_free(host, port):
            raise _taken(port)
        return port
    for candidate in range(PORT, PORT + _TRIED):
        if _is_free(host, candidate):
            return candidate
    raise ConfigError(
        f"The ports {PORT} to {PORT + _TRIED - 1} are all taken.", hint="Give another with --port.")


def _taken(port: int) -> ConfigError:
    return ConfigError(
        f"The port {port} is taken by another program.",
        hint="Give another with --port, or leave it out for a free one.")


def _is_free(host: str, port: int) -> bool:
    """Returns whether a server can listen there.

    Raises:
        ConfigError: the address is none of this machine, or a user may not listen there.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except socket.gaierror as error:
        raise ConfigError(
            f"The address {host!r} is not known: {error.strerror}.",
            hint=f"Leave --host out for {HOST}.") from error
    for family, kind, protocol, _, place in found:
        with socket.socket(family, kind, protocol) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as asyncio listens
            try:
                trial.bind(place)
                trial.listen()
            except PermissionError as error:
                raise ConfigError(
                    f"A user may not listen on port {port}.",
                    hint="Give one above 1023 with --port.") from error
            except OSError as error:
                if error.errno == errno.EADDRNOTAVAIL:
                    raise ConfigError(
                        f"{host} is no address of this machine.",
                        hint=f"Leave --host out for {HOST}, or give 0.0.0.0 for all of them."
                    ) from error
                return False
    return True


def _own_machine_only(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a name
        return host == "localhost"


def _address(host: str, port: int) -> str:
    shown = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, host)
    if ":" in shown and not shown.startswith("["):
        shown = f"[{shown}]"
    return f"http://{shown}:{port}"


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
