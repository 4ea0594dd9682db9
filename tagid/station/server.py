"""Runs the station's application on a socket, with limits on connections and buffers of clients."""

from __future__ import annotations

import asyncio
import ctypes
import math
import resource
import select
import socket
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.wsproto_impl import WSProtocol
from wsproto.events import CloseConnection

from tagid.errors import PortInUseError, TagidError, UsageError
from tagid.station.errors import begin
from tagid.station.security import MOST_BODY_BYTES, UPLOAD_PATH, Pairing
from tagid.station.station import Station
from tagid.station.web import build
from tagid.workers import Worker

_M_MMAP_THRESHOLD = -3
"""Number of the parameter in glibc's malloc.h."""
LARGE_BYTES = 1 << 18


def return_large_blocks() -> bool:
    """Have the C library return every freed block of LARGE_BYTES or more to the system at once, if it can.

    By default glibc raises this limit to the size of the largest block freed so far, up to 32 MB
    (mallopt(3), M_MMAP_THRESHOLD). The arrays of a scan, some MB each, then lie between small objects that
    stay, and the process grows by steps of several MB.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES))


MAX_SOCKETS = 256
"""Open connections, WebSockets included; for one more, one that waits for its client is closed."""
LEAST_SOCKETS = 16
"""Connections without which the station does not start; a page has up to seven."""
_QUEUED = 128
"""Connections that the system keeps until they are accepted."""
_BATCH = 16
"""Connections that the event loop accepts before it handles them."""
_OTHER_FILES = 128
"""Files for all but connections: of the program, a scan and the batches that are not handled yet."""
KEPT_S = 2.0
"""Time that a connection with an answered request counts as younger than one without, s."""
HEADER_S = 10.0
"""Time after which a connection without a complete request is closed, s."""
UPLOAD_S = 60.0
"""Further time for a file that is being sent, s; 64 MB at 9 Mbit/s."""
PING_S = 4.0
"""Interval of WebSocket pings, and the time limit for the reply, s."""
MOST_FRAMES = 20
"""WebSocket frames of a client in a second, pings included; for more it is disconnected."""
_PIECE_BYTES = 512
CLOSE_S = 1.0
"""Time for a client to read why it is disconnected, s."""
_UNSENT_BYTES = 1 << 20
"""Bytes that a WebSocket client may leave unread before it is disconnected."""
STALL_S = 20.0
"""Time after which a client that does not read its response is disconnected, s."""


class StationHttp(H11Protocol):
    """HTTP with limits on connections, on the arrival of a request, and on the reading of a response.

    Of uvicorn's own, those on a request's head and on idle connections serve. `limit_concurrency` answers 503
    to whoever comes last, so that one address could take every place, and nothing ends a slow reader.
    """

    _stalled: asyncio.TimerHandle | None = None
    _waits_since = 0.0
    _aborted = False

    def connection_made(self, transport: Any) -> None:
        """Accept the connection; if it is one too many, close one."""
        self._waits_since = self.loop.time()
        super().connection_made(transport)
        self.loop.call_later(HEADER_S, self._expire, None)
        # A closed connection is listed until the loop runs on; it takes no place any more.
        gone = sum(isinstance(item, StationHttp) and item._aborted for item in self.connections)
        for surplus in range(len(self.connections) - gone - _places(), 0, -1):
            self._make_room(surplus)

    def _make_room(self, surplus: int) -> None:
        """Close a connection that waits, of so many too many; it may be this one, which is the newest.

        Those of paired clients are the last, those of the address with most connections the first; among
        equals it is the one that has waited longest, of its address one that does not wait for its turn. So
        while there are fewer addresses than places, each address has one: where all of a crowd are answered
        just now, one of them goes when the next connection comes.
        """
        kept = [item for item in self.connections if isinstance(item, StationHttp) and not item._aborted]
        crowd = Counter(item._address for item in kept)
        waiting = sorted(
            (item for item in kept if item._waits),
            key=lambda item: (item._state.get("paired", False), -crowd[item._address], item._waits_since),
        )
        if not waiting:
            return
        victim = min(
            (item for item in waiting if item._address == waiting[0]._address),
            key=lambda item: (item._state.get("paired", False), item._state.get("queued", False)),
        )
        answered = any(
            crowd[item._address] > 1 and not (item._waits or item._state.get("paired", False))
            for item in kept
        )
        if crowd[victim._address] == 1 and answered and surplus <= _BATCH:
            return
        victim._aborted = True
        victim.transport.abort()

    @property
    def _address(self) -> str:
        return self.client[0] if self.client else ""

    @property
    def _state(self) -> dict[str, Any]:
        """State of the newest request, see `Guard` and the handlers."""
        return {} if self.scope is None else self.scope["state"]

    @property
    def _waits(self) -> bool:
        """Whether it waits for a request, the rest of one, the reading of an answer, or its turn."""
        cycle = self.cycle
        if cycle is None or cycle.response_complete or cycle.more_body or self.flow.write_paused:
            return True
        return bool(self._state.get("queued"))

    def connection_lost(self, exc: Exception | None) -> None:
        self._read_again()
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Wait for a client that does not read, but not for ever: its file and its place are needed."""
        super().pause_writing()
        self._waits_since = self.loop.time()
        self._stalled = self.loop.call_later(STALL_S, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._read_again()

    def _read_again(self) -> None:
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None

    def on_response_complete(self) -> None:
        """Wait for the next request as long as for the first; those sent before this answer are dropped."""
        if self.conn.trailing_data[0]:
            self.transport.close()
        super().on_response_complete()
        self._waits_since = self.loop.time() + KEPT_S
        self.loop.call_later(HEADER_S, self._expire, self.cycle)

    def _expire(self, cycle: Any, late: bool = False) -> None:
        """Close where no whole request came after the one of a cycle; a file has longer to arrive."""
        arriving = self.cycle is not None and self.cycle.more_body
        if arriving and not late and self.scope is not None and self.scope["path"] == UPLOAD_PATH:
            self.loop.call_later(UPLOAD_S, self._expire, self.cycle, True)
            return
        if self in self.connections and (self.cycle is cycle or arriving):
            self.transport.abort()


class StationSocket(WSProtocol):
    """WebSockets without compression; clients that do not read or reply, or flood, are disconnected."""

    _flooding = False
    _frames = 0
    _second = 0.0

    def connection_made(self, transport: Any) -> None:
        """Begin; the system itself detects a client that is gone, in the time of an unanswered ping."""
        super().connection_made(transport)
        self.close_timeout = CLOSE_S
        self._socket_state = SocketState(transport.get_extra_info("socket"))

    def connection_lost(self, exc: Exception | None) -> None:
        """End; the socket is closed after this."""
        self._socket_state.end()
        super().connection_lost(exc)

    def handle_connect(self, event: Any) -> None:
        """Begin the application, which learns how to ask whether the client is still connected."""
        super().handle_connect(event)
        self.scope["state"]["connected"] = self._socket_state.connected

    def data_received(self, data: bytes) -> None:
        """Take frames, in pieces: what follows the one that is too many is not parsed."""
        for start in range(0, len(data), _PIECE_BYTES):
            if not self._flooding and not self.transport.is_closing():
                super().data_received(data[start : start + _PIECE_BYTES])

    def _allowed(self) -> bool:
        """Count a frame; the client is disconnected for one too many."""
        if self._flooding:
            return False
        now = self.loop.time()
        if now - self._second > 1.0:
            self._second, self._frames = now, 0
        self._frames += 1
        if self._frames > MOST_FRAMES:
            self._flooding = self.close_sent = True
            self.queue.put_nowait({"type": "websocket.disconnect", "code": 1008})
            self.transport.write(self.conn.send(CloseConnection(code=1008)))
            # Closing at once, with data unread, would reset the connection before the client has the reason.
            self.read_paused = False
            self.transport.pause_reading()
            self.close_timer = self.loop.call_later(CLOSE_S, self.transport.abort)
        return not self._flooding

    def handle_message(self, event: Any) -> None:
        if self._allowed():
            super().handle_message(event)

    def handle_pong(self, event: Any) -> None:
        if self._allowed():
            super().handle_pong(event)

    def keepalive_timeout(self) -> None:
        """Abort without reply to a ping: a regular close would wait for the client to read."""
        self.transport.abort()

    def handle_ping(self, event: Any) -> None:
        """Reply, unless the client does not read the replies."""
        if self.transport.get_write_buffer_size() > _UNSENT_BYTES:
            self.transport.abort()
        elif self._allowed():
            super().handle_ping(event)


class SocketState:
    """Whether the system still has a connection; asked on any thread, also while the event loop is busy.

    The socket stays open until `end`.
    """

    def __init__(self, connection: socket.socket) -> None:
        self._lock = threading.Lock()
        self._open = True
        self._poll = select.poll()
        self._poll.register(connection.fileno(), select.POLLRDHUP)  # errors and hang-ups are always reported
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, math.ceil(PING_S))
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, math.ceil(PING_S))
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(2e3 * PING_S))

    def connected(self) -> bool:
        """Whether it is open at both ends."""
        with self._lock:
            return self._open and not self._poll.poll(0)

    def end(self) -> None:
        """Forget the socket, before it is closed."""
        with self._lock:
            self._open = False


