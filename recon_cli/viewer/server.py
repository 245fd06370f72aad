"""The viewer's server: it gives a session to each browser that connects."""

from __future__ import annotations

import errno
import ipaddress
import logging
import os
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial

import numpy as np
import rich
import viser

from recon_cli.errors import ConfigError
from recon_cli.viewer.content import PhotoPairs, ViewerContent, set_initial_camera
from recon_cli.viewer.page import rename_page
from recon_cli.viewer.session import UPS, Session
from recon_cli.viewer.trust_tint import TrustTint
from recon_cli.viewer.visitors import refusing_strangers

HOST, PORT = "127.0.0.1", 8080
_TRIED = 100  # ports after the first, if none is given

logger = logging.getLogger("recon")


class Server(viser.ViserServer):
    """A viser server that never opens a public tunnel."""

    def request_share_url(self, verbose: bool = True) -> str | None:  # noqa: ARG002
        """Refuses every request for a tunnel to a third-party server: captures are private."""
        return None


@contextmanager
def start_server(host: str, port: int | None, *, label: str) -> Iterator[tuple[Server, str]]:
    """Yields a running server and its address; the port is free again afterwards.

    `port` None takes PORT, or the first free one after it; `label` is the title of page and panel.
    ConfigError if the port is in use, or the address is not of this machine.
    """
    chosen = _free_port(host, port)
    # viser prints to stdout; the commands inform the user
    rich.get_console().quiet = True
    with refusing_strangers(host, partial(rename_page, title=label)):
        server = Server(host, chosen, label=label, verbose=False)
    try:
        if server.get_port() != chosen:  # viser moves on to the next port silently
            raise _port_error(chosen)
        server.gui.configure_theme(
            dark_mode=True, show_logo=False, show_share_button=False, control_width="medium")
        if not _is_local(host):
            logger.warning(
                "everyone who can reach this machine over the network can see the scene: "
                "--host is %s", host)
        yield server, _address(host, chosen)
    finally:
        server.stop()


def _free_port(host: str, port: int | None) -> int:
    for candidate in range(PORT, PORT + _TRIED) if port is None else (port,):
        if _is_free(host, candidate):
            return candidate
    if port is not None:
        raise _port_error(port)
    raise ConfigError(
        f"The ports {PORT} to {PORT + _TRIED - 1} are all in use.",
        hint="Give another with --port.")


def _port_error(port: int) -> ConfigError:
    return ConfigError(
        f"The port {port} is in use by another program.",
        hint="Give another with --port, or omit it for a free one.")


def _is_free(host: str, port: int) -> bool:
    """Returns whether a server can listen there; ConfigError if it never could."""
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except socket.gaierror as error:
        raise ConfigError(
            f"The address {host!r} is not known: {error.strerror}.",
            hint=f"Omit --host for {HOST}.") from error
    for family, kind, protocol, _, address in addresses:
        with socket.socket(family, kind, protocol) as trial:
            if os.name == "posix":  # as asyncio listens; elsewhere it would let two share a port
                trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                trial.bind(address)
                trial.listen()
            except PermissionError as error:
                raise ConfigError(
                    f"Port {port} needs administrator rights.",
                    hint="Give one above 1023 with --port.") from error
            except OSError as error:
                if error.errno == errno.EADDRNOTAVAIL:
                    raise ConfigError(
                        f"{host} is not an address of this machine.",
                        hint=f"Omit --host for {HOST}, or give 0.0.0.0 for all addresses."
                    ) from error
                return False
    return True


def _is_local(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a host name
        return host == "localhost"


def _address(host: str, port: int) -> str:
    name = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://[{name}]:{port}" if ":" in name else f"http://{name}:{port}"


@contextmanager
def serve_scene(
    content: ViewerContent, photos: PhotoPairs | None, host: str, port: int | None,
    trust: TrustTint | None = None,
) -> Iterator[tuple[Server, str]]:
    """Yields a server that shows a scene to every browser, and its address.

    `photos` are of its views and `trust` tints it, both None without views; the errors are those of
    `start_server`.
    """
    sessions: dict[int, Session] = {}
    with start_server(host, port, label=f"{content.title} - recon") as (server, address):
        work = ThreadPoolExecutor(max_workers=1, thread_name_prefix="recon-view")
        up = UPS["+z"] if content.up is None else content.up
        server.scene.set_up_direction(np.asarray(up, float))
        set_initial_camera(server, content.start)

        def connect(client: viser.ClientHandle) -> None:
            sessions[client.client_id] = Session(client, content, photos, work, trust)

        def disconnect(client: viser.ClientHandle) -> None:
            session = sessions.pop(client.client_id, None)
            if session is not None:
                session.leave()

        server.on_client_connect(connect)
        server.on_client_disconnect(disconnect)
        try:
            yield server, address
        finally:
            for session in sessions.values():
                session.leave()
            work.shutdown(cancel_futures=True)
