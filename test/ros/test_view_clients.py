"""`rcseg view` under clients that are slow, broken or curious: it serves the good ones and says nothing."""

from __future__ import annotations

import http.client
import inspect
import socket
import threading
import time

import pytest

from rcseg_ros import cli
from rcseg_ros.commands import viewers
from rcseg_ros.commands.viewers import PageViewer

SECRET = ("text/plain", b"shown" * 100_000)  # more than the buffers of a socket hold


@pytest.fixture
def page():
    viewer = PageViewer("127.0.0.1", 0)
    viewer._parts["thing"] = SECRET
    yield viewer
    viewer.close()


def _port(viewer):
    return int(viewer.address.rsplit(":", 1)[1])


def _get(viewer, path="/thing", host=None):
    connection = http.client.HTTPConnection("127.0.0.1", _port(viewer), timeout=20)
    connection.putrequest("GET", path, skip_host=host is not None)
    if host is not None:
        connection.putheader("Host", host)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer, body


def test_only_this_machine_is_served_unless_told_otherwise():
    assert inspect.signature(cli.view).parameters["host"].default == "127.0.0.1"


def test_security_headers(page):
    for path in ("/", "/thing", "/absent"):
        answer, _ = _get(page, path)
        assert answer.getheader("X-Content-Type-Options") == "nosniff"
        assert answer.getheader("X-Frame-Options") == "DENY"
        assert "default-src 'self'" in answer.getheader("Content-Security-Policy")
        assert answer.getheader("Cache-Control") == "no-store"
        assert answer.getheader("Access-Control-Allow-Origin") is None


@pytest.mark.parametrize(
    "path", ["/../../etc/passwd", "//etc/passwd", "/%2e%2e/setup.py", "/page.html", "/./thing/../x", "/%7f"]
)
def test_a_request_names_no_file(page, path):
    answer, body = _get(page, path)
    assert answer.status == 404 and body == b"not shown yet"


@pytest.mark.parametrize(
    ("host", "status"),
    [("localhost", 200), ("127.0.0.1:80", 200), ("[::1]:80", 200), ("evil.example:80", 403), ("", 403),
     ("localhost.evil.example", 403), ("127.evil.example", 403), ("[", 403)],
)  # fmt: skip
def test_names_that_were_made_to_point_here_are_refused(page, host, status):
    assert _get(page, host=host)[0].status == status


def test_two_hundred_slow_and_broken_clients(page, monkeypatch, capfd):
    monkeypatch.setattr(page._server.RequestHandlerClass, "timeout", 1.0)
    threads_before = threading.active_count()
    sockets = []
    for i in range(200):
        client = socket.create_connection(("127.0.0.1", _port(page)), timeout=20)
        sockets.append(client)
        if i % 4 == 0:
            client.sendall(b"GET /thi")  # never ends
        elif i % 4 == 1:
            client.sendall(b"GET /thing HTTP/1.0\r\nHost: localhost\r\n\r\n")  # never reads
        elif i % 4 == 2:
            client.sendall(b"GET /thing HTTP/1.0\r\nHost: localhost\r\n\r\n")
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, bytes([1, 0, 0, 0, 0, 0, 0, 0]))
            client.close()  # with a reset
        else:
            client.sendall(bytes(range(256)) * 64)
    answer, body = _get(page)
    assert answer.status == 200 and body == SECRET[1]
    end = time.monotonic() + 20
    while threading.active_count() > threads_before and time.monotonic() < end:
        time.sleep(0.05)
    assert threading.active_count() <= threads_before, "a client was not let go"
    for client in sockets:
        client.close()
    assert _get(page)[0].status == 200
    assert capfd.readouterr().err == ""


@pytest.fixture
def small_page(monkeypatch):
    """Two places; to be changed before any client holds one, or it is given back to another count."""
    monkeypatch.setattr(viewers, "MOST_CLIENTS", 2)
    viewer = PageViewer("127.0.0.1", 0)
    viewer._parts["thing"] = SECRET
    yield viewer
    viewer.close()


def test_more_clients_than_places_are_let_go(small_page, monkeypatch):
    page = small_page
    monkeypatch.setattr(page._server.RequestHandlerClass, "timeout", 1.0)
    waiting = [socket.create_connection(("127.0.0.1", _port(page)), timeout=20) for _ in range(5)]
    assert sum(client.recv(1) == b"" for client in waiting[2:]) == 3, "closed at once"
    for client in waiting:
        client.close()
    end = time.monotonic() + 20
    while time.monotonic() < end:
        try:
            if _get(page)[0].status == 200:
                return
        except (ConnectionError, http.client.HTTPException):
            time.sleep(0.1)
    raise AssertionError("no place became free")


def test_a_client_for_whom_no_thread_can_be_started_takes_no_place(small_page, monkeypatch, capfd):
    """As under a limit of processes: here each of the first three."""
    start, refused = threading.Thread.start, []

    def start_later(thread):
        if len(refused) < 3 and "process_request" in thread.name:
            refused.append(thread)
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", start_later)
    for _ in range(3):
        with pytest.raises((ConnectionError, http.client.HTTPException)):
            _get(small_page)
    assert len(refused) == 3
    assert _get(small_page)[0].status == 200
    assert capfd.readouterr().err == ""


def test_the_bound_is_above_what_a_browser_opens():
    assert viewers.MOST_CLIENTS >= 64
