"""An HTTP server for one page on this machine: its files, its events, its few actions, and who may ask for them.

Whoever knows the token may. It is the fragment of the page's address, which browsers do not send; the page's script
reads it and sends it in a header of its requests, which no other page can do. Host and Origin are checked besides, so
that a name that leads here by DNS does not. All that is read has a limit in bytes and seconds, and so has the number of
connections; of each kind of event a page gets the latest value alone, so that a slow one delays nobody.
"""

from __future__ import annotations

import asyncio
import hmac
import http.client
import io
import ipaddress
import json
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

from accelcal_cli.errors import AccelcalError, UsageError

HEAD, BODY = 8192, 4096
"""Bytes of the head and of the body of a request at most."""

ARRIVAL, SLOWEST = 5.0, 10.0
"""Seconds in which a request has to arrive, and in which a page has to take what it is sent."""

CONNECTIONS, PAGES = 32, 8
"""Connections that are open at once, and pages among them that get events."""

FAREWELL = 1.0
"""Seconds in which connections have to end when the server does."""

ALIVE = 10.0
"""Seconds after which a silent stream of events gets a comment, so that a page that is gone is found out."""

WAITING = 65536
"""Bytes that wait for a slow page before nothing more is sent to it."""

HEADERS = {
    "Content-Security-Policy": "default-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
    "Connection": "close",
}
"""Of every answer; there is none that lets other pages read one."""

_REQUEST = re.compile(r"([A-Z]{1,16}) (/[\x21-\x7e]{0,200}) HTTP/1\.[01]")

Action = Callable[[Mapping[str, Any]], Mapping[str, Any]]
"""What a POST does: from the JSON that it brings to the JSON of its answer; AccelcalError is told to the page."""


@dataclass(frozen=True)
class Request:
    """A request whose sender may be anyone."""

    method: str
    path: str
    headers: http.client.HTTPMessage
    body: bytes


class Refused(Exception):  # noqa: N818  # an answer rather than an error
    """The request gets this status."""

    def __init__(self, status: HTTPStatus) -> None:
        """Refuse with a status."""
        super().__init__(status)
        self.status = status


@dataclass(eq=False)
class Server:
    """Serves from a thread of its own; all methods may be called from others and return at once.

    Attributes:
        bind: address of this machine that is listened at; port: 0 for any that is free.
        files: content type and content by path; actions: by path, after a POST with the token.
        token: what the page has to know; pages: open now; opened: whether there ever was one; left: when the last went.
    """

    bind: str
    port: int
    files: Mapping[str, tuple[str, bytes]]
    actions: Mapping[str, Action]
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)
    pages: int = 0
    opened: bool = False
    left: float = 0.0
    _values: dict[str, tuple[int, bytes]] = field(default_factory=dict, repr=False)
    _waking: set[asyncio.Event] = field(default_factory=set, repr=False)
    _connections: int = 0

    def start(self) -> None:
        """Listen.

        Raises:
            UsageError: the address is not of this machine, or the port is not free.
        """
        family = socket.AF_INET6 if ":" in self.bind else socket.AF_INET
        try:
            self._socket = socket.create_server((self.bind, self.port), family=family)
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise UsageError(f"--bind {self.bind} --web-port {self.port}: cannot be used: {reason}") from None
        self.port = self._socket.getsockname()[1]
        self._loop = asyncio.new_event_loop()
        self._busy, self._ended = asyncio.Lock(), asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        """Where the page is, with the token; of an address that stands for all, the one that others reach."""
        host = self.bind
        if ipaddress.ip_address(host).is_unspecified:
            host = _outward(":" in host)
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/#{self.token}"

    def publish(self, name: str, value: Any) -> None:
        """Replace the latest value of a kind of event; pages get it when they come to it."""
        version, _ = self._values.get(name, (0, b""))
        text = json.dumps(value, allow_nan=False)
        self._values[name] = version + 1, f"event: {name}\ndata: {text}\n\n".encode()
        with suppress(RuntimeError):  # it has ended
            self._loop.call_soon_threadsafe(self._wake)

    def close(self) -> None:
        """End all connections, after what they were sent last."""
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(SLOWEST)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._listen())
        self._loop.run_until_complete(self._loop.shutdown_default_executor())
        self._loop.close()

    async def _listen(self) -> None:
        server = await asyncio.start_server(self._serve, sock=self._socket, limit=HEAD)
        await self._ended.wait()
        server.close()
        self._wake()
        left = asyncio.all_tasks() - {asyncio.current_task()}
        if left:
            _, late = await asyncio.wait(left, timeout=FAREWELL)
            for task in late:
                task.cancel()
            await asyncio.gather(*late)

    def _wake(self) -> None:
        for event in self._waking:
            event.set()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._connections >= CONNECTIONS:
            writer.transport.abort()
            return
        self._connections += 1
        try:
            async with asyncio.timeout(ARRIVAL):
                request = await _read(reader)
            await self._answer(request, reader, writer)
        except Refused as refused:
            _send(writer, refused.status, "text/plain", f"{refused.status.phrase}\n".encode())
        except (OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.CancelledError):
            pass  # whoever it was is gone or too slow, or all is at its end
        finally:
            self._connections -= 1
            with suppress(OSError, TimeoutError):
                async with asyncio.timeout(SLOWEST):
                    await writer.drain()
                    writer.close()
                    await writer.wait_closed()
            writer.transport.abort()  # whatever nobody takes

    async def _answer(
        self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Answer a request; what is not allowed raises Refused."""
        self._check_origin(request, writer)
        if request.path in self.files:
            if request.method != "GET":
                raise Refused(HTTPStatus.METHOD_NOT_ALLOWED)
            _send(writer, HTTPStatus.OK, *self.files[request.path])
            return
        if request.path != "/events" and request.path not in self.actions:
            raise Refused(HTTPStatus.NOT_FOUND)
        if request.method != ("GET" if request.path == "/events" else "POST"):
            raise Refused(HTTPStatus.METHOD_NOT_ALLOWED)
        shown = request.headers.get("Authorization", "")
        if not hmac.compare_digest(shown.encode(), f"Bearer {self.token}".encode()):
            raise Refused(HTTPStatus.UNAUTHORIZED)
        if request.path == "/events":
            await self._stream(reader, writer)
        else:
            await self._act(request, writer)

    def _check_origin(self, request: Request, writer: asyncio.StreamWriter) -> None:
        """Refuse a request that is not for the address at which it came in, or that another page has made."""
        host, port = writer.get_extra_info("sockname")[:2]
        plain = host.removeprefix("::ffff:")
        allowed = [f"[{plain}]:{port}" if ":" in plain else f"{plain}:{port}"]
        if ipaddress.ip_address(plain).is_loopback:
            allowed.append(f"localhost:{port}")
        named = request.headers.get_all("Host", [])
        if len(named) != 1 or named[0] not in allowed:
            raise Refused(HTTPStatus.FORBIDDEN)
        origins = request.headers.get_all("Origin", [])
        if any(origin != f"http://{named[0]}" for origin in origins):
            raise Refused(HTTPStatus.FORBIDDEN)

    async def _act(self, request: Request, writer: asyncio.StreamWriter) -> None:
        if request.headers.get_content_type() != "application/json":
            raise Refused(HTTPStatus.UNSUPPORTED_MEDIA_TYPE)
        try:
            stated = json.loads(request.body)
        except (ValueError, RecursionError):
            stated = None
        if not isinstance(stated, dict):
            raise Refused(HTTPStatus.BAD_REQUEST)
        async with self._busy:
            status, said = await asyncio.to_thread(_done, self.actions[request.path], stated)
        _send(writer, status, "application/json", json.dumps(said).encode())

    async def _stream(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send the latest values, and whatever replaces them, until the page goes."""
        if self.pages >= PAGES:
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE)
        changed = asyncio.Event()
        self._waking.add(changed)
        self.pages += 1
        self.opened = True
        gone = asyncio.ensure_future(reader.read(1))  # it has nothing more to say

        def wake(end: asyncio.Future[bytes]) -> None:
            if not end.cancelled():
                end.exception()  # looked at, or it is reported
            changed.set()

        gone.add_done_callback(wake)
        try:
            writer.transport.set_write_buffer_limits(WAITING)
            _head(writer, HTTPStatus.OK, "text/event-stream; charset=utf-8")
            sent: dict[str, int] = {}
            while not gone.done():
                changed.clear()
                for name, (version, text) in list(self._values.items()):
                    if sent.get(name) != version:
                        sent[name] = version
                        writer.write(text)
                async with asyncio.timeout(SLOWEST):
                    await writer.drain()
                if self._ended.is_set():
                    return
                with suppress(TimeoutError):
                    async with asyncio.timeout(ALIVE):
                        await changed.wait()
                        continue
                writer.write(b":\n\n")
        finally:
            gone.cancel()
            self._waking.discard(changed)
            self.pages -= 1
            self.left = time.monotonic()


