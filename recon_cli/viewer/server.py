"""A web server for browsers on this machine: a port that is free, and nobody else let in."""

from __future__ import annotations

import errno
import ipaddress
import logging
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import rich
import viser

from recon_cli.errors import ConfigError

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
