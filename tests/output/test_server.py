"""The server of a page: who may ask for what, how much, and for how long."""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import threading
import time

import pytest

from accelcal_cli.errors import UsageError
from accelcal_cli.output import server as module
from accelcal_cli.output.server import HEADERS, Server

FILES = {"/": ("text/html; charset=utf-8", b"<p>page"), "/page.js": ("text/javascript", b"1")}


def act(stated):
    if stated.get("wrong"):
        raise UsageError("this is <b>wrong</b>")
    return {"got": stated}


@pytest.fixture
def server():
    made = Server("127.0.0.1", 0, FILES, {"/act": act})
    made.start()
    yield made
    made.close()


def ask(server, path="/", method="GET", body=None, **headers):
    """The answer to a request: status, headers, content; a header of None is not sent."""
    stated = {name.replace("_", "-"): value for name, value in headers.items()}
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    with contextlib.closing(connection):
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        stated = {"Host": f"127.0.0.1:{server.port}", **stated}
        if body is not None:
            stated = {"Content-Length": str(len(body)), "Content-Type": "application/json", **stated}
        for name, value in stated.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(body)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()


def bearer(server):
    return f"Bearer {server.token}"


def test_files_need_no_token_and_hold_none(server):
    status, headers, content = ask(server)
    assert (status, content) == (200, b"<p>page")
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert server.token.encode() not in content


@pytest.mark.parametrize("path", ["/", "/nothing", "/act"])
def test_every_answer_has_the_headers_that_keep_others_out(server, path):
    _, headers, _ = ask(server, path)
    assert {name: headers[name] for name in HEADERS} == HEADERS
    assert headers["Content-Security-Policy"].startswith("default-src 'self';")
    assert not [name for name in headers if name.lower().startswith("access-control")]


def test_the_token_is_in_the_fragment_alone_and_differs(server):
    address, _, fragment = server.address.partition("#")
    assert address == f"http://127.0.0.1:{server.port}/"
    assert fragment == server.token
    assert len(server.token) >= 43
    assert Server("127.0.0.1", 0, {}, {}).token != server.token
    assert server.token not in repr(server)


@pytest.mark.parametrize(
    "shown",
    [None, "", "Bearer ", "Bearer x", "{token}", "Basic {token}", "Bearer {token}x", "Bearer \u00e9"],
)
@pytest.mark.parametrize(("path", "method"), [("/events", "GET"), ("/act", "POST")])
def test_a_wrong_token_is_refused(server, shown, path, method):
    told = None if shown is None else shown.format(token=server.token).encode("latin-1")
    status, _, content = ask(server, path, method, b"{}" if method == "POST" else None, Authorization=told)
    assert (status, content) == (401, b"Unauthorized\n")
    assert server.opened is False


@pytest.mark.parametrize(
    "host",
    [None, "evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "192.168.1.5:{port}", ""],
)
def test_a_foreign_host_is_refused(server, host):
    """A name that leads here by DNS, with the right token even."""
    told = None if host is None else host.format(port=server.port)
    assert ask(server, Host=told)[0] == 403
    assert ask(server, "/act", "POST", b"{}", Host=told, Authorization=bearer(server))[0] == 403


def test_two_hosts_are_refused(server):
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as raw:
        host = f"Host: 127.0.0.1:{server.port}\r\n"
        raw.sendall(f"GET / HTTP/1.1\r\n{host}{host}\r\n".encode())
        assert raw.recv(100).startswith(b"HTTP/1.1 403 ")


def test_localhost_is_this_machine(server):
    assert ask(server, Host=f"localhost:{server.port}")[0] == 200


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "https://127.0.0.1:{port}", "http://127.0.0.1:1"]
)
def test_a_foreign_origin_is_refused(server, origin):
    told = {"Origin": origin.format(port=server.port), "Authorization": bearer(server)}
    assert ask(server, "/act", "POST", b"{}", **told)[0] == 403
    assert ask(server, "/events", **told)[0] == 403
    assert ask(server, "/act", "OPTIONS", **told)[0] == 403


def test_the_own_origin_may_act(server):
    own = {"Origin": f"http://127.0.0.1:{server.port}", "Authorization": bearer(server)}
    status, headers, content = ask(server, "/act", "POST", b'{"a": 1}', **own)
    assert (status, json.loads(content)) == (200, {"got": {"a": 1}})
    assert headers["Content-Type"] == "application/json"


def test_what_is_wrong_is_told(server):
    status, _, content = ask(server, "/act", "POST", b'{"wrong": 1}', Authorization=bearer(server))
    assert (status, json.loads(content)) == (409, {"error": "this is <b>wrong</b>"})


@pytest.mark.parametrize(
    ("path", "method", "status"),
    [
        ("/act", "GET", 405),
        ("/act", "OPTIONS", 405),
        ("/events", "POST", 405),
        ("/", "POST", 405),
        ("/../pyproject.toml", "GET", 404),
        ("/page.js?x", "GET", 404),
        ("//", "GET", 404),
    ],
)
def test_changes_are_made_by_post_alone_and_paths_are_exact(server, path, method, status):
    body = b"{}" if method == "POST" else None
    assert ask(server, path, method, body, Authorization=bearer(server))[0] == status