class _WebServer(uvicorn.Server):
    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start; the system keeps more connections than are accepted at once."""
        await super().startup(sockets)
        for listening in sockets or ():
            listening.listen(_QUEUED)


class Server:
    """The server in a separate thread, at `url`; use it as a context manager.

    Port 0 stands for any free port; `announce` shows a pairing code, and is None on a loopback address.

    Raises PortInUseError if another program listens there; UsageError if the address is not of this
    computer, or the process may open too few files.
    """

    def __init__(
        self, station: Station, host: str, port: int, announce: Callable[[str], None] | None = None
    ) -> None:
        self._station = station
        _allow_files()
        self._socket = _listen(host, port)
        self.port: int = self._socket.getsockname()[1]
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self.port}"
        self._pairing = None if announce is None else Pairing(announce)
        config = uvicorn.Config(
            build(station, host, self.port, self._pairing),
            http=StationHttp,
            ws=StationSocket,
            ws_max_size=MOST_BODY_BYTES,
            ws_ping_interval=PING_S,
            ws_ping_timeout=PING_S,
            ws_per_message_deflate=False,
            h11_max_incomplete_event_size=16_384,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=2,
            log_config=None,
            log_level="critical",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            lifespan="on",
            backlog=_BATCH,
        )
        self._server = _WebServer(config)
        self._closing = False
        self._web = Worker(
            self._serve, "station-web", lambda error: self._station.fail("the web server", error)
        )

    def __enter__(self) -> Server:
        return_large_blocks()
        try:
            self._station.begin()
            begin(self._web)
        except BaseException:
            self.close()
            raise
        if self._pairing is not None:
            self._pairing.begin()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def running(self) -> bool:
        """Whether it serves, and all parts of the station live."""
        return self._web.alive and self.failure is None

    @property
    def failure(self) -> TagidError | None:
        """Why it ended on its own; None if it did not."""
        return self._station.failure

    def close(self) -> None:
        """Stop scans, close all connections, and end the thread."""
        self._closing = True
        self._station.close()
        self._server.should_exit = True
        self._web.join(10.0)
        self._socket.close()

    def _serve(self) -> None:
        asyncio.run(self._server.serve([self._socket]))
        if not self._closing:
            raise RuntimeError("it ended on its own")


def _places() -> int:
    """Connections at the same time: `MAX_SOCKETS`, or what the limit of open files leaves."""
    limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MAX_SOCKETS if limit == resource.RLIM_INFINITY else min(MAX_SOCKETS, limit - _OTHER_FILES)


def _allow_files() -> None:
    """Raise the limit of open files where that is needed. Raises UsageError if it stays too low."""
    limit, highest = resource.getrlimit(resource.RLIMIT_NOFILE)
    if _places() < MAX_SOCKETS:
        needed = MAX_SOCKETS + _OTHER_FILES
        limit = needed if highest == resource.RLIM_INFINITY else min(needed, highest)
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, highest))
    if _places() < min(LEAST_SOCKETS, MAX_SOCKETS):
        raise UsageError(
            f"the station may open {limit} files; it needs {LEAST_SOCKETS + _OTHER_FILES}",
            "Raise the limit with `ulimit -n 1024`, or in a systemd unit with LimitNOFILE=1024.",
        )


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(_QUEUED)
    except OSError as error:
        listener.close()
        if isinstance(error, socket.gaierror):
            raise UsageError(f"{host} is not an address", "Give an IP address, e.g. 127.0.0.1.") from error
        raise PortInUseError(
            f"cannot listen on {host}:{port}: {error.strerror}",
            "End the other program, or choose another port with `bind=HOST:PORT`.",
        ) from error
    return listener
