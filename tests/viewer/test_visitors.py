"""The viewer's own page is served, and nobody else's: by headers, by a client, in a browser."""

import asyncio
import http.client
import http.server
import socket
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import viser
import websockets
from facts import raises

from recon_cli.viewer import visitors
from recon_cli.viewer.server import HOST, start_server
from recon_cli.viewer.visitors import find_refusal, refusing_strangers

PAGE = """<script>
const socket = new WebSocket("ws://ADDRESS", ["viser-vVERSION"]);
socket.onmessage = () => document.title = "it read the scene";
socket.onerror = () => document.title = "refused";
</script>"""


@pytest.mark.parametrize(("listens", "host", "origin"), [
    ("127.0.0.1", "127.0.0.1:8080", "http://127.0.0.1:8080"),
    ("127.0.0.1", "localhost:8080", "http://localhost:8080"),
    ("127.0.0.1", "LOCALHOST:9000", "http://localhost:9000"),  # ssh -L 9000:...
    ("::1", "[::1]:8080", "http://[::1]:8080"),
    ("0.0.0.0", "192.168.1.7:8080", "http://192.168.1.7:8080"),
    ("0.0.0.0", f"{socket.gethostname()}:8080", None),
    ("0.0.0.0", f"{socket.gethostname().partition('.')[0]}.local:8080", None),
    ("room.example", "room.example:8080", "https://room.example:8080"),
    ("127.0.0.1", "127.0.0.1", None)])
def test_the_own_page_is_served_by_every_name_that_is_its_own(listens, host, origin):
    assert find_refusal(listens, [host], [origin] if origin else []) == ""


@pytest.mark.parametrize(("hosts", "origins"), [
    (["127.0.0.1:8080"], ["http://evil.example"]),
    (["127.0.0.1:8080"], ["null"]),  # of a sandboxed frame, or a file
    (["127.0.0.1:8080"], [""]),
    (["127.0.0.1:8080"], ["http://127.0.0.1:9000"]),  # another server on this machine
    (["127.0.0.1:8080"], ["http://127.0.0.1:8080", "http://evil.example"]),
    (["evil.example:8080"], ["http://evil.example:8080"]),  # its name now points here
    (["evil.example:8080"], []),
    (["127.0.0.1.evil.example:8080"], []),
    (["user@evil.example:8080"], []),
    (["[::1:8080"], []), (["a]b"], []), (["127.0.0.1:8080"], ["http://[1"]),  # no addresses
    (["127.0.0.1:8080", "evil.example"], []), ([], []), ([""], [])])
def test_others_are_refused(hosts, origins):
    assert find_refusal("127.0.0.1", hosts, origins)


def connect(address, **options):
    async def first():
        async with websockets.connect(
            address.replace("http", "ws"), subprotocols=[f"viser-v{viser.__version__}"], **options
        ) as connection:
            return await connection.recv()

    # In a thread of its own: playwright's loop runs in this one once a browser was asked for.
    with ThreadPoolExecutor(1) as thread:
        return thread.submit(lambda: asyncio.run(first())).result()


def test_a_client_of_another_origin_gets_nothing_and_one_of_its_own_the_scene():
    with start_server(HOST, None, label="x") as (_, address):
        assert connect(address)
        assert connect(address, origin=address)
        with raises(websockets.InvalidStatus, 403):
            connect(address, origin="http://evil.example")


def test_a_page_is_not_served_by_the_name_of_a_stranger():
    with start_server(HOST, None, label="x") as (server, _):
        for name, status in (("evil.example", 403), ("localhost", 200)):
            asked = http.client.HTTPConnection(HOST, server.get_port())
            asked.request("GET", "/", headers={"Host": f"{name}:{server.get_port()}"})
            answer = asked.getresponse()
            assert answer.status == status
            assert (b"the one that recon printed" in answer.read()) == (status == 403)
            asked.close()


def test_no_answer_may_be_shown_in_a_frame_of_another_page():
    with start_server(HOST, None, label="x") as (server, _):
        port = server.get_port()
        for path, name, status in (
                ("/", HOST, 200), ("/nothing", HOST, 404), ("/", "evil.example", 403)):
            asked = http.client.HTTPConnection(HOST, port)
            asked.request("GET", path, headers={"Host": f"{name}:{port}"})
            answer = asked.getresponse()
            assert answer.status == status
            assert answer.headers["Content-Security-Policy"] == "frame-ancestors 'none'"
            assert answer.headers["X-Frame-Options"] == "DENY"
            asked.close()


def test_requests_that_cannot_be_read_leave_no_traceback(caplog):
    with start_server(HOST, None, label="x") as (server, _):
        for request, status in (
                (b"", b""), (b"hello\r\n\r\n", b""), (b"GET / HTTP/1.1\r\nHo", b""),
                (b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n", b""),  # does not wait for it
                (b"GET / HTTP/1.1\r\nHost: [::1:8467\r\n\r\n", b"HTTP/1.1 403"),
                (b"GET / HTTP/1.1\r\nHost: a]b\r\nUpgrade: websocket\r\n\r\n", b"HTTP/1.1 403")):
            with socket.create_connection((HOST, server.get_port()), timeout=10) as asked:
                asked.sendall(request)
                if not status:
                    asked.shutdown(socket.SHUT_WR)
                answer = asked.makefile("rb").read()
            assert answer[:len(status)] == status
    assert not [record for record in caplog.records if record.exc_info]


def test_a_server_that_would_admit_strangers_does_not_run():
    with raises(RuntimeError, "strangers"), refusing_strangers(HOST):
        pass
    before = visitors.websocket_server.serve
    with start_server(HOST, None, label="x"):
        assert visitors.websocket_server.serve is before


def test_a_foreign_page_in_a_browser_cannot_read_the_scene(tmp_path, page):
    with start_server(HOST, None, label="x") as (_, address):
        text = PAGE.replace("ADDRESS", address.removeprefix("http://"))
        (tmp_path / "page.html").write_text(text.replace("VERSION", viser.__version__))

        class Quiet(http.server.SimpleHTTPRequestHandler):
            def __init__(self, *arguments):
                super().__init__(*arguments, directory=tmp_path)

            def log_message(self, *_):
                pass

        with http.server.HTTPServer((HOST, 0), Quiet) as foreign:
            threading.Thread(target=foreign.serve_forever, daemon=True).start()
            page.page.goto(f"http://{HOST}:{foreign.server_port}/page.html")
            page.page.wait_for_function("document.title", timeout=60_000)
            assert page.page.title() == "refused"
            foreign.shutdown()
