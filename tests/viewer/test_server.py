"""Ports and addresses: what is taken is said, what is left is free again."""

import socket
import threading

import pytest
from facts import assert_facts, raises

from recon_cli.errors import ConfigError
from recon_cli.viewer import server
from recon_cli.viewer.server import HOST, start_server


def listening(port=0):
    taken = socket.create_server((HOST, port))
    return taken, taken.getsockname()[1]


def test_the_next_free_port_is_taken_where_none_was_asked_for(monkeypatch):
    taken, port = listening()
    monkeypatch.setattr(server, "PORT", port)
    with taken, start_server(HOST, None, label="x") as (found, address):
        assert found.get_port() > port
        assert address == f"http://127.0.0.1:{found.get_port()}"


def test_a_port_that_was_asked_for_and_is_taken_is_an_error_with_a_hint():
    taken, port = listening()
    with taken, raises(ConfigError, port, "port") as raised:
        start_server(HOST, port, label="x").__enter__()
    assert "--port" in raised.value.hint


def test_no_free_port_at_all_is_an_error(monkeypatch):
    taken, port = listening()
    monkeypatch.setattr(server, "PORT", port)
    monkeypatch.setattr(server, "_TRIED", 1)
    with taken, raises(ConfigError):
        start_server(HOST, None, label="x").__enter__()


@pytest.mark.parametrize("host", ["no.such.host.invalid", "203.0.113.7"])
def test_an_address_that_is_not_of_this_machine_is_an_error(host):
    with raises(ConfigError, host) as raised:
        start_server(host, None, label="x").__enter__()
    assert "--host" in raised.value.hint


def test_afterwards_the_port_is_free_and_no_thread_is_left(capfd):
    before = set(threading.enumerate())
    with start_server(HOST, None, label="x") as (found, _):
        port = found.get_port()
    assert not {one for one in threading.enumerate() if one.is_alive()} - before
    listening(port)[0].close()
    assert capfd.readouterr().out == ""  # the verbs say what there is to say


def test_a_server_for_all_says_so_and_one_for_this_machine_does_not(caplog):
    with start_server(HOST, None, label="x"):
        assert not caplog.records
    with start_server("0.0.0.0", None, label="x") as (_, address):
        assert_facts(caplog.text, "everyone")
    assert address.startswith("http://127.0.0.1:")


def test_no_browser_can_have_the_scene_sent_to_a_server_of_others():
    with start_server(HOST, None, label="x") as (found, _):
        assert found.request_share_url() is None