@pytest.mark.parametrize(
    ("body", "headers", "status"),
    [
        (b"[1]", {}, 400),
        (b"{", {}, 400),
        (b"[" * 4000, {}, 400),
        (b"{}", {"Content-Type": "text/plain"}, 415),
        (b" " * 5000, {}, 413),
        (b"{}", {"Content-Length": "99999999999999"}, 413),
        (b"{}", {"Content-Length": "-2"}, 400),
        (b"{}", {"Transfer-Encoding": "chunked"}, 400),
    ],
)
def test_bodies_are_small_json_objects(server, body, headers, status):
    sent = body[: module.BODY + 100]
    assert ask(server, "/act", "POST", sent, Authorization=bearer(server), **headers)[0] == status


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"GET / HTTP/1.1\r\nX: " + b"x" * 9000 + b"\r\n\r\n", b"431"),
        (b"GET /" + b"x" * 300 + b" HTTP/1.1\r\n\r\n", b"400"),
        (b"nonsense\r\n\r\n", b"400"),
        (b"GET / HTTP/1.1\r\n" + b"A: 1\r\n" * 200 + b"\r\n", b"400"),
    ],
)
def test_heads_are_small(server, sent, status):
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as raw:
        raw.sendall(sent)
        assert raw.recv(100).startswith(b"HTTP/1.1 " + status)


def test_a_request_that_does_not_arrive_is_given_up(server, monkeypatch):
    monkeypatch.setattr(module, "ARRIVAL", 0.2)
    with socket.create_connection(("127.0.0.1", server.port), timeout=10) as raw:
        raw.sendall(b"GET / HTTP/1.1\r\n")
        assert raw.recv(100) == b""


def test_connections_are_counted(server, monkeypatch):
    monkeypatch.setattr(module, "CONNECTIONS", 2)
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=10))
        deadline = time.monotonic() + 10
        while server._connections < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        extra = stack.enter_context(socket.create_connection(("127.0.0.1", server.port), timeout=10))
        with contextlib.suppress(ConnectionError):
            assert extra.recv(100) == b""


class Stream:
    """A page that listens."""

    def __init__(self, server):
        self.connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
        self.connection.request("GET", "/events", headers={"Authorization": bearer(server)})
        self.answer = self.connection.getresponse()

    def event(self):
        """The next event: its name and value."""
        lines = []
        while (line := self.answer.readline()) not in (b"\n", b""):
            lines.append(line.decode().rstrip("\n"))
        if not lines or lines == [":"]:
            return None
        return lines[0].removeprefix("event: "), json.loads(lines[1].removeprefix("data: "))

    def close(self):
        self.answer.close()
        self.connection.close()


def test_a_page_gets_the_latest_of_each_kind_and_what_replaces_it(server):
    for number in range(3):
        server.publish("moment", number)
    server.publish("poses", ["a"])
    with contextlib.closing(Stream(server)) as page:
        assert {page.event(), page.event()[0]} == {("moment", 2), "poses"}
        server.publish("moment", 3)
        assert page.event() == ("moment", 3)
        with contextlib.closing(Stream(server)) as other:
            assert other.event() == ("moment", 3)


def test_pages_are_counted_and_let_go(server, monkeypatch):
    monkeypatch.setattr(module, "PAGES", 1)
    server.publish("moment", 1)
    with contextlib.closing(Stream(server)) as page:
        assert page.event() == ("moment", 1)
        with contextlib.closing(Stream(server)) as other:
            assert other.answer.status == 503
    deadline = time.monotonic() + 10
    while server.pages and time.monotonic() < deadline:
        server.publish("moment", 2)
        time.sleep(0.02)
    with contextlib.closing(Stream(server)) as page:
        assert page.event() == ("moment", 2)
    assert server.opened


def test_a_silent_stream_is_kept_alive(server, monkeypatch):
    monkeypatch.setattr(module, "ALIVE", 0.1)
    server.publish("moment", 1)
    with contextlib.closing(Stream(server)) as page:
        assert page.event() == ("moment", 1)
        assert page.event() is None
        server.publish("moment", 2)
        found = page.event()
        while found is None:
            found = page.event()
        assert found == ("moment", 2)


def test_a_page_that_does_not_read_delays_nobody(server, monkeypatch):
    """Publishing returns at once, another page gets everything, and the slow one is let go."""
    monkeypatch.setattr(module, "SLOWEST", 0.3)
    server.publish("moment", 0)
    slow, brisk = Stream(server), Stream(server)
    with contextlib.closing(slow), contextlib.closing(brisk):
        assert slow.event() == brisk.event() == ("moment", 0)
        large = "x" * 100_000
        longest = 0.0
        for number in range(1, 150):
            before = time.monotonic()
            server.publish("moment", [number, large])
            longest = max(longest, time.monotonic() - before)
            assert brisk.event() == ("moment", [number, large])
        assert longest < 1.0
        deadline = time.monotonic() + 10
        while server.pages > 1 and time.monotonic() < deadline:
            time.sleep(0.02)
        assert server.pages == 1


def test_the_end_comes_after_what_was_said_last(server):
    with contextlib.closing(Stream(server)) as page:
        server.publish("end", "all")
        server.close()
        assert page.event() == ("end", "all")
        assert page.answer.read() == b""
    server.publish("moment", 1)  # nobody hears it, and nothing breaks


def test_a_port_that_is_taken_is_told(server):
    with pytest.raises(
        UsageError, match=rf"--bind 127.0.0.1 --web-port {server.port}: cannot be used: address"
    ):
        Server("127.0.0.1", server.port, {}, {}).start()


def test_an_address_of_another_machine_is_told():
    with pytest.raises(UsageError, match=r"--bind 192\.0\.2\.1 --web-port 0: cannot be used: "):
        Server("192.0.2.1", 0, {}, {}).start()


def test_all_addresses_are_named_as_one_that_others_reach():
    server = Server("0.0.0.0", 0, FILES, {})
    server.start()
    try:
        assert "//0.0.0.0:" not in server.address
        assert ask(server)[0] == 200
        assert ask(server, Host=f"0.0.0.0:{server.port}")[0] == 403
    finally:
        server.close()


def test_no_thread_is_left(server):
    with contextlib.closing(Stream(server)):
        server.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "page"]
