"""Who may ask the viewer's server for anything: its own page, by an address that is its own.

A page of somebody else in the same browser reaches it too, and so does one whose name was made to
point at this machine after it was loaded (DNS rebinding). Both tell on themselves: a browser says
which page asks (Origin) and by which name (Host). Nor may a page show the viewer in a frame, under
pictures of its own that make a user click there.
"""

from __future__ import annotations

import http
import ipaddress
import logging
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import websockets.asyncio.server as websocket_server
from websockets.asyncio.server import ServerConnection
from websockets.exceptions import WebSocketException
from websockets.http11 import Request, Response

_NO_FRAMES = {"Content-Security-Policy": "frame-ancestors 'none'", "X-Frame-Options": "DENY"}
_Answer = Callable[[ServerConnection, Request], Response | None]
_Change = Callable[[Response | None], Response | None]


def find_refusal(host: str, hosts: list[str], origins: list[str]) -> str:
    """Returns why a request is refused, empty if it is not.

    `host` is the address of the server; the others are the values of the request's headers. No
    Origin is sent by programs that are not browsers.
    """
    try:
        names = [urlsplit(f"//{name}").hostname or "" for name in hosts]
        pages = [urlsplit(origin).netloc.lower() for origin in origins]
    except ValueError as error:  # of an open bracket
        return f"The request names no address: {error}."
    if len(names) != 1 or not _is_own(names[0], host):
        return ("This address is not one of this machine. Open the one that recon printed, or the "
                "machine's IP address.")
    if any(page != hosts[0].lower() for page in pages):
        return "Only the viewer's own page may connect."
    return ""


def _is_own(name: str, host: str) -> bool:
    """Returns whether no stranger can have chosen a name: an IP address, or one of this machine."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        names = {"localhost", host.lower()}
        for own in (socket.gethostname().lower(), socket.getfqdn().lower()):
            names |= {own, own.partition(".")[0], f"{own.partition('.')[0]}.local"}
        return name in names or name.endswith(".localhost")
    return True


@contextmanager
def refusing_strangers(host: str, change: _Change = lambda response: response) -> Iterator[None]:
    """Has the server of viser that starts in the block refuse strangers.

    `change` gets its answers to others. viser leaves no other way than the function by which it
    serves.

    Raises:
        RuntimeError: it no longer serves by that; it must not run without.
    """
    plain, served = websocket_server.serve, []

    def serve(*arguments: Any, process_request: _Answer, **options: Any) -> Any:
        served.append(True)
        return plain(*arguments, process_request=partial(
            _answer, host, change, process_request), process_response=_forbid_frames, **options)

    # Whoever connects and says nothing, or no HTTP, is no fault of the server
    logging.getLogger("websockets.server").addFilter(_is_fault)
    websocket_server.serve = serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websocket_server.serve = plain  # type: ignore[misc]
    if not served:
        raise RuntimeError("viser serves in another way than before, which would admit strangers")


def _answer(
    host: str, change: _Change, answer: _Answer, connection: ServerConnection, request: Request
) -> Response | None:
    refusal = find_refusal(
        host, request.headers.get_all("Host"), request.headers.get_all("Origin"))
    if refusal:
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"{refusal}\n")
    return change(answer(connection, request))


def _forbid_frames(
    _connection: ServerConnection, _request: Request, response: Response
) -> None:
    """Adds the headers by which no page may show the answer in a frame."""
    response.headers.update(_NO_FRAMES)


def _is_fault(record: logging.LogRecord) -> bool:
    """Returns whether a line of the server's log is not about what the other side did."""
    return not (record.exc_info and isinstance(record.exc_info[1], WebSocketException))