def _done(action: Action, stated: Mapping[str, Any]) -> tuple[HTTPStatus, Mapping[str, Any]]:
    try:
        return HTTPStatus.OK, action(stated)
    except AccelcalError as error:
        return HTTPStatus.CONFLICT, {"error": str(error)}


async def _read(reader: asyncio.StreamReader) -> Request:
    """Return a request; raise Refused for one that is too large or none."""
    try:
        head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.LimitOverrunError:
        raise Refused(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE) from None
    line, _, rest = head.partition(b"\r\n")
    found = _REQUEST.fullmatch(line.decode("latin-1"))
    if found is None:
        raise Refused(HTTPStatus.BAD_REQUEST)
    try:
        headers = http.client.parse_headers(io.BytesIO(rest))
    except http.client.HTTPException:
        raise Refused(HTTPStatus.BAD_REQUEST) from None
    lengths = headers.get_all("Content-Length", [])
    if "Transfer-Encoding" in headers or len(lengths) > 1:
        raise Refused(HTTPStatus.BAD_REQUEST)
    length = lengths[0] if lengths else "0"
    if not (length.isascii() and length.isdigit()):
        raise Refused(HTTPStatus.BAD_REQUEST)
    if len(length) > 9 or int(length) > BODY:
        raise Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE)
    return Request(found[1], found[2], headers, await reader.readexactly(int(length)))


def _head(writer: asyncio.StreamWriter, status: HTTPStatus, kind: str, length: int | None = None) -> None:
    lines = [f"HTTP/1.1 {status.value} {status.phrase}", f"Content-Type: {kind}"]
    lines += [f"{name}: {value}" for name, value in HEADERS.items()]
    lines += [] if length is None else [f"Content-Length: {length}"]
    writer.write("\r\n".join([*lines, "", ""]).encode())


def _send(writer: asyncio.StreamWriter, status: HTTPStatus, kind: str, content: bytes) -> None:
    _head(writer, status, kind, len(content))
    writer.write(content)


def _outward(six: bool) -> str:
    """Return the address of this machine on the way to others; nothing is sent to find it."""
    family, elsewhere = (socket.AF_INET6, "2001:db8::1") if six else (socket.AF_INET, "192.0.2.1")
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((elsewhere, 9))
        except OSError:
            return "::1" if six else "127.0.0.1"
        return str(probe.getsockname()[0])
